"""Where the animal is and which way is up, from cameras and mask centroids alone: the starts of the fit."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from rewild4d.errors import UserError
from rewild4d.priors.config import Stage
from rewild4d.priors.hypotheses import SCALE_SPREAD, Hypotheses, cosine_series
from rewild4d.priors.silhouettes import Targets, known_camera
from rewild4d.transforms import similarity
from rewild4d.types import Frame

SILHOUETTE_SIDE = 1.5
"""Square root of the average template's silhouette area over directions, in template units."""
WIDE_BASELINE = 0.2
"""Viewing directions that spread by more (radians) fix the animal's depth; below, its depth is a guess."""
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
        moments: index of each ray's moment, int64, [v].
    """

    centers: Tensor
    directions: Tensor
    spans: Tensor
    rights: Tensor
    downs: Tensor
    moments: Tensor


def mask_rays(frames: Sequence[Frame], moments: Sequence[int], name: str) -> Rays:
    """Return rays through the mask centroids, in the world.

    Raises:
        UserError: no mask holds anything, or a frame has no camera.
    """
    rows = []
    for frame, moment in zip(frames, moments, strict=True):
        solid = frame.mask[0].double()
        if not (solid > 0.5).any():
            continue
        camera = known_camera(frame, name)
        v, u = torch.meshgrid(torch.arange(solid.shape[0]) + 0.5, torch.arange(solid.shape[1]) + 0.5, indexing="ij")
        area = solid.sum()
        pixel = torch.stack(((u * solid).sum() / area, (v * solid).sum() / area, torch.tensor(1.0).double()))
        rotation = camera.world_to_camera[:3, :3].double()
        direction = torch.nn.functional.normalize(
            rotation.T @ torch.linalg.solve(camera.intrinsics.double(), pixel), dim=0
        )
        span = (area / (camera.intrinsics[0, 0] * camera.intrinsics[1, 1])).sqrt()
        rows.append((camera.center.double(), direction, span, rotation[0], rotation[1], torch.tensor(moment)))
    if not rows:
        raise UserError(f"{name}: expected at least one mask that shows the animal, but all {len(frames)} are empty.")
    return Rays(*(torch.stack(column) for column in zip(*rows, strict=True)))


def spread(directions: Tensor) -> float:
    """Return the largest angle of a direction to the mean direction, radians."""
    mean = torch.nn.functional.normalize(directions.mean(0), dim=0)
    return float(torch.arccos((directions @ mean).clamp(-1, 1)).max())


def trajectory(rays: Rays, count: int) -> Tensor:
    """Return the smooth path that comes closest to all rays, in the world, float64, [count, 3].

    Where the rays hardly differ in direction, depth is unknown: then the path lies in the plane across the view that
    holds the world's origin (or, if that is behind the camera, one unit away), since recordings are mostly centred.
    """
    if spread(rays.directions) < WIDE_BASELINE or _same_place(rays):
        return _frontal_path(rays, count)
    terms = min(4, max(1, count // 4))
    series = cosine_series(count, terms).double()[rays.moments]
    across = torch.eye(3, dtype=torch.float64) - rays.directions[:, :, None] * rays.directions[:, None, :]
    # unknowns: coefficients [terms, 3]; higher terms are damped so that a still animal stays still: the outline's
    # centre wanders with the view, and a path that follows it drifts in depth
    system = torch.einsum("vk,vab,vl->kalb", series, across, series)
    wanted = torch.einsum("vk,vab,vb->ka", series, across, rays.centers)
    damping = STILLNESS * len(series) * torch.arange(terms).double().square()
    damping[0] = 1e-9 * len(series)
    system = system.reshape(3 * terms, 3 * terms) + torch.diag(damping.repeat_interleave(3))
    coefficients = torch.linalg.solve(system, wanted.flatten()).reshape(terms, 3)
    return cosine_series(count, terms).double() @ coefficients


def _same_place(rays: Rays) -> bool:
    """Tell whether the cameras' centres are one point next to the distance of the scene."""
    middle = rays.centers.mean(0)
    return bool((rays.centers - middle).norm(dim=1).max() < 0.05 * middle.norm() + 1e-9)


def _frontal_path(rays: Rays, count: int) -> Tensor:
    forward = torch.nn.functional.normalize(rays.directions.mean(0), dim=0)
    distance = -(rays.centers @ forward)
    distance = torch.where(distance > 1e-6, distance, torch.ones_like(distance)) / (rays.directions @ forward)
    points = rays.centers + distance[:, None] * rays.directions
    terms = min(4, max(1, count // 4))
    series = cosine_series(count, terms).double()
    solution = torch.linalg.lstsq(series[rays.moments], points).solution
    return series @ solution


def up_directions(rays: Rays, elevations: Sequence[float]) -> Tensor:
    """Return candidates for the world's up direction, float64, [k, 3].

    Cameras are held without roll, so up is square to every camera's x axis: many directions settle it. With one
    direction only, an axis of the world that fits is taken, else the given camera elevations (degrees) are tried.
    """
    mean_up = -torch.nn.functional.normalize(rays.downs.mean(0), dim=0)
    values, vectors = torch.linalg.eigh(rays.rights.T @ rays.rights / len(rays.rights))
    if values[1] > 0.02:
        return (vectors[:, 0] * torch.sign(vectors[:, 0] @ mean_up))[None]
    axes = torch.cat((torch.eye(3), -torch.eye(3))).double()
    level = (rays.rights @ axes.T).abs().amax(0) < 0.02
    closeness = torch.where(level, axes @ mean_up, -1.0)
    if closeness.max() > np.cos(np.radians(60.0)):
        return axes[closeness.argmax()][None]
    forward = torch.nn.functional.normalize(torch.linalg.cross(rays.rights.mean(0), rays.downs.mean(0)), dim=0)
    angles = torch.deg2rad(torch.tensor(elevations, dtype=torch.float64))[:, None]
    return torch.cos(angles) * mean_up - torch.sin(angles) * forward


def working_frame(rays: Rays, path: Tensor, up: Tensor) -> Tensor:
    """Similarity working frame -> world: y up, origin amid the path, the animal about template size, [4, 4]."""
    distance = ((path[rays.moments] - rays.centers) * rays.directions).sum(1).clamp_min(1e-6)
    size = torch.median(rays.spans * distance) / SILHOUETTE_SIDE
    helper = torch.eye(3, dtype=torch.float64)[up.abs().argmin()]
    x = torch.nn.functional.normalize(torch.linalg.cross(helper, up), dim=0)
    rotation = torch.stack((x, up, torch.linalg.cross(x, up)), dim=1)
    return similarity(size, rotation, path.mean(0))


def single_view(rays: Rays, working: Tensor) -> Tensor | None:
    """Return the one direction all cameras look in, in the working frame, [3]; None where directions spread."""
    if spread(rays.directions) >= WIDE_BASELINE:
        return None
    return torch.nn.functional.normalize(working[:3, :3].T @ rays.directions.mean(0), dim=0).float()


def facings(count: int) -> Tensor:
    """Return rotations about y by even shares of the circle, [count, 3, 3]."""
    angle = torch.arange(count) * (2 * torch.pi / count)
    zero, one = torch.zeros(count), torch.ones(count)
    rows = (angle.cos(), zero, angle.sin(), zero, one, zero, -angle.sin(), zero, angle.cos())
    return torch.stack(rows, -1).unflatten(-1, (3, 3))


def match_areas(guesses: Hypotheses, targets: Targets, stage: Stage) -> None:
    """Set the scale of each guess so that silhouettes cover the masks' area (twice: cropping hides what sticks out)."""
    for _ in range(2):
        drawn = guesses.silhouettes(targets, stage).sum((-1, -2, -3))
        guesses.scale = guesses.scale + 0.5 * (targets.masks.sum() / drawn).log() / SCALE_SPREAD
