"""Compute how much of the animal a clip's cameras saw.

A score under one fixed camera and a score under a sweeping one rest on different evidence, so these two numbers are
recorded beside every novel-view score.
"""

import torch
from torch import Tensor

from rewild4d.types import Camera, Clip, Truth

GRID = 48
"""Cells along the longer side of the depth buffer: coarse, so that 10k surface points leave no holes."""
VIEWS = 200
"""Held-out images used, evenly spaced."""


def coverage(clip: Clip, truth: Truth) -> dict[str, float]:
    """Compute coverage statistics of a case.

    Returns:
        foreground: mean share of a held-out image that the animal fills, in [0, 1]; absent where none is held out.
        seen_surface: mean share of the surface visible in a held-out image that some input image showed, at any
            time, in [0, 1]; absent where the data set has no geometry.
    """
    chosen = [truth.held_out[i] for i in evenly_spaced(len(truth.held_out), VIEWS)]
    if not chosen:
        return {}
    result = {"foreground": sum(float(frame.mask.mean()) for frame in chosen) / len(chosen)}
    if truth.surface is None:
        return result
    points = {time: truth.surface(time) for time in sorted({*clip.times, *(frame.time for frame in chosen)})}
    seen = torch.zeros(len(next(iter(points.values()))), dtype=torch.bool)
    for frame in clip.frames:
        if frame.camera is not None:
            seen |= visible(points[frame.time], frame.camera)
    shares = []
    for frame in chosen:
        if frame.camera is not None and (shown := visible(points[frame.time], frame.camera)).any():
            shares.append(float(seen[shown].double().mean()))
    if shares:
        result["seen_surface"] = sum(shares) / len(shares)
    return result


def visible(points: Tensor, camera: Camera, tolerance: float = 0.03) -> Tensor:
    """Find the surface points that a camera sees, by a coarse depth buffer.

    Args:
        points: in the world, [n, 3].
        camera: the view.
        tolerance: depth behind the nearest point of a cell that still counts, as a share of the points' extent.

    Returns:
        Boolean, [n].
    """
    small = camera.resized(
        max(1, round(camera.width * GRID / max(camera.width, camera.height))),
        max(1, round(camera.height * GRID / max(camera.width, camera.height))),
    )
    pixels, depth = small.project(points.double())
    column, row = pixels[:, 0].floor().long(), pixels[:, 1].floor().long()
    inside = (depth > 0) & (column >= 0) & (column < small.width) & (row >= 0) & (row < small.height)
    cell = (row * small.width + column).clamp(0, small.width * small.height - 1)
    nearest = torch.full((small.width * small.height,), torch.inf, dtype=torch.float64)
    nearest.scatter_reduce_(0, cell[inside], depth[inside], "amin")
    extent = float((points.amax(0) - points.amin(0)).norm())
    return inside & (depth <= nearest[cell] + tolerance * extent)


def evenly_spaced(count: int, most: int) -> list[int]:
    """Choose at most so many indices below a count, evenly spaced."""
    return list(range(count)) if count <= most else [i * count // most for i in range(most)]
