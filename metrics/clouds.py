"""Point clouds: what is a usable one, seeded draws from it, exact nearest neighbours."""

from collections.abc import Sequence

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from torch import Tensor

Points = NDArray[np.float64]

THREADED = 50_000
"""From this many queries on, two threads are worth their start."""
LARGEST = 1e100
"""Coordinate whose square, and whose products with others, are still numbers."""


def as_points(cloud: Tensor, name: str, empty: bool = False) -> Points:
    """The points in double precision on the CPU, [n, 3].

    Args:
        cloud: finite coordinates, [n, 3].
        name: what it is, as it reads in a sentence ("prediction").
        empty: whether a cloud without points will do.

    Raises:
        ValueError: another shape, a NaN, an infinite or a huge value, no points.
    """
    if cloud.ndim != 2 or cloud.shape[1] != 3:
        raise ValueError(f"expected the {name} as points [n, 3], got {tuple(cloud.shape)}")
    points = cloud.detach().cpu().to(torch.float64).numpy()
    bad = int((~np.isfinite(points)).any(axis=1).sum())
    if bad:
        raise ValueError(f"expected finite points in the {name}, got {bad} of {len(points)} with a NaN or an infinity")
    if len(points) and np.abs(points).max() > LARGEST:
        raise ValueError(f"expected coordinates up to {LARGEST:g} in the {name}, got {np.abs(points).max():.3g}")
    if not len(points) and not empty:
        raise ValueError(f"expected at least one point in the {name}, got none")
    return points


def paired(predictions: Sequence[Tensor], truths: Sequence[Tensor]) -> None:
    """Check that two sequences have the same length, and any.

    Raises:
        ValueError: they have not.
    """
    if len(predictions) != len(truths) or not truths:
        raise ValueError(f"expected one prediction a truth, got {len(predictions)} and {len(truths)} clouds")


def subsample(cloud: Tensor, count: int, seed: int) -> Tensor:
    """At most ``count`` of the points, drawn without replacement, in their own order, [n, 3] -> [min(n, count), 3]."""
    if len(cloud) <= count:
        return cloud
    rows = np.random.default_rng(seed).choice(len(cloud), count, replace=False)
    return cloud[torch.from_numpy(np.sort(rows)).to(cloud.device)]


def box_diagonal(points: Points) -> float:
    """Length of the diagonal of the axis-aligned bounding box, [n, 3] -> a number in the points' unit."""
    return float(np.linalg.norm(np.ptp(points, axis=0)))


def is_straight(points: Points) -> bool:
    """Whether the points lie on one line (or are one point), so that a turn about it would change nothing.

    The second spread is then below 1e-5 of the first: single-precision coordinates are that good.
    """
    if len(points) < 3:
        return True
    spreads = np.linalg.svd(points - points.mean(axis=0), compute_uv=False)
    return bool(spreads[1] <= 1e-5 * spreads[0])


class Cloud:
    """Points with a search tree.

    Attributes:
        points: float64, [n, 3].
    """

    def __init__(self, points: Points) -> None:
        self.points = points
        self._places = _places(points)
        self._tree = cKDTree(self._places)

    def nearest(self, queries: Points) -> tuple[Points, Points]:
        """Euclidean distance to the nearest point, and where that is, [q, 3] -> [q] and [q, 3]."""
        distances, rows = self._tree.query(queries, workers=2 if len(queries) >= THREADED else 1)
        return distances, self._places[rows]


def _places(points: Points) -> Points:
    """The points, each place once: a tree cannot split equal points, and a collapsed cloud would take minutes."""
    # Equal points have equal sums, and counting those is cheap; unequal ones rarely do.
    if len(np.unique(points @ np.array((1.0, np.e, np.pi)))) > len(points) // 2:
        return points
    return np.unique(points, axis=0)
