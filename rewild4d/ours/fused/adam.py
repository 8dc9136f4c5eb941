"""Adam over many tensors in one call.

The twin is torch's own (`torch.optim.Adam`), whose fused kernel runs on one thread where torch is given one.
"""

import math

import numpy as np

from rewild4d.kernels.compiling import kernel
from rewild4d.kernels.pointers import floats_at
from rewild4d.kernels.simd import take_ticket
from rewild4d.kernels.threads import run, thread_count

CHUNK = 16384
"""Numbers a unit of work holds."""
SERIAL_BELOW = 4 * CHUNK
"""Numbers for which a second thread is not woken."""


@kernel
def _begin(places: np.ndarray, rates: np.ndarray, factors: np.ndarray, firsts: np.ndarray) -> None:
    """Count one step of each tensor; set its factors [tensors, 7] and the number of the chunk it begins with."""
    firsts[0] = 0
    for i in range(len(places)):
        rate, beta, beta_sq, eps = rates[i, 0], rates[i, 1], rates[i, 2], rates[i, 3]
        step = floats_at(places[i, 4], 1)
        step[0] += np.float32(1)
        factors[i, 0], factors[i, 1] = beta, 1 - beta
        factors[i, 2], factors[i, 3] = beta_sq, 1 - beta_sq
        factors[i, 4] = rate / (1 - beta ** step[0])
        factors[i, 5] = math.sqrt(1 - beta_sq ** step[0])
        factors[i, 6] = eps
        firsts[i + 1] = firsts[i] + (places[i, 5] + CHUNK - 1) // CHUNK


@kernel
def _move(value: np.ndarray, slope: np.ndarray, mean: np.ndarray, square: np.ndarray, factors: np.ndarray) -> None:
    keep, add, keep_sq, add_sq = factors[0], factors[1], factors[2], factors[3]
    rate, root, eps = factors[4], factors[5], factors[6]
    for i in range(len(value)):
        g = slope[i]
        m = keep * mean[i] + add * g
        v = keep_sq * square[i] + add_sq * g * g
        mean[i], square[i] = m, v
        value[i] -= rate * m / (math.sqrt(v) / root + eps)


@kernel
def _update(tickets: np.ndarray, places: np.ndarray, factors: np.ndarray, firsts: np.ndarray) -> None:
    i = 0
    while True:
        chunk = take_ticket(tickets)
        if chunk >= firsts[-1]:
            return
        while chunk >= firsts[i + 1]:
            i += 1
        begin = (chunk - firsts[i]) * CHUNK
        count, start = min(CHUNK, places[i, 5] - begin), 4 * begin
        _move(
            floats_at(places[i, 0] + start, count), floats_at(places[i, 1] + start, count),
            floats_at(places[i, 2] + start, count), floats_at(places[i, 3] + start, count), factors[i],
        )  # fmt: skip


def adam_step(places: list[tuple[int, ...]], rates: list[tuple[float, ...]]) -> None:
    """One step of Adam, in place.

    Args:
        places: of each tensor the addresses of its values, gradient, mean, mean of squares and step, all float32, and
            its length, [tensors, 6].
        rates: of each tensor the learning rate, the two betas and eps, [tensors, 4].
    """
    table, count = np.array(places, np.int64), len(places)
    factors, firsts = np.empty((count, 7), np.float32), np.empty(count + 1, np.int64)
    _begin(table, np.array(rates), factors, firsts)
    threads = thread_count() if table[:, 5].sum() > SERIAL_BELOW else 1
    run(_update, [(np.zeros(1, np.int64), table, factors, firsts)] * threads)
