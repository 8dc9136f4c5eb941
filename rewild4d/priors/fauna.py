"""Read what 3D-Fauna's test run writes (design notes, FORMATS 4.8) as a prior.

Per image it leaves a posed mesh, a pose and joint angles, but neither the rest mesh nor the skinning weights. Bones and
weights are functions of the rest vertices (FORMATS 4.4, 4.5), so the rest mesh of an image is found as the fixed point
of undoing the pose. One image's mesh is kept and all poses are recomputed with its bones (METHOD, section 2).
"""

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from scipy.spatial import cKDTree
from torch import Tensor

from rewild4d.errors import UserError
from rewild4d.priors.fauna_bones import estimate_bones, joint_transforms, skinning_weights
from rewild4d.priors.fauna_files import frames, read_obj, stems
from rewild4d.priors.io import require_loadable, seal
from rewild4d.priors.template import MIRROR
from rewild4d.transforms import mirror_camera, mirror_points, mirror_transforms, skin_points
from rewild4d.types import OBJECT_DIAGONAL, Camera, Prior

SWEEPS = 12
"""Rounds of undoing the pose; the rest mesh moves by less than a thousandth after a few."""
TRIED = 4
"""Least bent poses that are undone; the most symmetric rest mesh is taken."""
FLAT = 1e-3
"""Thickness over length of a cloud of vertices below which it is a plane: no animal is that thin."""


def read_fauna(folder: Path, *, flip: Path | None, boxes: Path | None, size: int, fps: float) -> Prior:
    """Read a result folder.

    Args:
        folder: holds <step>_<frame>_mesh.obj, _pose.txt and _arti_params.txt of every frame.
        flip: the same of the horizontally flipped images; None: exact mirror images.
        boxes: folder of <frame>_box.txt; the cameras are then of the whole frames, else of the crops.
        size: side of the crops in pixels, where there are no boxes.
        fps: frames per second.

    Raises:
        UserError: files are missing or hold something else, or `load_prior` would refuse what comes of them.
    """
    stem_of = stems(folder)
    angles, cameras = frames(folder, stem_of, boxes, size, flipped=False)
    rest, faces, used, quality = _rest(folder, list(stem_of.values()), angles)
    bones, parents = estimate_bones(rest)
    weights = skinning_weights(rest, bones)
    scale = OBJECT_DIAGONAL / float((rest.amax(0) - rest.amin(0)).norm())
    transforms = torch.stack([joint_transforms(bones, parents, each) for each in angles])
    cameras_flip = [mirror_camera(camera) for camera in cameras]
    transforms_flip = mirror_transforms(transforms, torch.tensor(MIRROR))
    if flip is not None:
        other = stems(flip)
        lacking = [frame for frame in stem_of if frame not in other]
        if lacking:
            raise UserError(f"{flip}: expected the frames of {folder}, but {', '.join(lacking[:3])} are missing.")
        kept = {frame: other[frame] for frame in stem_of}
        angles_flip, cameras_flip = frames(flip, kept, boxes, size, flipped=True)
        transforms_flip = torch.stack([joint_transforms(bones, parents, each) for each in angles_flip])
    prior = Prior(
        name="fauna",
        provenance=f"3D-Fauna's files of {len(stem_of)} frames in {folder.name}; rest mesh by undoing the pose of "
        f"frame {list(stem_of)[used]}.",
        vertices=(scale * rest).float(),
        faces=faces,
        weights=weights.float(),
        bones=(scale * bones).float(),
        parents=torch.tensor(parents),
        mirror=torch.tensor(MIRROR),
        times=torch.arange(len(stem_of), dtype=torch.float64) / fps,
        object_to_world=torch.eye(4, dtype=torch.float64).repeat(len(stem_of), 1, 1),
        cameras=tuple(_scaled(camera, scale) for camera in cameras),
        transforms=_moved(transforms, scale),
        cameras_flip=tuple(_scaled(camera, scale) for camera in cameras_flip),
        transforms_flip=_moved(transforms_flip, scale),
        quality=quality,
        digest="",
    )
    require_loadable(prior, folder)
    return seal(prior)


def _rest(folder: Path, names: list[str], angles: list[Tensor]) -> tuple[Tensor, Tensor, int, dict[str, float]]:
    """The most symmetric rest mesh among the first image's and those of the least bent poses; Fauna's are symmetric.

    Returns:
        Vertices, faces, the index of the image they are from, and the figures of the undoing.

    Raises:
        UserError: a mesh cannot be read, or has no room for bones.
    """
    bent = torch.stack(angles).square().sum((1, 2)).argsort().tolist()
    found = []
    for index in dict.fromkeys([0, *bent[:TRIED]]):
        mesh = folder / f"{names[index]}_mesh.obj"
        posed, faces = read_obj(mesh)
        try:
            rest, residual = _unposed(posed, angles[index])
        except (ValueError, torch.linalg.LinAlgError) as error:
            raise UserError(f"{mesh}: expected a mesh with room for bones, posed and at rest, got {error}.") from error
        diagonal = float((rest.amax(0) - rest.amin(0)).norm())
        asymmetry = float(np.mean(cKDTree(rest.numpy()).query(mirror_points(rest).numpy())[0]))
        found.append((asymmetry / diagonal, index, residual / diagonal, rest, faces))
    asymmetry, index, residual, rest, faces = min(found, key=lambda each: each[0])
    return rest, faces, index, {"rest_asymmetry": asymmetry, "unposed_residual": residual}


def _unposed(posed: Tensor, angles: Tensor) -> tuple[Tensor, float]:
    """Return the rest mesh whose pose is the given one, and how far posing it again stays from that (mean distance).

    Raises:
        ValueError: there is no room for bones.
    """
    rest = posed.clone()
    for _ in range(SWEEPS):
        bones, parents = _bones(rest)
        transforms = joint_transforms(bones, parents, angles)
        weights = skinning_weights(rest, bones)
        blended = torch.einsum("nj,jab->nab", weights, transforms)
        lifted = torch.cat((posed, torch.ones_like(posed[:, :1])), dim=1)
        rest = torch.linalg.solve(blended, lifted[..., None])[:, :3, 0]
    bones, parents = _bones(rest)
    again = skin_points(rest, skinning_weights(rest, bones), joint_transforms(bones, parents, angles))
    return rest, float((again - posed).norm(dim=1).mean())


def _bones(vertices: Tensor) -> tuple[Tensor, tuple[int, ...]]:
    """Run `estimate_bones` on vertices that have room for bones.

    Raises:
        ValueError: they lie in a plane, too few of them are low enough to be feet, or a bone has no direction.
    """
    box = " x ".join(f"{side:.3g}" for side in (vertices.amax(0) - vertices.amin(0)).tolist())
    came, height = f"{len(vertices)} vertices in a box of {box}", vertices[:, 1]
    if _is_flat(vertices) or not (height < height.quantile(0.4)).any():
        raise ValueError(f"{came}, too few or too flat")
    bones, parents = estimate_bones(vertices)
    # A bone's frame has an axis normal to the bone and to x, which a bone along x lacks.
    if not ((bones[:, 1] - bones[:, 0])[:, 1:].norm(dim=1) > 0).all():
        raise ValueError(f"{came}, where a bone has no length or lies along x")
    return bones, parents


def _is_flat(vertices: Tensor) -> bool:
    """Tell whether points lie (nearly) in a plane, whichever way it is turned, or are no shape at all, [n, 3]."""
    diagonal = (vertices.amax(0) - vertices.amin(0)).norm()
    if not 0 < float(diagonal) < math.inf:
        return True
    centered = (vertices - vertices.mean(0)) / diagonal
    spread = torch.linalg.eigvalsh(centered.T @ centered)
    return bool(spread[0] <= FLAT**2 * spread[2])


def _scaled(camera: Camera, scale: float) -> Camera:
    moved = camera.world_to_camera.clone()
    moved[:3, 3] *= scale
    return replace(camera, world_to_camera=moved)


def _moved(transforms: Tensor, scale: float) -> Tensor:
    scaled = transforms.clone()
    scaled[..., :3, 3] *= scale
    return scaled.float()
