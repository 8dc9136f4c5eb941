"""Read a SMAL-like template (D-SMAL), which replaces the prior's surface and bones, for users who have the file.

Two kinds of file are read:

    npz     vertices [n, 3], faces [f, 3], weights [n, J], joints [J, 3], parents [J] (-1 for a root)
    pickle  SMAL's: v_template, f, weights, kintree_table, and J or J_regressor; posedirs and shapedirs are ignored

Axes are SMAL's: x towards the head, y to the animal's left, z up. The mean shape is scaled to the object frame's
diagonal and centred on the prior's rest shape; its proportions are not fitted. Its vertices move with the nearest
vertices of the prior, and its poses are the chains of joints that fit these moved vertices best.

A pickle can run any code when it is opened, so only arrays, sparse matrices and chumpy variables are built.
"""

import copyreg
import io
import math
import pickle
import pickletools
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from scipy import sparse
from scipy.spatial import cKDTree
from torch import Tensor

from rewild4d.errors import UserError, reason
from rewild4d.foreign.reading import arrays_of, require_room
from rewild4d.priors.io import seal
from rewild4d.priors.kinematics import depth_levels
from rewild4d.transforms import mirror_points, mirror_transforms, nearest_rotation, rigid, skin_points
from rewild4d.types import OBJECT_DIAGONAL, Prior

NEEDED = ("vertices", "faces", "weights", "joints", "parents")
NAMES_IN_SMAL = {"vertices": "v_template", "faces": "f", "joints": "J"}
LEAST_SIZE, LARGEST = 1e-9, 1e9
"""Of a template, in its own units: what is smaller or has larger numbers is damaged."""
LEAST_MASS = 3.0
"""A joint with less than this sum of weights rotates with its parent."""


def template_prior(path: Path, prior: Prior) -> Prior:
    """Return the prior with the file's surface, bones and weights, and with poses fitted to the prior's.

    Args:
        path: npz or SMAL pickle.
        prior: gives rest position, poses and cameras.

    Raises:
        UserError: no such file, or not of the two kinds above.
    """
    arrays = _checked(path, _read(path))
    points, joints = _in_object_frame(prior, arrays["vertices"], arrays["joints"])
    parents = arrays["parents"].tolist()
    _, nearest = cKDTree(prior.vertices.double().numpy()).query(points.double().numpy())
    moved = skin_points(points, prior.weights[torch.from_numpy(nearest)], prior.transforms)
    transforms = follow(points, moved, arrays["weights"], joints, parents)
    mirror = _mirror(joints)
    inner = torch.stack([joints, joints[[_child(parents, joint) for joint in range(len(parents))]]], dim=1)
    return seal(
        replace(
            prior,
            name=path.stem,
            provenance=f"The template {path.name} posed by the prior '{prior.name}'.",
            vertices=points,
            faces=arrays["faces"],
            weights=arrays["weights"],
            bones=inner,
            parents=arrays["parents"],
            mirror=mirror,
            transforms=transforms,
            transforms_flip=mirror_transforms(transforms, mirror),
        )
    )


def follow(points: Tensor, moved: Tensor, weights: Tensor, joints: Tensor, parents: list[int]) -> Tensor:
    """Fit a chain of joints to moved vertices: each joint has the best rotation of its own vertices.

    Args:
        points: rest, [n, 3].
        moved: at each time, [T, n, 3].
        weights: [n, J].
        joints: pivots at rest, [J, 3].
        parents: -1 for a root.

    Returns:
        Rest -> posed transforms, rigid, joints attached to their parents, [T, J, 4, 4].
    """
    posed: dict[int, Tensor] = {}
    start, end = points.double(), moved.double()
    for level in depth_levels(parents):
        for joint in level:
            share = weights[:, joint].double()
            above = posed.get(parents[joint])
            rotation, center, moved_center = _best_rotation(start, end, share)
            if share.sum() < LEAST_MASS and above is not None:
                rotation = above[:, :3, :3]
            pivot = joints[joint].double()
            if above is None:  # a root moves with its vertices
                target = (rotation @ (pivot - center)) + moved_center
            else:
                target = above[:, :3, :3] @ pivot + above[:, :3, 3]
            posed[joint] = rigid(rotation, target - rotation @ pivot)
    return torch.stack([posed[joint] for joint in range(len(parents))], dim=1).float()


def _best_rotation(start: Tensor, end: Tensor, share: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Return the best rotation [T, 3, 3] of weighted points (Kabsch), their centre before [3] and after [T, 3]."""
    part = share / share.sum().clamp_min(1e-12)
    before, after = part @ start, torch.einsum("n,tna->ta", part, end)
    cross = torch.einsum("n,tna,nb->tab", part, end - after[:, None], start - before)
    return nearest_rotation(cross), before, after


def _in_object_frame(prior: Prior, vertices: Tensor, joints: Tensor) -> tuple[Tensor, Tensor]:
    """Return vertices and joints in the object frame's axes and size, their box centred on the prior's (x = 0)."""
    permuted = [points[:, [1, 2, 0]] for points in (vertices, joints)]
    low, high = permuted[0].amin(0), permuted[0].amax(0)
    scale = OBJECT_DIAGONAL / float((high - low).norm())
    center = 0.5 * (prior.vertices.amin(0) + prior.vertices.amax(0)) * torch.tensor((0.0, 1.0, 1.0))
    vertices, joints = (((points - 0.5 * (low + high)) * scale + center).float() for points in permuted)
    return vertices, joints


def _mirror(joints: Tensor) -> Tensor:
    """Return the joint nearest to each one's mirror image where that is mutual, itself otherwise, [J]."""
    nearest = torch.cdist(mirror_points(joints), joints).argmin(-1)
    own = torch.arange(len(joints))
    return torch.where(nearest[nearest] == own, nearest, own)


def _child(parents: list[int], joint: int) -> int:
    return next((other for other, parent in enumerate(parents) if parent == joint), joint)


class _Chumpy:
    """Stand-in for a chumpy variable, whose value is the array `x`."""

    x: Any = None

    def __setstate__(self, state: Any) -> None:
        self.x = state.get("x") if isinstance(state, dict) else None


def _encode(text: str, encoding: str = "latin1") -> bytes:
    return text.encode(encoding)


def _empty_array(_: object, shape: Any, __: object) -> np.ndarray:
    """Begin an array as NumPy's reduction does: without values, which follow; a pickle may not ask for more room."""
    if shape != (0,):
        raise pickle.UnpicklingError(f"it begins an array of shape {str(shape)[:40]}")
    return np.zeros(0, np.int8)


class _Csc(sparse.csc_matrix):  # type: ignore[misc]
    """A matrix that a pickle fills; calling the class, which may take any room, is not let through."""

    def __init__(self, *_: Any) -> None:
        raise pickle.UnpicklingError("it makes a sparse matrix of a size")


class _Csr(sparse.csr_matrix):  # type: ignore[misc]
    """The same by rows."""

    def __init__(self, *_: Any) -> None:
        raise pickle.UnpicklingError("it makes a sparse matrix of a size")


LET_THROUGH: dict[tuple[str, str], Any] = {
    ("numpy", "_reconstruct"): _empty_array,
    # numpy moved this function between modules; the reduction of a number names the present one.
    ("numpy", "scalar"): np.float64(0).__reduce__()[0],
    ("numpy", "ndarray"): None,
    ("numpy", "dtype"): np.dtype,
    ("scipy", "csc_matrix"): _Csc,
    ("scipy", "csr_matrix"): _Csr,
    ("chumpy", "Ch"): _Chumpy,
    ("_codecs", "encode"): _encode,
    # Python 2 had other names for these two modules.
    **dict.fromkeys((("copyreg", "_reconstructor"), ("copy_reg", "_reconstructor")), copyreg._reconstructor),  # type: ignore[attr-defined]
    **dict.fromkeys((("builtins", "object"), ("__builtin__", "object")), object),
}
"""What a pickle may name, by the names of the top package and of the object."""


class _Careful(pickle.Unpickler):
    """Unpickler of arrays, sparse matrices and chumpy variables alone."""

    def find_class(self, module: str, name: str) -> Any:
        place = (module.split(".")[0], name)
        if place not in LET_THROUGH:
            raise pickle.UnpicklingError(f"it holds a {module}.{name}, which is not let through")
        return LET_THROUGH[place]


def _read(path: Path) -> Mapping[str, Any]:
    """Return the arrays of a file by the names that an npz has."""
    wanted = f"{path}: expected a D-SMAL file (npz or SMAL pickle)"
    try:
        content = path.read_bytes()
        if content[:2] == b"PK":
            return arrays_of(path, content, "a D-SMAL file (npz or SMAL pickle)")
        _require_few_places(content)
        raw = _Careful(io.BytesIO(content), encoding="latin1").load()
    except FileNotFoundError as error:
        raise UserError(f"{wanted}, but there is no such file.") from error
    except (OSError, ValueError, EOFError, pickle.UnpicklingError, AttributeError, TypeError, LookupError, ImportError,
            OverflowError, MemoryError, SystemError) as error:  # fmt: skip
        raise UserError(f"{wanted}, but it cannot be read: {reason(error)}.") from error
    if not isinstance(raw, dict):
        raise UserError(f"{path}: expected a SMAL pickle that holds a dictionary, got a {type(raw).__name__}.")
    found = {key: _array(path, raw[name]) for key in NEEDED if (name := NAMES_IN_SMAL.get(key, key)) in raw}
    if "J_regressor" in raw and "vertices" in found:
        found["joints"] = _array(path, raw["J_regressor"]) @ found["vertices"]
    if "kintree_table" in raw:
        found["parents"] = np.asarray(_array(path, raw["kintree_table"]))[0]
    return found


def _require_few_places(content: bytes) -> None:
    """Refuse a pickle that numbers its values beyond their count: the unpickler makes room for every number below."""
    places = (argument for code, argument, _ in pickletools.genops(content) if code.name.endswith("PUT"))
    if any(int(place or 0) > len(content) for place in places):
        raise pickle.UnpicklingError("it numbers more values than it can hold")


def _array(path: Path, value: Any) -> np.ndarray:
    if isinstance(value, _Chumpy):
        value = value.x
    if not sparse.issparse(value):
        return np.asarray(value)
    try:  # places of a damaged one may lie outside of it, and SciPy writes there unless it is asked to look
        kind = sparse.csc_matrix if isinstance(value, _Csc) else sparse.csr_matrix
        looked_at = kind((value.data, value.indices, value.indptr), shape=value.shape)
        looked_at.check_format(full_check=True)
    except (ValueError, TypeError, AttributeError, LookupError, OverflowError) as error:
        raise UserError(f"{path}: expected a sparse matrix, but it is damaged ({reason(error)}).") from error
    # A few numbers may stand for a matrix of any size.
    require_room(path, math.prod(looked_at.shape) * looked_at.dtype.itemsize, "a sparse matrix")
    return np.asarray(looked_at.todense())


def _checked(path: Path, raw: Mapping[str, Any]) -> dict[str, Tensor]:
    """Return the five arrays as tensors; UserError where one has another shape or values out of range."""
    missing = [name for name in NEEDED if name not in raw]
    if missing:
        held = ", ".join(sorted(raw)) or "nothing"
        raise UserError(
            f"{path}: expected {', '.join(NEEDED)} of a D-SMAL template, but {missing[0]} is not in it ({held})."
        )
    arrays = {name: np.asarray(raw[name]) for name in NEEDED}
    count, joints = len(arrays["vertices"]), len(arrays["parents"])
    wanted = {
        "vertices": (count, 3), "faces": (len(arrays["faces"]), 3), "weights": (count, joints), "joints": (joints, 3),
        "parents": (joints,),
    }  # fmt: skip
    for name, shape in wanted.items():
        found = arrays[name]
        if found.shape != shape or not found.size or not np.issubdtype(found.dtype, np.number):
            raise UserError(f"{path}: expected '{name}' of shape {list(shape)}, got {list(found.shape)}.")
        if not np.isfinite(arrays[name].astype(np.float64)).all():
            raise UserError(f"{path}: expected finite numbers in '{name}'.")
    size = float(np.linalg.norm(np.ptp(arrays["vertices"].astype(np.float64), axis=0)))
    reach = max(float(np.abs(arrays[name].astype(np.float64)).max()) for name in ("vertices", "joints", "weights"))
    if not size > LEAST_SIZE or not reach < LARGEST:
        raise UserError(
            f"{path}: expected vertices of some size and numbers up to {LARGEST:g}, got {size:.3g} and {reach:.3g}."
        )
    parents, faces = arrays["parents"].astype(np.int64), arrays["faces"].astype(np.int64)
    parents = np.where((parents >= 0) & (parents < joints), parents, -1)
    if faces.min() < 0 or faces.max() >= count:
        raise UserError(f"{path}: expected 'faces' between 0 and {count - 1}, got {faces.min()} to {faces.max()}.")
    try:
        depth_levels(parents.tolist())
    except ValueError as error:
        raise UserError(f"{path}: expected 'parents' to form a tree, got {parents.tolist()}.") from error
    weights = torch.from_numpy(arrays["weights"].astype(np.float32)).clamp_min(0)
    return {
        "vertices": torch.from_numpy(arrays["vertices"].astype(np.float64)),
        "joints": torch.from_numpy(arrays["joints"].astype(np.float64)),
        "weights": weights / weights.sum(-1, keepdim=True).clamp_min(1e-8),
        "faces": torch.from_numpy(faces),
        "parents": torch.from_numpy(parents),
    }
