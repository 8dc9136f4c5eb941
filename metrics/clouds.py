"""Check point clouds, draw from them by a seed, and find exact nearest neighbours."""

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
"""Largest coordinate; its square, and its products with others, are still finite."""


def as_points(cloud: Tensor, name: str, empty: bool = False) -> Points:
    """Convert a cloud to double precision on the CPU, [n, 3].

    Args:
        cloud: finite coordinates, [n, 3].
        name: of the cloud in an error ("prediction").
        empty: whether a cloud without points is allowed.

    Raises:
        ValueError: another shape, a NaN, an infinite or a huge value, no points.

    Examples:
        >>> as_points(torch.tensor([[1.0, 2.0, float("nan")]]), "truth")
        Traceback (most recent call last):
        ValueError: expected finite points in the truth, got 1 of 1 with a NaN or an infinity
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


def check_paired(predictions: Sequence[Tensor], truths: Sequence[Tensor]) -> None:
    """Raise ValueError where two sequences have different lengths, or none."""
    if len(predictions) != len(truths) or not truths:
        raise ValueError(f"expected one prediction a truth, got {len(predictions)} and {len(truths)} clouds")


def subsample(cloud: Tensor, count: int, seed: int) -> Tensor:
    """Draw at most ``count`` points without replacement, in their own order, [n, 3] -> [min(n, count), 3].

    Examples:
        >>> subsample(torch.arange(300.0).reshape(100, 3), count=5, seed=0).shape
        torch.Size([5, 3])
    """
    if len(cloud) <= count:
        return cloud
    rows = np.random.default_rng(seed).choice(len(cloud), count, replace=False)
    return cloud[torch.from_numpy(np.sort(rows)).to(cloud.device)]


def box_diagonal(points: Points) -> float:
    """Compute the diagonal of the axis-aligned bounding box, [n, 3] -> a length in the points' unit.

    Examples:
        >>> box_diagonal(np.array([[0.0, 0.0, 0.0], [1.0, 2.0, 2.0]]))
        3.0
    """
    return float(np.linalg.norm(np.ptp(points, axis=0)))


EVEN = 16
"""Cells of an even draw along a cloud's median radius: some 4,800 on a sphere, fine enough for an animal's legs."""


def even_rows(points: Points) -> NDArray[np.intp]:
    """Choose one point of each occupied cell of a grid, so that a density of the sampling does not count.

    The cells follow the cloud's size, and the size is that of the points that are left: it is found by repetition. In a
    cell the point that is listed first stays.

    Args:
        points: [n, 3].

    Returns:
        Rows in ascending order, [m]; all of them where the points' size is zero.

    Examples:
        >>> line = np.linspace(0, 1, 101)[:, None] * np.array([1.0, 0, 0])
        >>> crowded = np.concatenate((line, np.tile(line[:10], (50, 1))))
        >>> len(even_rows(crowded)) == len(even_rows(line))
        True
    """
    rows = np.arange(len(points))
    for _ in range(4):
        size = median_radius(points[rows])
        if not size > 0:
            return np.arange(len(points))
        rows = cell_rows(points, size / EVEN)
    return rows


def cell_rows(points: Points, side: float) -> NDArray[np.intp]:
    """Choose the point that is listed first in each occupied cell of a grid; rows in ascending order, [n, 3] -> [m]."""
    cells = np.floor(np.clip(points / side, -(2**62), 2**62)).astype(np.int64)
    return np.sort(np.unique(cells, axis=0, return_index=True)[1])


def median_radius(points: Points) -> float:
    """Compute the median distance from the median of each axis, which few floaters do not move, [n, 3] -> a length."""
    return float(np.median(np.linalg.norm(points - np.median(points, axis=0), axis=1)))


def is_straight(points: Points) -> bool:
    """Return whether the points lie on one line (or are one point), so that no rotation about it is determined.

    The second spread is then below 1e-5 of the first, the accuracy of single-precision coordinates.

    Examples:
        >>> is_straight(np.array([[0.0, 0, 0], [1, 1, 1], [2, 2, 2]]))
        True
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
        self._distinct = _distinct(points)
        self._tree = cKDTree(self._distinct)

    def nearest(self, queries: Points) -> tuple[Points, Points]:
        """Find the nearest point of each query, [q, 3] -> Euclidean distances [q] and points [q, 3]."""
        distances, rows = self._tree.query(queries, workers=2 if len(queries) >= THREADED else 1)
        return distances, self._distinct[rows]


def _distinct(points: Points) -> Points:
    """Drop duplicates where there are many: a tree cannot split equal points, and would take minutes."""
    # Equal points have equal sums, and counting those is cheap; unequal points rarely do.
    if len(np.unique(points @ np.array((1.0, np.e, np.pi)))) > len(points) // 2:
        return points
    return np.unique(points, axis=0)
