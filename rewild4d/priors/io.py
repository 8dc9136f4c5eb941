"""Prior files: one npz, for priors fitted here and for priors made elsewhere.

Keys (T frames, J bones, n vertices, f faces; lengths in object units, the rest shape's bounding-box diagonal is 5):

    name, provenance    text
    vertices            [n, 3]           rest shape in the object frame (x its left, y up, z towards the head)
    faces               [f, 3]           integers
    weights             [n, J]           skinning weights, rows sum to one
    bones               [J, 2, 3]        start (the pivot) and end of each bone at rest
    parents             [J]              integers, -1 for a root
    mirror              [J]              integers, the bone on the other side (an involution)
    times               [T]              seconds, the clip's own, increasing
    object_to_world     [T, 4, 4]        similarity, one scale
    world_to_camera     [T, 4, 4]        rigid, object frame -> OpenCV camera, in object units
    intrinsics          [T, 3, 3]        pixels of the clip's images, pixel centres at +0.5
    sizes               [T, 2]           integers, image width and height
    transforms          [T, J, 4, 4]     rigid, rest -> posed in the object frame, identity at rest
    quality             text             JSON object of figures (optional)

    world_to_camera_flip, intrinsics_flip, transforms_flip   the same for the horizontally flipped images (optional:
                        by default the exact mirror images of the three arrays)
"""

import json
import math
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from rewild4d.errors import UserError, shown
from rewild4d.files import atomic, digest
from rewild4d.foreign.reading import read_arrays
from rewild4d.foreign.texts import parse_json
from rewild4d.transforms import mirror_camera, mirror_transforms
from rewild4d.types import OBJECT_DIAGONAL, Camera, Prior

SHAPES: dict[str, tuple[str | int, ...]] = {
    "vertices": ("n", 3),
    "faces": ("f", 3),
    "weights": ("n", "J"),
    "bones": ("J", 2, 3),
    "parents": ("J",),
    "mirror": ("J",),
    "times": ("T",),
    "object_to_world": ("T", 4, 4),
    "world_to_camera": ("T", 4, 4),
    "intrinsics": ("T", 3, 3),
    "sizes": ("T", 2),
    "transforms": ("T", "J", 4, 4),
}
FLIPPED: dict[str, tuple[str | int, ...]] = {
    "world_to_camera_flip": ("T", 4, 4),
    "intrinsics_flip": ("T", 3, 3),
    "transforms_flip": ("T", "J", 4, 4),
}
INTEGERS = ("faces", "parents", "mirror", "sizes")
SINGLE = ("vertices", "weights", "bones", "transforms", "transforms_flip")
RIGID = ("world_to_camera", "world_to_camera_flip", "transforms", "transforms_flip")
OFF_ROTATION = 0.01
"""Largest deviation of R R^T from the identity: data sets give rotations to three digits."""


def seal(prior: Prior) -> Prior:
    """Return the prior with the digest of everything else."""
    cameras = [
        array
        for camera in (*prior.cameras, *prior.cameras_flip)
        for array in (camera.world_to_camera, camera.intrinsics, np.array((camera.width, camera.height)))
    ]
    quality = json.dumps(prior.quality, sort_keys=True)
    arrays = (
        prior.vertices, prior.faces, prior.weights, prior.bones, prior.parents, prior.mirror, prior.times,
        prior.object_to_world, prior.transforms, prior.transforms_flip,
    )  # fmt: skip
    marks = () if prior.steady is None else (prior.steady,)
    return replace(prior, digest=digest(prior.name, prior.provenance, quality, *arrays, *cameras, *marks))


def save_prior(prior: Prior, path: Path) -> None:
    """Write a prior atomically.

    Raises:
        UserError: the file cannot be written.
    """
    with atomic(path) as temporary, temporary.open("wb") as stream:
        np.savez_compressed(stream, **_arrays(prior))


def require_loadable(prior: Prior, source: Path) -> None:
    """Check that `load_prior` would accept a file of the prior.

    Raises:
        UserError: names ``source``, which the prior is made from, and the first invalid array.
    """
    _validated(source, _arrays(prior))


def _arrays(prior: Prior) -> dict[str, Any]:
    """Return the arrays of a prior file."""
    arrays: dict[str, Any] = {
        name: getattr(prior, name).detach().cpu().numpy()
        for name in (*SHAPES, *FLIPPED)
        if isinstance(getattr(prior, name, None), Tensor)
    }
    for suffix, cameras in (("", prior.cameras), ("_flip", prior.cameras_flip)):
        arrays[f"world_to_camera{suffix}"] = torch.stack([camera.world_to_camera for camera in cameras]).numpy()
        arrays[f"intrinsics{suffix}"] = torch.stack([camera.intrinsics for camera in cameras]).numpy()
    arrays["sizes"] = np.array([(camera.width, camera.height) for camera in prior.cameras])
    arrays |= {"name": prior.name, "provenance": prior.provenance, "quality": json.dumps(prior.quality)}
    return {name: np.asarray(array) for name, array in arrays.items()}


def load_prior(path: Path) -> Prior:
    """Read a prior file.

    Raises:
        UserError: no such file, not an npz, an array is missing, or has another shape, kind or values than documented.
    """
    raw = read_arrays(path, "a prior file (npz)")
    arrays = _validated(path, raw)
    cameras = _cameras(arrays["world_to_camera"], arrays["intrinsics"], arrays["sizes"])
    if FLIPPED.keys() <= arrays.keys():
        cameras_flip = _cameras(arrays["world_to_camera_flip"], arrays["intrinsics_flip"], arrays["sizes"])
        transforms_flip = arrays["transforms_flip"]
    else:
        cameras_flip = tuple(mirror_camera(camera) for camera in cameras)
        transforms_flip = mirror_transforms(arrays["transforms"], arrays["mirror"])
    shared: dict[str, Any] = {
        key: arrays[key] for key in SHAPES if key not in ("world_to_camera", "intrinsics", "sizes")
    }
    text = {key: str(raw[key]) for key in ("name", "provenance", "quality") if key in raw}
    return seal(
        Prior(
            name=text.get("name", path.stem),
            provenance=text.get("provenance", f"Read from {path.name}."),
            cameras=cameras,
            cameras_flip=cameras_flip,
            transforms_flip=transforms_flip,
            quality=_quality(path, text.get("quality", "{}")),
            digest="",
            notes=(),
            **shared,
        )
    )


def _validated(path: Path, raw: Mapping[str, np.ndarray]) -> dict[str, Tensor]:
    """Check all arrays; return those of `SHAPES`, and of `FLIPPED` where the file has them."""
    sizes: dict[str, int] = {}
    shapes = SHAPES | {key: shape for key, shape in FLIPPED.items() if key in raw}
    arrays = {key: _checked(path, raw, key, shape, sizes) for key, shape in shapes.items()}
    _check_values(path, arrays)
    return arrays


def _quality(path: Path, text: str) -> dict[str, float]:
    try:
        found = {str(name): float(value) for name, value in parse_json(text, path, "'quality'").items()}
    except (ValueError, TypeError, AttributeError, OverflowError, UserError) as error:
        raise UserError(f"{path}: expected 'quality' to be a JSON object of numbers, got '{shown(text)}'.") from error
    if bad := next((name for name, value in found.items() if not math.isfinite(value)), None):
        raise UserError(f"{path}: expected finite numbers in 'quality', got {found[bad]} for '{bad}'.")
    return found


def _checked(
    path: Path, raw: Mapping[str, np.ndarray], key: str, shape: tuple[str | int, ...], sizes: dict[str, int]
) -> Tensor:
    """Return one array after checks of shape and type; ``sizes`` holds the size of each letter once it is known."""
    if key not in raw:
        held = ", ".join(sorted(raw)) or "nothing"
        raise UserError(f"{path}: expected an array '{key}', but the file holds only {held}.")
    array = raw[key]
    wanted = ", ".join(f"{name}={sizes[name]}" if name in sizes else str(name) for name in map(str, shape))
    fits = array.ndim == len(shape) and all(
        size == (name if isinstance(name, int) else sizes.setdefault(name, size))
        for name, size in zip(shape, array.shape, strict=True)
    )
    if not fits or 0 in array.shape:
        raise UserError(f"{path}: expected '{key}' of shape [{wanted}], got {list(array.shape)}.")
    integer = key in INTEGERS
    if not np.issubdtype(array.dtype, np.integer if integer else np.floating):
        raise UserError(f"{path}: expected '{key}' to hold {'integers' if integer else 'floats'}, got {array.dtype}.")
    if odd := int((~np.isfinite(array)).sum()):
        raise UserError(f"{path}: expected finite numbers in '{key}', got {odd} that are not.")
    return torch.from_numpy(array.astype(np.int64 if integer else np.float32 if key in SINGLE else np.float64))


def _check_values(path: Path, arrays: Mapping[str, Tensor]) -> None:
    """Check values.

    Raises:
        UserError: names the first invalid array.
    """
    bones, flipped = torch.arange(len(arrays["parents"])), [key for key in FLIPPED if key in arrays]
    vertices, faces, mirror, parents = (arrays[key] for key in ("vertices", "faces", "mirror", "parents"))
    sums, extent = arrays["weights"].sum(1), float((vertices.amax(0) - vertices.amin(0)).norm())
    scales = torch.linalg.det(arrays["object_to_world"][:, :3, :3])
    inside = {key: (arrays[key] >= low) & (arrays[key] < high) for key, low, high in (
        ("faces", 0, len(vertices)), ("parents", -1, len(bones)), ("mirror", 0, len(bones)),
    )}  # fmt: skip
    checks = [
        (bool(inside["faces"].all()), f"'faces' to be below {len(vertices)}", f"{int(faces.max())}"),
        (bool(inside["parents"].all()), f"'parents' to lie in -1..{len(bones) - 1}", f"{parents.tolist()}"),
        (_is_forest(parents), "'parents' to form a tree", f"a cycle in {parents.tolist()}"),
        (
            bool(inside["mirror"].all()) and bool((mirror[mirror.clamp(0, len(bones) - 1)] == bones).all()),
            "'mirror' to be its own inverse",
            f"{mirror.tolist()}",
        ),
        (float((sums - 1).abs().max()) < 1e-3, "rows of 'weights' to sum to one", f"{float(sums.min()):.4g} at least"),
        (
            abs(extent - OBJECT_DIAGONAL) < 0.01 * OBJECT_DIAGONAL,
            f"a rest bounding-box diagonal of {OBJECT_DIAGONAL:g}",
            f"{extent:.4g}",
        ),
        (bool((scales > 0).all()), "'object_to_world' to keep handedness", f"determinant {float(scales.min()):.4g}"),
        (bool((arrays["times"].diff() > 0).all()), "'times' to increase", f"{arrays['times'].tolist()[:6]}"),
        (bool((arrays["sizes"] > 0).all()), "'sizes' above zero", f"{int(arrays['sizes'].min())}"),
        (len(flipped) in (0, len(FLIPPED)), f"all or none of {', '.join(FLIPPED)}", f"only {', '.join(flipped)}"),
    ]
    for key, array in arrays.items():
        if key in RIGID:
            fault = off_similarity(array, rigid=True)
            checks.append((fault <= OFF_ROTATION, f"rigid matrices in '{key}'", f"some that are {fault:.2g} off"))
        elif key.startswith("intrinsics"):
            checks.append((_is_pinhole(array), f"positive focal lengths and a last row 0 0 1 in '{key}'", "others"))
    fault = off_similarity(arrays["object_to_world"], rigid=False)
    checks.append((fault <= OFF_ROTATION, "similarities in 'object_to_world'", f"some that are {fault:.2g} off"))
    for passed, expected, came in checks:
        if not passed:
            raise UserError(f"{path}: expected {expected}, got {came}.")


def off_similarity(matrices: Tensor, *, rigid: bool) -> float:
    """Return the largest deviation of matrices [..., 4, 4] from rigid transforms, or else from similarities."""
    linear, last = matrices[..., :3, :3].double(), matrices[..., 3, :].double()
    scale = linear.det().sign().clamp_min(0) if rigid else linear.det().clamp_min(0) ** (1 / 3)
    rotation = linear / scale[..., None, None]
    gram = rotation @ rotation.transpose(-1, -2) - torch.eye(3, dtype=torch.float64)
    off = torch.maximum(gram.abs().amax(), (last - last.new_tensor((0, 0, 0, 1))).abs().amax())
    return float(off.nan_to_num(nan=torch.inf))


def _is_pinhole(intrinsics: Tensor) -> bool:
    last = torch.equal(intrinsics[:, 2], intrinsics.new_tensor((0, 0, 1)).expand(len(intrinsics), 3))
    return last and bool((intrinsics[:, (0, 1), (0, 1)] > 0).all())


def _is_forest(parents: Tensor) -> bool:
    """Tell whether every bone reaches a root."""
    bone, last = torch.arange(len(parents)), len(parents) - 1
    for _ in parents:
        bone = torch.where(bone >= 0, parents[bone.clamp(0, last)].clamp(-1, last), bone)
    return bool((bone < 0).all())


def _cameras(world_to_camera: Tensor, intrinsics: Tensor, sizes: Tensor) -> tuple[Camera, ...]:
    return tuple(
        Camera(matrix, inner, int(width), int(height))
        for matrix, inner, (width, height) in zip(world_to_camera, intrinsics, sizes.tolist(), strict=True)
    )
