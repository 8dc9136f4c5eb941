"""Low level glTF 2.0: buffers, accessors, images, the node graph and animation sampling.

Follows the glTF 2.0 specification (Khronos): accessors 3.6.2, animations 3.11 and appendix C, images 3.8.
"""

from collections.abc import Callable, Container, Iterator
from contextlib import contextmanager
from operator import attrgetter
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rewild4d.datasets.rigs.gltf_file import decoded, fetch, least_alpha, read_file
from rewild4d.errors import UserError, reason, shown

Floats = NDArray[np.float64]

COMPONENTS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT4": 16}
TYPES: dict[int, type[Any]] = {
    5120: np.int8,
    5121: np.uint8,
    5122: np.int16,
    5123: np.uint16,
    5125: np.uint32,
    5126: np.float32,
}
MOST_EMPTY = 1_000_000
"""Numbers of an accessor without data, which is all zeros but for sparse ones."""
MOST_REPEATED, MOST_PER_BYTE = 20_000_000, 8
"""Numbers that may be read in all: so many, and this many for each byte of the file, since parts are read again."""
MOST_LEVELS = 1000
"""Of the node hierarchy: rigs have tens."""
INTERPOLATIONS = (None, "LINEAR", "STEP", "CUBICSPLINE")
READABLE_EXTENSIONS = {"KHR_mesh_quantization", "KHR_texture_transform", "EXT_texture_webp"}


PATHS = ("translation", "rotation", "scale")
RESTING: tuple[tuple[Callable[[Any], Any], tuple[float, ...]], ...] = (
    (attrgetter("translation"), (0.0, 0.0, 0.0)),
    (lambda node: node.rotation if node.matrix is None else None, (0.0, 0.0, 0.0, 1.0)),
    (attrgetter("scale"), (1.0, 1.0, 1.0)),
)
"""What each of `PATHS` is in a node, and where a node says nothing."""


class Document:
    """One opened .glb or .gltf file.

    Raises:
        UserError: the file is missing, is no glTF 2.0, or needs an extension that changes how geometry is stored.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self._file = read_file(path)
        self.tree = self._file.tree
        unreadable = set(self.tree.extensionsRequired or []) - READABLE_EXTENSIONS
        unreadable = {name for name in unreadable if not name.startswith("KHR_materials_")}
        if unreadable:
            raise self.error(f"expected plain glTF, but the file requires {', '.join(sorted(unreadable))}")
        self._buffers: dict[int, bytes] = {}
        self._values = 0
        self.parents = [-1] * len(self.tree.nodes)
        for index, node in enumerate(self.tree.nodes):
            for child in node.children or []:
                self.parents[child] = index
        self.depths = [0] * len(self.tree.nodes)
        self.order = self._topological_order()

    def error(self, sentence: str) -> UserError:
        """Return the error for a fault of this file."""
        return UserError(f"{self.path}: {sentence}.")

    def _topological_order(self) -> list[int]:
        order = [index for index, parent in enumerate(self.parents) if parent < 0]
        for index in order:  # grows while it is walked: parents before children
            order.extend(self.tree.nodes[index].children or [])
            if len(order) > len(self.parents):
                break
        if len(order) != len(self.parents):
            raise self.error("expected a node hierarchy without cycles and with one parent per node")
        for index in order:
            self.depths[index] = self.depths[self.parents[index]] + 1 if self.parents[index] >= 0 else 0
        if max(self.depths, default=0) >= MOST_LEVELS:
            raise self.error(f"expected a node hierarchy of at most {MOST_LEVELS} levels, got {max(self.depths) + 1}")
        return order

    def nearest_above(self, chosen: Container[int]) -> list[int]:
        """Return the nearest ancestor of each node that is among the chosen ones, -1 where none is."""
        found = [-1] * len(self.parents)
        for index in self.order:
            if (parent := self.parents[index]) >= 0:
                found[index] = parent if parent in chosen else found[parent]
        return found

    def scene_nodes(self) -> list[int]:
        """Return nodes of the default scene (all nodes where the file has no scene), parents first."""
        if not self.tree.scenes:
            return self.order
        number = self.tree.scene or 0
        if not 0 <= number < len(self.tree.scenes):
            raise self.error(f"expected a default scene from 0 to {len(self.tree.scenes) - 1}, got {number}")
        reached = set(self.tree.scenes[number].nodes or [])
        for index in self.order:
            if self.parents[index] in reached:
                reached.add(index)
        return [index for index in self.order if index in reached]

    def buffer(self, index: int) -> bytes:
        """Return the bytes of one buffer: embedded, a data URI or a file beside this one."""
        if index not in self._buffers:
            uri = self.tree.buffers[index].uri
            self._buffers[index] = (self._file.blob or b"") if uri is None else fetch(self.path, uri)
        return self._buffers[index]

    def beside(self) -> Iterator[bytes]:
        """Yield bytes of the buffers and images that lie in files of their own, in the order of the file."""
        for entry in (*self.tree.buffers, *self.tree.images):
            if entry.uri is not None and not entry.uri.startswith("data:"):
                yield fetch(self.path, entry.uri)

    def _view(self, index: int, offset: int, count: int, width: int, dtype: type) -> NDArray[np.generic]:
        """Read count x width components from a buffer view, strided or packed."""
        view = self.tree.bufferViews[index]
        item = np.dtype(dtype).itemsize * width
        stride = view.byteStride or item
        start = (view.byteOffset or 0) + (offset or 0)
        raw = np.frombuffer(self.buffer(view.buffer), np.uint8)
        if min(start, view.byteOffset or 0, offset or 0, count) < 0 or stride < item:
            raise self.error(f"expected data that lies in its buffer, but view {index} has a negative offset or stride")
        if count and start + (count - 1) * stride + item > len(raw):
            raise self.error(f"expected {start + (count - 1) * stride + item} bytes of data, but it has {len(raw)}")
        rows = np.lib.stride_tricks.as_strided(raw[start:], (count, item), (stride, 1))
        return np.ascontiguousarray(rows).view(np.dtype(dtype).newbyteorder("<"))

    def accessor(self, index: int) -> NDArray[np.generic]:
        """Return the decoded accessor, [count, components]; normalised integers become floats in [0, 1] or [-1, 1]."""
        accessor = self.tree.accessors[index]
        if accessor.type not in COMPONENTS or accessor.componentType not in TYPES:
            raise self.error(
                f"expected an accessor type that skins use, but accessor {index} is {shown(accessor.type)}"
            )
        dtype, width = TYPES[accessor.componentType], COMPONENTS[accessor.type]
        self._expect(index, accessor.count, width, accessor.bufferView is None)
        if accessor.bufferView is None:
            values = np.zeros((accessor.count, width), dtype)
        else:
            values = self._view(accessor.bufferView, accessor.byteOffset, accessor.count, width, dtype)
        if accessor.sparse is not None:
            places, new = accessor.sparse.indices, accessor.sparse.values
            count, kind = accessor.sparse.count, TYPES[places.componentType]
            self._expect(index, count, width, False)
            rows = self._view(places.bufferView, places.byteOffset, count, 1, kind)[:, 0].astype(np.int64)
            values = values.copy()
            values[rows] = self._view(new.bufferView, new.byteOffset, count, width, dtype)
        if accessor.normalized:
            return np.maximum(values.astype(np.float64) / np.iinfo(dtype).max, -1.0)
        return values

    def count(self, index: int, times: int = 1) -> int:
        """Return how many elements an accessor says it has, where so many (``times`` three numbers) can be read."""
        count: int = self.tree.accessors[index].count
        self._expect(index, count * times, 3, False)
        return count

    def _expect(self, index: int, count: int, width: int, empty: bool) -> None:
        """Refuse an accessor that says more than a file holds, and a file that is read over and over."""
        held = self._file.size + sum(map(len, self._buffers.values()))
        most = MOST_EMPTY if empty else MOST_REPEATED + MOST_PER_BYTE * held
        self._values += count * width
        if not 0 <= count * width <= most or self._values > MOST_REPEATED + MOST_PER_BYTE * held:
            raise self.error(
                f"expected accessor {index} to hold what the file has room for, but it says {shown(count)}"
            )

    def floats(self, index: int) -> Floats:
        """Return the decoded accessor as finite float64, [count, components]."""
        values = self.accessor(index).astype(np.float64)
        if not np.isfinite(values).all():
            raise self.error(f"expected finite numbers, but accessor {index} holds NaN or infinity")
        return values

    def image(self, index: int) -> NDArray[np.uint8]:
        """Return the decoded image, sRGB uint8, [h, w, 3]."""
        return decoded(self.path, self._image_data(index), index)

    def least_alpha(self, index: int) -> float:
        """Return the least alpha of an image, in [0, 1]."""
        self.image(index)
        return least_alpha(self._image_data(index))

    def _image_data(self, index: int) -> bytes:
        image = self.tree.images[index]
        if image.bufferView is None:
            return fetch(self.path, image.uri)
        view = self.tree.bufferViews[image.bufferView]
        start = view.byteOffset or 0
        return self.buffer(view.buffer)[start : start + view.byteLength]

    def node_weights(self, index: int) -> list[float] | None:
        """Return weights of the morph targets that a node gives instead of its mesh's; None where it gives none."""
        weights: list[float] | None = self.tree.nodes[index].weights
        return weights

    def clip_range(self, animation: int) -> tuple[float, float]:
        """Return the first and last key time of an animation in seconds."""
        inputs = {sampler.input: None for sampler in self.tree.animations[animation].samplers}
        times = [self.floats(index) for index in inputs]
        if not times:
            return 0.0, 0.0
        return min(float(keys.min()) for keys in times), max(float(keys.max()) for keys in times)

    def local_matrices(self, animation: int | None, times: Floats) -> Floats:
        """Return the local transform of every node at the given times, [len(times), nodes, 4, 4]."""
        moved: dict[tuple[int, str], Floats] = {}
        if animation is not None:
            clip = self.tree.animations[animation]
            for channel in clip.channels:
                if channel.target.node is not None and channel.target.path != "weights":
                    sampler = clip.samplers[channel.sampler]
                    keys, values = self.floats(sampler.input)[:, 0], self.floats(sampler.output)
                    sampled = sample(keys, values, sampler.interpolation, times, channel.target.path == "rotation")
                    moved[channel.target.node, channel.target.path] = sampled
        nodes = self.tree.nodes
        still = [np.array([values(node) or default for node in nodes]) for values, default in RESTING]
        matrices = np.tile(compose(*still), (len(times), 1, 1, 1))
        for index in {node for node, _ in moved}:
            parts = (moved.get((index, name), rest[index][None]) for name, rest in zip(PATHS, still, strict=True))
            matrices[:, index] = compose(*parts)
        for index, node in enumerate(nodes):
            if node.matrix is not None:
                matrices[:, index] = np.reshape(node.matrix, (4, 4)).T
        return matrices

    def global_matrices(self, local: Floats) -> Floats:
        """Return node-to-world transforms from local ones, [T, nodes, 4, 4]."""
        matrices = local.copy()
        for index in self.order:
            if self.parents[index] >= 0:
                matrices[:, index] = matrices[:, self.parents[index]] @ local[:, index]
        return matrices


@contextmanager
def consistent(path: Path) -> Iterator[None]:
    """Read a file in the block: a reference to what is not there, or numbers that do not fit, end in one sentence.

    Raises:
        UserError: the block met one.
    """
    try:
        with np.errstate(divide="ignore", invalid="ignore", over="ignore"):  # what comes of it is looked at
            yield
    except (
        LookupError,
        TypeError,
        ValueError,
        AttributeError,
        OverflowError,
        MemoryError,
    ) as error:  # a singular matrix: ValueError
        raise UserError(
            f"{path}: expected a consistent glTF, but what it says does not fit ({reason(error)})."
        ) from error


def sample(keys: Floats, values: Floats, interpolation: str | None, times: Floats, is_rotation: bool) -> Floats:
    """Return an animation channel at the given times, held constant outside its keys (specification, appendix C).

    Args:
        keys: increasing key times in seconds, [k].
        values: [k, c], or [3 k, c] (in-tangent, value, out-tangent) for CUBICSPLINE.
        interpolation: "LINEAR" (also None), "STEP" or "CUBICSPLINE".
        times: seconds, [t].
        is_rotation: values are xyzw quaternions: interpolated along the shorter great arc, unit length.

    Returns:
        [t, c].

    Raises:
        ValueError: another interpolation, key times that fall, no key or one without a value, no quaternions.
    """
    if interpolation not in INTERPOLATIONS:
        raise ValueError(f"an animation is interpolated by '{interpolation}', not by {', '.join(INTERPOLATIONS[1:])}")
    cubic = interpolation == "CUBICSPLINE"
    before, points, after = (values[0::3], values[1::3], values[2::3]) if cubic else (values, values, values)
    if not 0 < len(keys) <= len(after):
        raise ValueError(f"an animation has {len(keys)} key times and {len(after)} values")
    if (np.diff(keys) < 0).any():
        raise ValueError("the key times of an animation fall")
    if is_rotation and values.shape[1] != 4:
        raise ValueError(f"a rotation has {values.shape[1]} numbers, not 4")
    left = np.clip(np.searchsorted(keys, times, side="right") - 1, 0, max(len(keys) - 2, 0))
    right = np.minimum(left + 1, len(keys) - 1)
    span = np.maximum(keys[right] - keys[left], 1e-12)
    s = np.clip((times - keys[left]) / span, 0.0, 1.0)[:, None]
    if interpolation == "STEP":
        return np.where(s >= 1.0, points[right], points[left])
    if cubic:
        into, out = span[:, None] * before[right], span[:, None] * after[left]
        result = (
            (2 * s**3 - 3 * s**2 + 1) * points[left]
            + (s**3 - 2 * s**2 + s) * out
            + (3 * s**2 - 2 * s**3) * points[right]
            + (s**3 - s**2) * into
        )
    elif is_rotation:
        result = _slerp(points[left], points[right], s)
    else:
        result = (1 - s) * points[left] + s * points[right]
    return result / np.linalg.norm(result, axis=1, keepdims=True) if is_rotation else result


def _slerp(start: Floats, end: Floats, s: Floats) -> Floats:
    cosine = (start * end).sum(1, keepdims=True)
    end = np.where(cosine < 0, -end, end)
    angle = np.arccos(np.clip(np.abs(cosine), 0.0, 1.0))
    sine = np.sin(angle)
    near = sine < 1e-6
    safe = np.where(near, 1.0, sine)
    return (
        np.where(near, 1 - s, np.sin((1 - s) * angle) / safe) * start
        + np.where(near, s, np.sin(s * angle) / safe) * end
    )


def compose(translation: Floats, rotation: Floats, scale: Floats) -> Floats:
    """Return T R S matrices from [t, 3], xyzw quaternions [t, 4] and [t, 3] (leading sizes broadcast), [t, 4, 4]."""
    count = max(len(translation), len(rotation), len(scale))
    x, y, z, w = (rotation / np.linalg.norm(rotation, axis=1, keepdims=True)).T
    rotations = np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    ).transpose(2, 0, 1)
    matrix = np.zeros((count, 4, 4))
    matrix[:, :3, :3] = rotations * scale[:, None, :]
    matrix[:, :3, 3] = translation
    matrix[:, 3, 3] = 1.0
    return matrix
