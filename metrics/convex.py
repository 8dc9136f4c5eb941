"""Fit keypoints as convex mixtures of a reconstruction's points, for methods without a skeleton.

Animal-in-Motion (scripts/run_benchmark.py at 904a443) reads the keypoints of any mesh so: one matrix of non-negative
rows that sum to one, times the projected vertices. There it is fitted by Adam on the very frames that are scored. Here
it is the exact least-squares solution, and the caller says on which frames.
"""

import numpy as np

from rewild4d.metrics.keypoints import Bools
from rewild4d.metrics.tallies import Floats

LEAST = 3
"""Training frames of a joint below which nothing is fitted for it."""


def convex_map(points: Floats, keypoints: Floats, counted: Bools) -> Floats:
    """Fit the matrix of non-negative rows that sum to one whose product with the points is nearest to the keypoints.

        w = argmin sum over frames of |sum_v w_v x_v - g|^2,  w >= 0,  sum w = 1

    As the weights sum to one the residual is sum_v w_v (x_v - g), so that the solution without the sum's constraint of
    one more equation, sum w = 1, is a multiple of it: non-negative least squares (Lawson & Hanson 1974), then a
    division. Of more points than equations many mixtures fit alike, and this one has few points.

    Args:
        points: of the reconstruction in the training frames, the same ones in every frame, pixels, [F, V, 2].
        keypoints: in these frames, [F, K, 2].
        counted: which of them are used, [F, K].

    Returns:
        Weights, [K, V]; a row of NaN for a joint that fewer than `LEAST` frames show.

    Raises:
        ValueError: other shapes, or a value that is used and not finite.

    Examples:
        >>> rng = np.random.default_rng(0)
        >>> points = rng.random((8, 3, 2))
        >>> truth = points.transpose(0, 2, 1) @ np.array([0.5, 0.25, 0.25])
        >>> convex_map(points, truth[:, None], np.ones((8, 1), bool)).round(6).tolist()
        [[0.5, 0.25, 0.25]]
    """
    from scipy.optimize import nnls

    frames, count = points.shape[:2]
    if points.shape != (frames, count, 2) or keypoints.shape[0] != frames or counted.shape != keypoints.shape[:2]:
        shapes = f"{points.shape}, {keypoints.shape} and {counted.shape}"
        raise ValueError(f"expected points [F, V, 2], keypoints [F, K, 2] and counted [F, K], got {shapes}")
    if not np.isfinite(points).all() or not np.isfinite(keypoints[counted]).all():
        raise ValueError("expected finite points and keypoints, got a NaN or an infinite value")
    unit = np.ptp(points, axis=1).max() or 1.0
    weights = np.full((keypoints.shape[1], count), np.nan)
    for joint, used in enumerate(counted.T):
        if used.sum() >= LEAST:
            offsets = (points[used] - keypoints[used, joint][:, None]) / unit
            equations = np.concatenate((offsets.transpose(0, 2, 1).reshape(-1, count), np.ones((1, count))))
            found = nnls(equations, np.append(np.zeros(len(equations) - 1), 1.0))[0]
            weights[joint] = found / found.sum()
    return weights


def mixed(weights: Floats, points: Floats) -> Floats:
    """Return the keypoints that a convex map reads from points, [K, V] and [T, V, 2] -> [T, K, 2].

    Examples:
        >>> mixed(np.array([[0.5, 0.5]]), np.array([[[0.0, 0.0], [4.0, 2.0]]])).tolist()
        [[[2.0, 1.0]]]
    """
    return np.einsum("kv,tvd->tkd", weights, points)
