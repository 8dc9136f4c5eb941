"""Read the output of 3D-Fauna's test run (design notes, FORMATS 4.8) as a prior.

For each image it has a posed mesh, a pose and joint angles, but neither the rest mesh nor the skinning weights. Bones
and weights are functions of the rest vertices (FORMATS 4.4, 4.5), so an image's rest mesh is the fixed point of undoing
the pose. One image's mesh is kept, and all poses are recomputed with its bones (METHOD, section 2).
"""

import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from scipy.spatial import cKDTree
from torch import Tensor

from rewild4d.errors import UserError
from rewild4d.priors.bodies.tetrapod import MIRROR
from rewild4d.priors.fauna_bones import estimate_bones, joint_transforms, skinning_weights
from rewild4d.priors.fauna_files import frames, read_obj, stems
from rewild4d.priors.io import require_loadable, seal
from rewild4d.transforms import mirror_camera, mirror_points, mirror_transforms, skin_points
from rewild4d.types import OBJECT_DIAGONAL, Camera, Prior

SWEEPS = 12
"""Iterations of undoing the pose; the rest mesh moves by less than a thousandth after a few."""
TRIED = 4
"""Number of least bent poses that are undone; the most symmetric rest mesh is taken."""
FLAT = 1e-3
"""Thickness over length of vertices below which they count as a plane."""


def read_fauna(folder: Path, *, flip: Path | None, boxes: Path | None, size: int, fps: float) -> Prior:
    """Read a result folder.

    Args:
        folder: holds <step>_<frame>_mesh.obj, _pose.txt and _arti_params.txt of every frame.
        flip: the same of the horizontally flipped images; None: exact mirror images.
        boxes: folder of <frame>_box.txt; the cameras are then of the whole frames, else of the crops.
        size: side of the crops in pixels, where there are no boxes.
        fps: frames per second.

    Raises:
        UserError: files are missing or damaged, or `load_prior` would refuse the prior.
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
        cameras=_scaled_cameras(cameras, scale),
        transforms=_scaled(transforms, scale).float(),
        cameras_flip=_scaled_cameras(cameras_flip, scale),
        transforms_flip=_scaled(transforms_flip, scale).float(),
        quality=quality,
        digest="",
    )
    require_loadable(prior, folder)
    return seal(prior)


def _rest(folder: Path, names: list[str], angles: list[Tensor]) -> tuple[Tensor, Tensor, int, dict[str, float]]:
    """Find the most symmetric rest mesh of the first image and the least bent poses; Fauna's are symmetric.

    Returns:
        Vertices, faces, the index of their image, and figures of quality.

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
    """Return the rest mesh of a posed one, and the mean distance to that when it is posed again.

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
    """Run `estimate_bones`.

    Raises:
        ValueError: vertices lie in a plane, too few are low enough to be feet, or a bone has no direction.
    """
    box = " x ".join(f"{side:.3g}" for side in (vertices.amax(0) - vertices.amin(0)).tolist())
    came, height = f"{len(vertices)} vertices in a box of {box}", vertices[:, 1]
    if _is_flat(vertices) or not (height < height.quantile(0.4)).any():
        raise ValueError(f"{came}, too few or too flat")
    bones, parents = estimate_bones(vertices)
    # the bone's frame needs an axis normal to the bone and to x
    if not ((bones[:, 1] - bones[:, 0])[:, 1:].norm(dim=1) > 0).all():
        raise ValueError(f"{came}, where a bone has no length or lies along x")
    return bones, parents


def _is_flat(vertices: Tensor) -> bool:
    """Tell whether points [n, 3] lie nearly in a plane, all in one position, or are not finite."""
    diagonal = (vertices.amax(0) - vertices.amin(0)).norm()
    if not 0 < float(diagonal) < math.inf:
        return True
    centered = (vertices - vertices.mean(0)) / diagonal
    spread = torch.linalg.eigvalsh(centered.T @ centered)
    return bool(spread[0] <= FLAT**2 * spread[2])


def _scaled(transforms: Tensor, scale: float) -> Tensor:
    """Scale the translations, [..., 4, 4]."""
    scaled = transforms.clone()
    scaled[..., :3, 3] *= scale
    return scaled


def _scaled_cameras(cameras: Sequence[Camera], scale: float) -> tuple[Camera, ...]:
    return tuple(replace(camera, world_to_camera=_scaled(camera.world_to_camera, scale)) for camera in cameras)
