"""Read what 3D-Fauna's test run writes (design notes, FORMATS 4.8) as a prior.

Per image it leaves a posed mesh, a pose and joint angles, but neither the rest mesh nor the skinning weights. Bones and
weights are functions of the rest vertices (FORMATS 4.4, 4.5), so the rest mesh of an image is found as the fixed point
of undoing the pose. One image's mesh is kept and all poses are recomputed with its bones (METHOD, section 2).
"""

import math
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from scipy.spatial import cKDTree
from torch import Tensor

from rewild4d.errors import UserError
from rewild4d.priors.fauna_bones import estimate_bones, joint_transforms, skinning_weights
from rewild4d.priors.io import seal
from rewild4d.priors.template import MIRROR
from rewild4d.transforms import mirror_camera, mirror_points, mirror_transforms, rigid, skin_points
from rewild4d.types import OBJECT_DIAGONAL, Camera, Prior

FIELD_OF_VIEW, OFFSET = math.radians(25.0), 10.0
NATIVE = 256
SWEEPS = 12
"""Rounds of undoing the pose; the rest mesh moves by less than a thousandth after a few."""
TRIED = 4
"""Least bent poses that are undone; the most symmetric rest mesh is taken."""
_NAME = re.compile(r"(?P<step>\d+)_\s*(?P<frame>\S+)_mesh\.obj")


def read_fauna(folder: Path, *, flip: Path | None, boxes: Path | None, size: int, fps: float) -> Prior:
    """Read a result folder.

    Args:
        folder: holds <step>_<frame>_mesh.obj, _pose.txt and _arti_params.txt of every frame.
        flip: the same of the horizontally flipped images; None: exact mirror images.
        boxes: folder of <frame>_box.txt; the cameras are then of the whole frames, else of the crops.
        size: side of the crops in pixels, where there are no boxes.
        fps: frames per second.

    Raises:
        UserError: files are missing or hold something else.
    """
    stems = _stems(folder)
    angles, cameras = _frames(folder, stems, boxes, size, flipped=False)
    rest, faces, used, quality = _rest(folder, list(stems.values()), angles)
    bones, parents = estimate_bones(rest)
    weights = skinning_weights(rest, bones)
    scale = OBJECT_DIAGONAL / float((rest.amax(0) - rest.amin(0)).norm())
    transforms = torch.stack([joint_transforms(bones, parents, each) for each in angles])
    cameras_flip = [mirror_camera(camera) for camera in cameras]
    transforms_flip = mirror_transforms(transforms, torch.tensor(MIRROR))
    if flip is not None:
        other = _stems(flip)
        lacking = [frame for frame in stems if frame not in other]
        if lacking:
            raise UserError(f"{flip}: expected the frames of {folder}, but {', '.join(lacking[:3])} are missing.")
        kept = {frame: other[frame] for frame in stems}
        angles_flip, cameras_flip = _frames(flip, kept, boxes, size, flipped=True)
        transforms_flip = torch.stack([joint_transforms(bones, parents, each) for each in angles_flip])
    prior = Prior(
        name="fauna",
        provenance=f"3D-Fauna's files of {len(stems)} frames in {folder.name}; rest mesh by undoing the pose of frame "
        f"{list(stems)[used]}.",
        vertices=(scale * rest).float(),
        faces=faces,
        weights=weights.float(),
        bones=(scale * bones).float(),
        parents=torch.tensor(parents),
        mirror=torch.tensor(MIRROR),
        times=torch.arange(len(stems), dtype=torch.float64) / fps,
        object_to_world=torch.eye(4, dtype=torch.float64).repeat(len(stems), 1, 1),
        cameras=tuple(_scaled(camera, scale) for camera in cameras),
        transforms=_moved(transforms, scale),
        cameras_flip=tuple(_scaled(camera, scale) for camera in cameras_flip),
        transforms_flip=_moved(transforms_flip, scale),
        quality=quality,
        digest="",
    )
    return seal(prior)


def _stems(folder: Path) -> dict[str, str]:
    """Frame name -> file stem, of the latest step, in order of the frames.

    Raises:
        UserError: no folder, or no meshes in it.
    """
    if not folder.is_dir():
        raise UserError(f"{folder}: expected 3D-Fauna's result folder, but there is none.")
    found: dict[str, tuple[int, str]] = {}
    for file in folder.iterdir():
        if match := _NAME.fullmatch(file.name):
            step = int(match["step"])
            if step >= found.get(match["frame"], (-1, ""))[0]:
                found[match["frame"]] = (step, file.name.removesuffix("_mesh.obj"))
    if not found:
        raise UserError(f"{folder}: expected files named <step>_<frame>_mesh.obj as 3D-Fauna's test run writes them.")
    ordered = sorted(found, key=lambda name: (int(name) if name.isdecimal() else 0, name))
    return {frame: found[frame][1] for frame in ordered}


def _frames(
    folder: Path, stems: dict[str, str], boxes: Path | None, size: int, *, flipped: bool
) -> tuple[list[Tensor], list[Camera]]:
    angles, cameras = [], []
    for frame, stem in stems.items():
        angles.append(_numbers(folder / f"{stem}_arti_params.txt", 60).reshape(20, 3))
        pose = _numbers(folder / f"{stem}_pose.txt", 12)
        cameras.append(_placed(_camera(pose), boxes / f"{frame}_box.txt" if boxes else None, size, flipped))
    return angles, cameras


def _camera(pose: Tensor) -> Camera:
    """Fauna's twelve numbers: rows right, up, forward (the transposed rotation), then a translation; OpenGL axes."""
    open_gl = rigid(pose[:9].reshape(3, 3).T, pose[9:] + pose.new_tensor((0.0, 0.0, -OFFSET)))
    world_to_camera = torch.diag(pose.new_tensor((1.0, -1.0, -1.0, 1.0))) @ open_gl
    focal, half = NATIVE / 2 / math.tan(FIELD_OF_VIEW / 2), NATIVE / 2
    intrinsics = pose.new_tensor(((focal, 0.0, half), (0.0, focal, half), (0.0, 0.0, 1.0)))
    return Camera(world_to_camera, intrinsics, NATIVE, NATIVE)


def _placed(camera: Camera, box: Path | None, size: int, flipped: bool) -> Camera:
    """The camera of the crop at another size, or of the whole frame that a box file places the crop in."""
    if box is None:
        return camera.resized(size, size)
    left, top, width, height, full_width, full_height = (int(x) for x in _numbers(box, 8)[1:7])
    if flipped:
        left = full_width - left - width
    return camera.resized(width, height).shifted(-left, -top, full_width, full_height)


def _numbers(path: Path, count: int) -> Tensor:
    """Whitespace-separated numbers, float64, [count].

    Raises:
        UserError: no such file, or other numbers of numbers.
    """
    try:
        values = np.array(path.read_text(encoding="utf-8").split(), dtype=np.float64)
    except OSError as error:
        raise UserError(f"{path}: expected a file of 3D-Fauna, but: {error.strerror}.") from error
    except ValueError as error:
        raise UserError(f"{path}: expected {count} numbers, got text ({error}).") from error
    if len(values) != count or not np.isfinite(values).all():
        raise UserError(f"{path}: expected {count} finite numbers, got {len(values)}.")
    return torch.from_numpy(values)


def _read_obj(path: Path) -> tuple[Tensor, Tensor]:
    """Vertices, float64, [n, 3], and triangles, int64, [f, 3]."""
    vertices, faces = [], []
    try:
        for line in path.read_text(encoding="utf-8").splitlines():
            kind, _, rest = line.partition(" ")
            if kind == "v":
                vertices.append([float(x) for x in rest.split()[:3]])
            elif kind == "f":
                faces.append([int(corner.split("/")[0]) - 1 for corner in rest.split()])
    except (OSError, ValueError) as error:
        raise UserError(f"{path}: expected a mesh as 3D-Fauna writes it, but: {error}.") from error
    table, corners = np.array(vertices, dtype=np.float64), np.array(faces, dtype=np.int64)
    if table.ndim != 2 or corners.ndim != 2 or corners.shape[1] != 3 or corners.max() >= len(table):
        raise UserError(f"{path}: expected a mesh of triangles, got {len(vertices)} vertices and {len(faces)} faces.")
    return torch.from_numpy(table), torch.from_numpy(corners)


def _rest(folder: Path, stems: list[str], angles: list[Tensor]) -> tuple[Tensor, Tensor, int, dict[str, float]]:
    """The most symmetric rest mesh among the first image's and those of the least bent poses; Fauna's are symmetric.

    Returns:
        Vertices, faces, the index of the image they are from, and the figures of the undoing.
    """
    bent = torch.stack(angles).square().sum((1, 2)).argsort().tolist()
    found = []
    for index in dict.fromkeys([0, *bent[:TRIED]]):
        posed, faces = _read_obj(folder / f"{stems[index]}_mesh.obj")
        rest, residual = _unposed(posed, angles[index])
        diagonal = float((rest.amax(0) - rest.amin(0)).norm())
        asymmetry = float(np.mean(cKDTree(rest.numpy()).query(mirror_points(rest).numpy())[0]))
        found.append((asymmetry / diagonal, index, residual / diagonal, rest, faces))
    asymmetry, index, residual, rest, faces = min(found, key=lambda each: each[0])
    return rest, faces, index, {"rest_asymmetry": asymmetry, "unposed_residual": residual}


def _unposed(posed: Tensor, angles: Tensor) -> tuple[Tensor, float]:
    """The rest mesh whose pose is the given one, and how far posing it again stays from that (mean distance)."""
    rest = posed.clone()
    for _ in range(SWEEPS):
        bones, parents = estimate_bones(rest)
        transforms = joint_transforms(bones, parents, angles)
        weights = skinning_weights(rest, bones)
        blended = torch.einsum("nj,jab->nab", weights, transforms)
        lifted = torch.cat((posed, torch.ones_like(posed[:, :1])), dim=1)
        rest = torch.linalg.solve(blended, lifted[..., None])[:, :3, 0]
    bones, parents = estimate_bones(rest)
    again = skin_points(rest, skinning_weights(rest, bones), joint_transforms(bones, parents, angles))
    return rest, float((again - posed).norm(dim=1).mean())


def _scaled(camera: Camera, scale: float) -> Camera:
    moved = camera.world_to_camera.clone()
    moved[:3, 3] *= scale
    return replace(camera, world_to_camera=moved)


def _moved(transforms: Tensor, scale: float) -> Tensor:
    scaled = transforms.clone()
    scaled[..., :3, 3] *= scale
    return scaled.float()
