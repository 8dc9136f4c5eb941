"""Low level glTF 2.0: buffers, accessors, images, the node graph and animation sampling.

Follows the glTF 2.0 specification (Khronos): accessors 3.6.2, animations 3.11 and appendix C, images 3.8.
"""

import base64
import binascii
import json
import struct
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cached_property
from pathlib import Path
from typing import Any
from urllib.parse import unquote

import cv2
import numpy as np
import pygltflib
from numpy.typing import NDArray

from rewild4d.errors import UserError

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
MOST_VALUES = 100_000_000
"""Of an accessor: a file that says more is damaged."""
INTERPOLATIONS = (None, "LINEAR", "STEP", "CUBICSPLINE")
READABLE_EXTENSIONS = {"KHR_mesh_quantization", "KHR_texture_transform", "EXT_texture_webp"}


class Document:
    """One opened .glb or .gltf file.

    Raises:
        UserError: the file is missing, is no glTF 2.0, or needs an extension that changes how geometry is stored.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.tree = _parse(path)
        unreadable = set(self.tree.extensionsRequired or []) - READABLE_EXTENSIONS
        unreadable = {name for name in unreadable if not name.startswith("KHR_materials_")}
        if unreadable:
            raise self.error(f"expected plain glTF, but the file requires {', '.join(sorted(unreadable))}")
        self._buffers: dict[int, bytes] = {}
        self.parents = [-1] * len(self.tree.nodes)
        for index, node in enumerate(self.tree.nodes):
            for child in node.children or []:
                self.parents[child] = index
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
        return order

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
            self._buffers[index] = (self.tree.binary_blob() or b"") if uri is None else self._fetch(uri)
        return self._buffers[index]

    def beside(self) -> Iterator[bytes]:
        """Yield bytes of the buffers and images that lie in files of their own, in the order of the file."""
        for entry in (*self.tree.buffers, *self.tree.images):
            if entry.uri is not None and not entry.uri.startswith("data:"):
                yield self._fetch(entry.uri)

    def _fetch(self, uri: str) -> bytes:
        if uri.startswith("data:"):
            try:
                return base64.b64decode(uri.partition(",")[2])
            except binascii.Error as error:
                raise self.error(f"expected base64 in a data URI, but: {error}") from error
        file = self.path.parent / unquote(uri)
        try:
            return file.read_bytes()
        except OSError as error:
            raise self.error(f"expected the file {file} beside it, but: {error.strerror}") from error

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
            raise self.error(f"expected an accessor type that skins use, but accessor {index} is {accessor.type}")
        dtype, width = TYPES[accessor.componentType], COMPONENTS[accessor.type]
        if not 0 <= (count := accessor.count) <= MOST_VALUES:
            raise self.error(f"expected accessor {index} to hold up to {MOST_VALUES} values, but it says {count}")
        if accessor.bufferView is None:
            values = np.zeros((accessor.count, width), dtype)
        else:
            values = self._view(accessor.bufferView, accessor.byteOffset, accessor.count, width, dtype)
        if accessor.sparse is not None:
            places, new = accessor.sparse.indices, accessor.sparse.values
            count, kind = accessor.sparse.count, TYPES[places.componentType]
            rows = self._view(places.bufferView, places.byteOffset, count, 1, kind)[:, 0].astype(np.int64)
            values = values.copy()
            values[rows] = self._view(new.bufferView, new.byteOffset, count, width, dtype)
        if accessor.normalized:
            return np.maximum(values.astype(np.float64) / np.iinfo(dtype).max, -1.0)
        return values

    def floats(self, index: int) -> Floats:
        """Return the decoded accessor as finite float64, [count, components]."""
        values = self.accessor(index).astype(np.float64)
        if not np.isfinite(values).all():
            raise self.error(f"expected finite numbers, but accessor {index} holds NaN or infinity")
        return values

    def image(self, index: int) -> NDArray[np.uint8]:
        """Return the decoded image, sRGB uint8, [h, w, 3]."""
        image = self.tree.images[index]
        if image.bufferView is not None:
            view = self.tree.bufferViews[image.bufferView]
            start = view.byteOffset or 0
            data = self.buffer(view.buffer)[start : start + view.byteLength]
        else:
            data = self._fetch(image.uri or "")
        pixels = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR) if data else None
        if pixels is None:
            raise self.error(f"expected a png, jpeg or webp texture, but image {index} cannot be decoded")
        return np.ascontiguousarray(pixels[..., ::-1])

    @cached_property
    def _written(self) -> dict[str, Any]:
        """The file's JSON as it stands there: pygltflib leaves out what it has no field for."""
        data = self.path.read_bytes()
        if data[:4] == b"glTF":
            data = data[20 : 20 + struct.unpack_from("<I", data, 12)[0]]
        found: dict[str, Any] = json.loads(data)
        return found

    def node_weights(self, index: int) -> list[float] | None:
        """Return weights of the morph targets that a node gives instead of its mesh's; None where it gives none."""
        weights: list[float] | None = self._written["nodes"][index].get("weights")
        return weights

    def clip_range(self, animation: int) -> tuple[float, float]:
        """Return the first and last key time of an animation in seconds."""
        times = [self.floats(sampler.input) for sampler in self.tree.animations[animation].samplers]
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
        matrices = np.empty((len(times), len(self.tree.nodes), 4, 4))
        for index, node in enumerate(self.tree.nodes):
            if node.matrix is not None:
                matrices[:, index] = np.reshape(node.matrix, (4, 4)).T
            else:
                matrices[:, index] = compose(
                    moved.get((index, "translation"), np.array([node.translation or (0.0, 0.0, 0.0)])),
                    moved.get((index, "rotation"), np.array([node.rotation or (0.0, 0.0, 0.0, 1.0)])),
                    moved.get((index, "scale"), np.array([node.scale or (1.0, 1.0, 1.0)])),
                )
        return matrices

    def global_matrices(self, local: Floats) -> Floats:
        """Return node-to-world transforms from local ones, [T, nodes, 4, 4]."""
        matrices = local.copy()
        for index in self.order:
            if self.parents[index] >= 0:
                matrices[:, index] = matrices[:, self.parents[index]] @ local[:, index]
        return matrices


def _parse(path: Path) -> pygltflib.GLTF2:
    try:
        head = path.open("rb").read(4)
    except OSError as error:
        raise UserError(f"{path}: expected a .glb or .gltf file, but: {error.strerror}.") from error
    try:
        tree = pygltflib.GLTF2()
        tree = tree.load_binary(str(path)) if head == b"glTF" else tree.load_json(str(path))
    except (ValueError, KeyError, TypeError, AttributeError, OSError, RecursionError, struct.error) as error:
        raise UserError(f"{path}: expected a .glb or .gltf file, but it cannot be parsed ({error}).") from error
    if tree is None or tree.asset is None or not str(tree.asset.version or "").startswith("2"):
        raise UserError(f"{path}: expected glTF version 2, but it is another format or version.")
    return tree


@contextmanager
def consistent(path: Path) -> Iterator[None]:
    """Read a file in the block: a reference to what is not there, or numbers that do not fit, end in one sentence.

    Raises:
        UserError: the block met one.
    """
    try:
        with np.errstate(divide="ignore", invalid="ignore"):  # what comes of it is looked at
            yield
    except (IndexError, KeyError, TypeError, ValueError, AttributeError) as error:  # a singular matrix is a ValueError
        raise UserError(f"{path}: expected a consistent glTF, but what it says does not fit ({error}).") from error


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
