"""How an animal turns in the course of a clip, from what a network reads in its frames."""

import math
from dataclasses import replace

import numpy as np
import torch
from scipy.ndimage import gaussian_filter1d
from torch import Tensor

from rewild4d.priors.heading.network import wrapped
from rewild4d.priors.heading.reading import Headings
from rewild4d.priors.paths import cheapest_path

ANGLES = 72
"""Even headings between which the path chooses."""
PACE = math.radians(20.0)
"""Standard deviation of the turn from one frame to the next, up to 1/24 of a second apart."""
SMOOTHING = 0.8
"""Standard deviation in time of what smooths the path, frames."""


def turning(found: Headings, count: int, least: float, pace: float = PACE) -> Tensor:
    """Return by how much the heading at each of ``count`` times differs from the mean; 0 where it hardly turns at all.

    Of all paths it is the one whose readings, in nats below the likeliest, and squared turns, in ``pace``, sum to
    least. Readings of an animal that keeps its heading waver too, so paths that span less than ``least`` do not count.

    Args:
        found: in a frame whose y axis is up.
        count: of times; those that nothing was read of are bridged.
        least: radians.
        pace: standard deviation of the turn from one time to the next, radians.

    Returns:
        Angles about y, from z to x, without jumps, radians, [count].
    """
    angles = _even()
    costs = torch.zeros(count, ANGLES)
    costs.index_add_(0, found.timesteps, found.nats(_heads(angles[:, None].expand(-1, count))).T)
    turns = 0.5 * (wrapped(angles[:, None] - angles) / pace).square()
    rows = cheapest_path(costs, turns)
    path = gaussian_filter1d(np.unwrap(angles[rows].double().numpy()), SMOOTHING, mode="nearest")
    return torch.from_numpy(path - path.mean()).float() if np.ptp(path) >= least else torch.zeros(count)


def along(found: Headings, turn: Tensor) -> Headings:
    """Return the same readings, counted from the likeliest heading of an animal that turns, in the mean over frames.

    Counted from the likeliest constant heading, one that turns would have a negative `Headings.distance`.

    Args:
        found: in a frame whose y axis is up.
        turn: of `turning`, [T].
    """
    if not turn.any():
        return found
    return replace(found, scores=found.scores + found.distance(_heads(_even()[:, None] + turn)).min())


def _even() -> Tensor:
    return torch.arange(ANGLES) * (2 * math.pi / ANGLES) - math.pi


def _heads(angles: Tensor) -> Tensor:
    """Return the directions of angles about y, from z to x, [...] -> [..., 3]."""
    return torch.stack((angles.sin(), torch.zeros_like(angles), angles.cos()), dim=-1)
