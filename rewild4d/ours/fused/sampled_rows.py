"""Importance sampling of Gaussians for the gradient of the deformation network's parameters.

That gradient is a sum over the Gaussians, and few of them hold most of it. Each is drawn with a probability (at most 1)
in proportion to the gradient that reaches it, and weighted by one over that: the expected sum is the whole one.
"""

import math

import numpy as np

from rewild4d.kernels.compiling import kernel
from rewild4d.kernels.simd import take_ticket
from rewild4d.kernels.threads import run_tickets

ROUNDS = 30
"""Most iterations for the limit; if they do not suffice, the sample is smaller than wanted but still unbiased."""
CHUNK = 2048
"""Gaussians of a unit of work; sums run over units, so they do not depend on the number of threads."""


@kernel
def _weigh(
    tickets: np.ndarray, far: float, grow: float, quats: np.ndarray, g_means: np.ndarray, g_quats: np.ndarray,
    g_log_scales: np.ndarray, worth: np.ndarray, totals: np.ndarray,
) -> None:  # fmt: skip
    """Set the worth [n] of each Gaussian, the norm of its gradient, and its sum over each chunk."""
    while True:
        chunk = take_ticket(tickets)
        if chunk >= len(totals):
            return
        total = 0.0
        for n in range(chunk * CHUNK, min((chunk + 1) * CHUNK, len(worth))):
            along, square = 0.0, 0.0
            for i in range(4):
                along += g_quats[n, i] * quats[n, i]
            for i in range(4):
                square += (g_quats[n, i] - along * quats[n, i]) ** 2
            for i in range(3):
                square += (far * g_means[n, i]) ** 2 + (grow * g_log_scales[n, i]) ** 2
            worth[n] = math.sqrt(square)
            total += worth[n]
        totals[chunk] = total


@kernel
def _certain_from(worth: np.ndarray, wanted: int) -> float:
    """Return the limit L beyond which a Gaussian is always drawn: the sum of min(1, worth / L) is ``wanted``."""
    limit, whole = math.inf, len(worth) // 4 * 4
    for _ in range(ROUNDS):
        certain = 0
        a, b, c, d = 0.0, 0.0, 0.0, 0.0
        # Four sums at once: one alone would wait for its own last addition.
        for n in range(0, whole, 4):
            p, q, r, s = worth[n] >= limit, worth[n + 1] >= limit, worth[n + 2] >= limit, worth[n + 3] >= limit
            certain += p + q + r + s
            a, b = a + (0.0 if p else worth[n]), b + (0.0 if q else worth[n + 1])
            c, d = c + (0.0 if r else worth[n + 2]), d + (0.0 if s else worth[n + 3])
        for n in range(whole, len(worth)):
            certain += worth[n] >= limit
            a += 0.0 if worth[n] >= limit else worth[n]
        rest = (a + b) + (c + d)
        if certain >= wanted or rest == 0 or rest / (wanted - certain) >= limit:
            break
        limit = rest / (wanted - certain)
    return limit


@kernel
def _draw(worth: np.ndarray, wanted: int, offset: float, rows: np.ndarray, factors: np.ndarray) -> int:
    """Set the rows that are drawn and their weights, and return their number."""
    limit = _certain_from(worth, wanted)
    chosen, position = 0, offset
    for n in range(len(worth)):
        share = 1.0
        if worth[n] < limit:
            share, before = worth[n] / limit, math.floor(position)
            position += share
            if math.floor(position) == before:
                continue
        rows[chosen], factors[chosen] = n, 1 / share
        chosen += 1
    return chosen


def sample_rows(
    far: float, grow: float, quats: np.ndarray, g_means: np.ndarray, g_quats: np.ndarray, g_log_scales: np.ndarray,
    wanted: int, offset: float,
) -> tuple[np.ndarray, np.ndarray]:  # fmt: skip
    """Draw about ``wanted`` of n Gaussians in proportion to the gradients of the network's outputs.

    ``far`` and ``grow`` are displacement and change of log scale per unit of output; ``offset`` in [0, 1) is the only
    randomness. Returns ascending rows and their weights [k]: all with weight 1 where a gradient is not finite, none
    where all are zero.
    """
    count = len(quats)
    worth, totals = np.empty(count), np.empty(-(-count // CHUNK))
    run_tickets(_weigh, far, grow, quats, g_means, g_quats, g_log_scales, worth, totals)
    if not math.isfinite(totals.sum()):  # what is wrong has to be seen: every Gaussian counts
        return np.arange(count), np.ones(count, np.float32)
    rows, factors = np.empty(count, np.int64), np.empty(count, np.float32)
    chosen = _draw(worth, wanted, offset, rows, factors)
    return rows[:chosen], factors[:chosen]
