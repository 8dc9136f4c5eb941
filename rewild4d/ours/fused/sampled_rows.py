"""A few Gaussians stand for all in the gradient of the deformation network's parameters.

That gradient is a sum over the Gaussians, and few of them hold most of it. Each is drawn with a probability in
proportion to the gradient that reaches it, at most 1, and counts one over that probability: the expected sum is the
whole one (importance sampling with systematic draws).
"""

import math

import numpy as np

from rewild4d.kernels.compiling import kernel

ROUNDS = 30
"""Most rounds of finding the limit. After fewer than it needs the draw is smaller than wanted, and as unbiased."""


@kernel
def _certain_from(worth: np.ndarray, wanted: int) -> float:
    """The worth L from which a Gaussian is certain: the sum of min(1, worth / L) is ``wanted``."""
    limit = math.inf
    for _ in range(ROUNDS):
        certain, rest = 0, 0.0
        for value in worth:
            if value >= limit:
                certain += 1
            else:
                rest += value
        if certain >= wanted or rest == 0 or rest / (wanted - certain) >= limit:
            break
        limit = rest / (wanted - certain)
    return limit


@kernel
def _draw(
    far: float, grow: float, quats: np.ndarray, g_means: np.ndarray, g_quats: np.ndarray, g_log_scales: np.ndarray,
    wanted: int, offset: float, rows: np.ndarray, factors: np.ndarray,
) -> int:  # fmt: skip
    count = len(rows)
    worth = np.empty(count, np.float64)
    total = 0.0
    for n in range(count):
        along, square = 0.0, 0.0
        for i in range(4):
            along += g_quats[n, i] * quats[n, i]
        for i in range(4):
            square += (g_quats[n, i] - along * quats[n, i]) ** 2
        for i in range(3):
            square += (far * g_means[n, i]) ** 2 + (grow * g_log_scales[n, i]) ** 2
        worth[n] = math.sqrt(square)
        total += worth[n]
    if not math.isfinite(total):  # what is wrong has to be seen: every Gaussian counts
        for n in range(count):
            rows[n], factors[n] = n, 1
        return count
    limit = _certain_from(worth, wanted)
    chosen, place = 0, offset
    for n in range(count):
        share = 1.0
        if worth[n] < limit:
            share, before = worth[n] / limit, math.floor(place)
            place += share
            if math.floor(place) == before:
                continue
        rows[chosen], factors[chosen] = n, 1 / share
        chosen += 1
    return chosen


def sample_rows(
    far: float, grow: float, quats: np.ndarray, g_means: np.ndarray, g_quats: np.ndarray, g_log_scales: np.ndarray,
    wanted: int, offset: float,
) -> tuple[np.ndarray, np.ndarray]:  # fmt: skip
    """Draw about ``wanted`` of n Gaussians by the gradients of what the network made of them.

    Args:
        far: displacement per unit of output.
        grow: change of log scale per unit of output.
        quats: the turned orientations, unit, [n, 4].
        g_means: [n, 3].
        g_quats: [n, 4].
        g_log_scales: [n, 3].
        wanted: how many, at least 1.
        offset: uniform in [0, 1); the only randomness.

    Returns:
        Rows in rising order, int64 [k], and what each counts, float32 [k]; all rows, counting 1, where a gradient is
        not finite, and none where all are zero.
    """
    rows, factors = np.empty(len(quats), np.int64), np.empty(len(quats), np.float32)
    count = _draw(far, grow, quats, g_means, g_quats, g_log_scales, wanted, offset, rows, factors)
    return rows[:count], factors[:count]
