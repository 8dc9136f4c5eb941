"""Collect a reconstruction's Gaussians over time as clouds of the page's layout."""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import groupby

import numpy as np
import torch
from torch.nn.functional import normalize

from rewild4d.cameras.input_view import finite_at
from rewild4d.contracts import Reconstruction
from rewild4d.harmonics import C0, rotated, seen_colors
from rewild4d.transforms import on_cpu, quat_to_matrix
from rewild4d.types import Camera, Splats
from rewild4d.visualize.report.layout import BITS, Cloud, Frame, curve_order, steps

LEAST_ALPHA = 1 / 255
"""Opacity below which the rasterizer draws a Gaussian nowhere."""
LEAST_SCALE = 1e-6
"""Of the largest standard deviation: what is flatter is written as this flat."""


@dataclass(frozen=True)
class Collected:
    """What a page's player gets, and what it lost on the way.

    Attributes:
        clouds: in the order of time.
        seen: whether colours depend on the view in a way that the layout has no place for: they are those that the
            film's camera sees.
        total: Gaussians, the mean over the moments.
        invisible: of these, left out.
        position_error: largest error of a position, world units.
    """

    clouds: list[Cloud]
    seen: bool
    total: float
    invisible: float
    position_error: float


@torch.no_grad()
def collect(reconstruction: Reconstruction, times: Sequence[float], cameras: Sequence[Camera | None]) -> Collected:
    """Collect the Gaussians at each of some times; those that are visible at none of them are left out.

    Args:
        reconstruction: answers at the times.
        times: seconds, ascending.
        cameras: of the film at each time.

    Raises:
        UserError: it answers with values that are not finite.
    """
    moments = [on_cpu(finite_at(reconstruction, time)) for time in times]
    clouds, seen, shown = [], False, 0
    rows = zip(moments, cameras, strict=True)
    for _, group in groupby(rows, key=lambda row: (len(row[0]), row[0].colors.shape[1])):
        splats, eyes = zip(*group, strict=True)
        visible = torch.stack([each.opacities >= LEAST_ALPHA for each in splats]).any(0)
        frame, colors = _colors([_rows(each, visible) for each in splats], eyes)
        seen = seen or (frame == "rgb" and splats[0].colors.shape[1] > 1)
        clouds.append(_cloud([_rows(each, visible) for each in splats], frame, colors))
        shown += len(splats) * int(visible.sum())
    total = sum(map(len, moments)) / len(moments)
    errors = [float(np.linalg.norm(steps(cloud.tracks["means"], BITS["means"]) / 2)) for cloud in clouds]
    return Collected(clouds, seen, total, total - shown / len(moments), max(errors))


def _cloud(splats: Sequence[Splats], frame: Frame, colors: list[torch.Tensor]) -> Cloud:
    """Lay the same Gaussians of consecutive moments out as a cloud, along a curve through the first moment."""
    means = _stack([each.means for each in splats])
    order = curve_order(means[0]) if means.shape[1] else np.arange(0)
    scales = _stack([each.scales for each in splats])
    floor = max(LEAST_SCALE * float(scales.max(initial=0.0)), 1e-30)
    tracks = {
        "means": means, "quats": _steady_signs(_stack([normalize(each.quats, dim=-1) for each in splats])),
        "scales": np.log(np.maximum(scales, floor)),
        "opacities": _stack([each.opacities[:, None] for each in splats]),
        "colors": _stack([each.flatten(1) for each in colors]),
    }  # fmt: skip
    return Cloud({name: values[:, order] for name, values in tracks.items()}, len(splats), frame)


def _colors(splats: Sequence[Splats], eyes: Sequence[Camera | None]) -> tuple[Frame, list[torch.Tensor]]:
    """Find the frame in which colours stay, and their values there, [n, k, 3] each.

    Coefficients that stay neither in the world nor in the Gaussian's own frame become what the film's camera sees, and
    without one the mean over all directions.
    """
    colors = [each.colors for each in splats]
    if colors[0].shape[1] == 1:
        return "rgb", colors
    if _stay(colors):
        return "world", colors[:1] * len(colors)
    turns = [quat_to_matrix(normalize(each.quats, dim=-1)).transpose(1, 2) for each in splats]
    own = [rotated(each.colors, turn) for each, turn in zip(splats, turns, strict=True)]
    if _stay(own):
        return "own", own[:1] * len(own)
    return "rgb", [_seen(each, camera)[:, None] for each, camera in zip(splats, eyes, strict=True)]


def _seen(splats: Splats, camera: Camera | None) -> torch.Tensor:
    if camera is not None:
        return seen_colors(splats, camera.center)
    return (C0 * splats.colors[:, 0] + 0.5).clamp_min(0)


def _stay(colors: Sequence[torch.Tensor]) -> bool:
    """Tell whether coefficients change by less than one step of eight bits of their span."""
    span = max(float(colors[0].max() - colors[0].min()), 1e-6) if colors[0].numel() else 1.0
    return all(float((each - colors[0]).abs().amax()) < span / 255 for each in colors[1:] if each.numel())


def _steady_signs(quats: np.ndarray) -> np.ndarray:
    """Give quaternions [T, n, 4] the signs by which they change least from moment to moment."""
    first = np.where(quats[:1, :, :1] < 0, -1.0, 1.0)
    flips = np.where((quats[1:] * quats[:-1]).sum(-1, keepdims=True) < 0, -1.0, 1.0)
    return quats * np.cumprod(np.concatenate((first, flips)), axis=0)


def _rows(splats: Splats, rows: torch.Tensor) -> Splats:
    return Splats(splats.means[rows], splats.quats[rows], splats.scales[rows], splats.opacities[rows],
                  splats.colors[rows])  # fmt: skip


def _stack(values: Sequence[torch.Tensor]) -> np.ndarray:
    return torch.stack(list(values)).double().numpy()
