"""Starts of the fit: the animal's path and the up direction from cameras and mask centroids."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import normalize

from rewild4d.priors.config import Stage
from rewild4d.priors.hypotheses import SCALE_SPREAD, Hypotheses, cosine_series
from rewild4d.priors.kinematics import rotation_about
from rewild4d.priors.silhouettes import Targets, known_camera, require_mask
from rewild4d.transforms import similarity
from rewild4d.types import Frame

SILHOUETTE_SIDE = 1.5
"""Square root of the average template's mean silhouette area, template units."""
WIDE_BASELINE = 0.2
"""Spread of viewing directions in radians above which they determine the animal's depth."""
LOOKS_AT_ORIGIN = 0.5
"""Cosine of the angle between a camera's view and the world's origin above which the camera looks there."""
STILLNESS = 0.5
"""Damping of the path's cosine terms, per observation and squared order."""


@dataclass(frozen=True)
class Rays:
    """One ray through the centroid of each mask that is not empty.

    Attributes:
        centers: of the cameras, float64, [v, 3].
        directions: unit, float64, [v, 3].
        spans: square root of the silhouette's area at unit distance, float64, [v].
        rights: x axis of each camera, float64, [v, 3].
        downs: y axis of each camera, float64, [v, 3].
        timesteps: index of each ray's time, int64, [v].
    """

    centers: Tensor
    directions: Tensor
    spans: Tensor
    rights: Tensor
    downs: Tensor
    timesteps: Tensor


def mask_rays(frames: Sequence[Frame], timesteps: Sequence[int], name: str) -> Rays:
    """Return rays through the mask centroids, in the world.

    Raises:
        UserError: no mask shows anything, or a frame has no camera.
    """
    require_mask(frames, name)
    rows = []
    for frame, timestep in zip(frames, timesteps, strict=True):
        solid = frame.mask[0].double()
        if not (solid > 0.5).any():
            continue
        camera = known_camera(frame, name)
        v, u = torch.meshgrid(torch.arange(solid.shape[0]) + 0.5, torch.arange(solid.shape[1]) + 0.5, indexing="ij")
        area = solid.sum()
        pixel = torch.stack(((u * solid).sum() / area, (v * solid).sum() / area, torch.tensor(1.0).double()))
        rotation = camera.world_to_camera[:3, :3].double()
        direction = normalize(rotation.T @ torch.linalg.solve(camera.intrinsics.double(), pixel), dim=0)
        span = (area / (camera.intrinsics[0, 0] * camera.intrinsics[1, 1])).sqrt()
        rows.append((camera.center.double(), direction, span, rotation[0], rotation[1], torch.tensor(timestep)))
    return Rays(*(torch.stack(column) for column in zip(*rows, strict=True)))


def spread(directions: Tensor) -> float:
    """Return the largest angle of a direction to the mean direction, radians."""
    mean = normalize(directions.mean(0), dim=0)
    return float(torch.arccos((directions @ mean).clamp(-1, 1)).max())


def trajectory(rays: Rays, count: int) -> Tensor:
    """Return the smooth path that comes closest to all rays, in the world, float64, [count, 3].

    Where the rays hardly differ in direction, depth is unknown: then the path lies in the plane across the view that
    contains the world's origin, since recordings are mostly centred, or where the cameras do not look there, as far
    away as the origin.
    """
    if spread(rays.directions) < WIDE_BASELINE or _same_position(rays):
        return _frontal_path(rays, count)
    terms = min(4, max(1, count // 4))
    series = cosine_series(count, terms).double()[rays.timesteps]
    across = torch.eye(3, dtype=torch.float64) - rays.directions[:, :, None] * rays.directions[:, None, :]
    # unknowns: coefficients [terms, 3]; higher terms are damped, since the outline's centre moves with the view
    system = torch.einsum("vk,vab,vl->kalb", series, across, series)
    wanted = torch.einsum("vk,vab,vb->ka", series, across, rays.centers)
    damping = STILLNESS * len(series) * torch.arange(terms).double().square()
    damping[0] = 1e-9 * len(series)
    system = system.reshape(3 * terms, 3 * terms) + torch.diag(damping.repeat_interleave(3))
    coefficients = torch.linalg.solve(system, wanted.flatten()).reshape(terms, 3)
    return cosine_series(count, terms).double() @ coefficients


def _same_position(rays: Rays) -> bool:
    """Tell whether the cameras' centres differ by less than 5 % of their distance to the origin."""
    middle = rays.centers.mean(0)
    return bool((rays.centers - middle).norm(dim=1).max() < 0.05 * middle.norm() + 1e-9)


def _frontal_path(rays: Rays, count: int) -> Tensor:
    """Return the path in a plane across the view; see `trajectory`."""
    forward = normalize(rays.directions.mean(0), dim=0)
    away = rays.centers.norm(dim=1)
    ahead = -(rays.centers @ forward)
    distance = torch.where(ahead > LOOKS_AT_ORIGIN * away, ahead, away)
    distance = torch.where(distance > 1e-6, distance, torch.ones_like(distance)) / (rays.directions @ forward)
    points = rays.centers + distance[:, None] * rays.directions
    terms = min(4, max(1, count // 4))
    series = cosine_series(count, terms).double()
    return series @ torch.linalg.lstsq(series[rays.timesteps], points).solution


def up_directions(rays: Rays, elevations: Sequence[float]) -> Tensor:
    """Return candidates for the world's up direction, float64, [k, 3].

    Without roll, up is orthogonal to every camera's x axis, and many directions determine it. With one direction only,
    an axis of the world that fits is taken, else candidates come from the camera elevations (degrees).
    """
    mean_up = -normalize(rays.downs.mean(0), dim=0)
    values, vectors = torch.linalg.eigh(rays.rights.T @ rays.rights / len(rays.rights))
    if values[1] > 0.02:
        return (vectors[:, 0] * torch.sign(vectors[:, 0] @ mean_up))[None]
    axes = torch.cat((torch.eye(3), -torch.eye(3))).double()
    level = (rays.rights @ axes.T).abs().amax(0) < 0.02
    closeness = torch.where(level, axes @ mean_up, -1.0)
    if closeness.max() > np.cos(np.radians(60.0)):
        return axes[closeness.argmax()][None]
    forward = normalize(torch.linalg.cross(rays.rights.mean(0), rays.downs.mean(0)), dim=0)
    angles = torch.deg2rad(torch.tensor(elevations, dtype=torch.float64))[:, None]
    return torch.cos(angles) * mean_up - torch.sin(angles) * forward


def working_frame(rays: Rays, path: Tensor, up: Tensor) -> Tensor:
    """Return the similarity working frame -> world, [4, 4]: y up, origin at the path's mean, template units."""
    distance = ((path[rays.timesteps] - rays.centers) * rays.directions).sum(1).clamp_min(1e-6)
    size = torch.median(rays.spans * distance) / SILHOUETTE_SIDE
    helper = torch.eye(3, dtype=torch.float64)[up.abs().argmin()]
    x = normalize(torch.linalg.cross(helper, up), dim=0)
    rotation = torch.stack((x, up, torch.linalg.cross(x, up)), dim=1)
    return similarity(size, rotation, path.mean(0))


def single_view(rays: Rays, working: Tensor) -> Tensor | None:
    """Return the one direction that all cameras look in, in the working frame, [3]; None where directions spread."""
    if spread(rays.directions) >= WIDE_BASELINE:
        return None
    return normalize(working[:3, :3].T @ rays.directions.mean(0), dim=0).float()


def facings(count: int) -> Tensor:
    """Return rotations about y by even shares of the circle, [count, 3, 3]."""
    return rotation_about(1, torch.arange(count) * (2 * torch.pi / count))


def match_areas(guesses: Hypotheses, targets: Targets, stage: Stage) -> None:
    """Set the scale of each guess so that silhouettes cover the masks' area."""
    for _ in range(2):  # the crop hides some of a large one at first
        drawn = guesses.silhouettes(targets, stage).sum((-1, -2, -3))
        guesses.scale = guesses.scale + 0.5 * (targets.masks.sum() / drawn).log() / SCALE_SPREAD
