"""Read keypoints and tracked points of a reconstruction in the images of a film."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from rewild4d.cameras.input_view import finite_at, input_camera
from rewild4d.contracts import Articulated, Reconstruction
from rewild4d.errors import UserError
from rewild4d.io.sampling import OPACITY
from rewild4d.metrics.clouds import even_rows, subsample
from rewild4d.priors.bodies.tetrapod import PARENTS
from rewild4d.priors.kinematics import moved
from rewild4d.priors.landmarks import LANDMARKS
from rewild4d.rasterizer import rasterize

if TYPE_CHECKING:
    from rewild4d.types import Camera, Frame, Splats

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]

MOST_POINTS = 1000
"""Points of a reconstruction that are tracked through a film."""
TIP = 0.98
"""A bone without a child ends where this share of its Gaussians lies before the end."""
BEHIND = 0.05
"""A point is hidden that lies this far behind the drawn surface, in radii of the Gaussians."""


class NotThere(Exception):
    """Why a reconstruction has no such points, as a part of a sentence."""


@dataclass(frozen=True)
class Tracks:
    """Points of a reconstruction in the images of a film.

    Attributes:
        points: (column, row) in pixels of each frame's image, float64, [T, n, 2].
        seen: inside of the image and not hidden behind the drawn surface (points), or inside of the image (joints,
            which lie inside of the body), bool, [T, n].
    """

    points: Floats
    seen: Bools


@torch.no_grad()
def bone_ends(reconstruction: Articulated) -> Tensor:
    """Return start (pivot) and end of each of the template's 20 bones at rest, object frame, [J, 2, 3].

    A bone ends where the next one begins (at the middle of those that begin there). Of one without a child the end is
    not saved: it lies on the line from the pivot to the middle of the bone's Gaussians, as far as `TIP` of them reach.

    Raises:
        NotThere: another skeleton than the template's, or a last bone without Gaussians.
    """
    if tuple(reconstruction.parents.tolist()) != PARENTS:
        raise NotThere("its skeleton is not the template's of 20 bones, to which keypoints are mapped")
    pivots, ends = reconstruction.pivots.cpu(), reconstruction.pivots.clone().cpu()
    splats, owners = reconstruction.canonical(), reconstruction.weights.argmax(1).cpu()
    means, solid = splats.means.cpu(), (splats.opacities >= OPACITY).cpu()
    for bone in range(len(PARENTS)):
        following = _chain(bone)
        if following:
            ends[bone] = pivots[following].mean(0)
            continue
        own = means[solid & (owners == bone)] - pivots[bone]
        if not len(own):
            raise NotThere(f"no Gaussian belongs to bone {bone}, so that its end is not known")
        direction = torch.nn.functional.normalize(own.mean(0), dim=0)
        ends[bone] = pivots[bone] + direction * torch.quantile(own @ direction, TIP)
    return torch.stack((pivots, ends), dim=1)


def _chain(bone: int) -> list[int]:
    """Return the bones that begin where a bone of the same tube ends: limbs begin beside the body, not at its end."""
    limbs = {10, 13, 16, 19}
    return [child for child, parent in enumerate(PARENTS) if parent == bone and child not in limbs]


@torch.no_grad()
def joint_tracks(
    reconstruction: Reconstruction, mapping: Mapping[str, str], names: Sequence[str], frames: Sequence[Frame]
) -> Tracks:
    """Return the joints of an articulated reconstruction by the names of a data set's keypoints.

    Args:
        reconstruction: of the film.
        mapping: keypoint -> landmark of the template (`priors.landmarks.load_mapping`).
        names: of the keypoints, in the wanted order; each is in the mapping.
        frames: whose images and times; cameras are the frames' own or the reconstruction's.

    Raises:
        NotThere: it has no skeleton, or another one than the template's, or no camera.
        UserError: its skeleton holds a NaN.
    """
    if not isinstance(reconstruction, Articulated):
        raise NotThere("this method has no skeleton")
    ends = bone_ends(reconstruction)
    bones, along = zip(*(LANDMARKS[mapping[name]] for name in names), strict=True)
    start, end = ends[list(bones)].unbind(1)
    rest = start + torch.tensor(along)[:, None] * (end - start)
    points = []
    for frame in frames:
        transforms, object_to_world = reconstruction.articulation(frame.time)
        posed = moved(rest.double(), transforms.cpu().double()[list(bones)])
        points.append(posed @ object_to_world[:3, :3].cpu().double().T + object_to_world[:3, 3].cpu().double())
        if not bool(points[-1].isfinite().all()):
            raise UserError(f"the reconstruction's joints at {frame.time:.4f} s hold a NaN or an infinite value.")
    pixels, ahead = _projected(points, _cameras(reconstruction, frames))
    return Tracks(pixels, ahead)


@torch.no_grad()
def point_tracks(reconstruction: Reconstruction, frames: Sequence[Frame], most: int = MOST_POINTS) -> Tracks:
    """Return centres of Gaussians, the same ones in every frame, evenly over the body at the first one.

    Args:
        reconstruction: of the film; Gaussians of an opacity of at least `OPACITY` at the first frame count.
        frames: whose images and times; cameras are the frames' own or the reconstruction's.
        most: points; of more so many are drawn by a fixed seed.

    Raises:
        NotThere: no Gaussian, other Gaussians at other moments, or no camera.
    """
    moments = [finite_at(reconstruction, frame.time) for frame in frames]
    if len({len(splats) for splats in moments}) > 1:
        raise NotThere("its Gaussians are not the same ones at every moment")
    solid = torch.nonzero(moments[0].opacities.cpu() >= OPACITY)[:, 0]
    if not len(solid):
        raise NotThere("no Gaussian is drawn")
    even = even_rows(moments[0].means.cpu()[solid].double().numpy())
    rows = subsample(solid[torch.from_numpy(even)], most, seed=0)
    cameras = _cameras(reconstruction, frames)
    pixels, ahead = _projected([splats.means.cpu()[rows].double() for splats in moments], cameras)
    hidden = [_hidden(splats, rows, camera) for splats, camera in zip(moments, cameras, strict=True)]
    return Tracks(pixels, ahead & ~np.stack(hidden))


def _hidden(splats: Splats, rows: Tensor, camera: Camera) -> Bools:
    """Return which Gaussians lie behind what is drawn at their pixel, bool, [n]; where nothing is drawn none is."""
    pose = camera.world_to_camera.double()
    depths = splats.means.cpu().double() @ pose[2, :3] + pose[2, 3]
    middle = float(depths.mean())
    radius = float((splats.means - splats.means.mean(0)).norm(dim=1).quantile(TIP))
    feature = ((depths - middle) / radius).float()[:, None].to(splats.means.device)
    sums, alpha, _ = rasterize(
        splats.means, splats.quats, splats.scales, splats.opacities, feature,
        pose[None].to(splats.means), camera.intrinsics[None].to(splats.means), camera.width, camera.height,
    )  # fmt: skip
    drawn = (sums[0, 0] / alpha[0, 0].clamp_min(1e-6)).cpu().double()
    drawn = torch.where(alpha[0, 0].cpu() >= 0.5, drawn, torch.inf)
    pixels, _ = camera.project(splats.means.cpu()[rows].double())
    columns, lines = (pixels[:, axis].floor().long() for axis in (0, 1))
    columns, lines = columns.clamp(0, camera.width - 1), lines.clamp(0, camera.height - 1)
    return np.asarray(((depths[rows] - middle) / radius > drawn[lines, columns] + BEHIND).numpy(), dtype=bool)


def _cameras(reconstruction: Reconstruction, frames: Sequence[Frame]) -> list[Camera]:
    cameras = [input_camera(reconstruction, frame) for frame in frames]
    found = [camera for camera in cameras if camera is not None]
    if len(found) < len(frames):
        raise NotThere("neither the data set nor the reconstruction knows the cameras")
    return found


def _projected(points: Sequence[Tensor], cameras: Sequence[Camera]) -> tuple[Floats, Bools]:
    """Return pixels [T, n, 2] of world points, and which are before the camera and inside of the image [T, n]."""
    pixels, inside = [], []
    for moment, camera in zip(points, cameras, strict=True):
        at, depth = camera.project(moment)
        size = at.new_tensor((camera.width, camera.height))
        pixels.append(at.numpy())
        inside.append(((depth > 0) & (at >= 0).all(1) & (at <= size).all(1)).numpy())
    return np.stack(pixels), np.stack(inside)
