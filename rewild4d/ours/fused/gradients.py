"""Norm and scaling of many gradients in one call."""

import math

import numpy as np
from torch import Tensor

from rewild4d.kernels.compiling import kernel
from rewild4d.kernels.pointers import floats_at
from rewild4d.kernels.simd import LANES, fma, load, splat, store, take_ticket
from rewild4d.kernels.switch import Kernel
from rewild4d.kernels.threads import run_tickets

GRADIENTS = Kernel(
    "norms of gradients",
    "8b8939834425",
    "rewild4d.ours.gradients:clip_gradients",
    "rewild4d.ours.gradients:all_finite",
    "rewild4d.ours.gradients:_norm",
    "rewild4d.ours.gradients:_flat",
)

CHUNK = 65536
"""Numbers of a unit of work; sums run over units, so they do not depend on the number of threads."""
SERIAL_BELOW = 8 * CHUNK
"""Count of numbers below which one thread is used."""


@kernel
def _sums(numbers: np.ndarray, rows: np.ndarray) -> tuple:
    """Return the sum of squares, and NaN where a number is not finite, else 0; ``rows`` is scratch of 32 numbers."""
    zero = splat(np.float32(0))
    a, b, c, d, e, f = zero, zero, zero, zero, zero, zero
    whole = len(numbers) // (4 * LANES) * (4 * LANES)
    # Six sums at once: one alone would wait for its own last addition.
    for i in range(0, whole, 4 * LANES):
        p, q = load(numbers, i), load(numbers, i + LANES)
        r, s = load(numbers, i + 2 * LANES), load(numbers, i + 3 * LANES)
        a, b, c, d = fma(p, p, a), fma(q, q, b), fma(r, r, c), fma(s, s, d)
        e, f = fma(q, zero, fma(p, zero, e)), fma(s, zero, fma(r, zero, f))
    store(rows, 0, (a + b) + (c + d))
    store(rows, LANES, e + f)
    total, flaw = 0.0, np.float32(0)
    for i in range(LANES):
        total += rows[i]
        flaw += rows[LANES + i]
    for i in range(whole, len(numbers)):
        total += numbers[i] * numbers[i]
        flaw += numbers[i] * np.float32(0)
    return total, flaw


@kernel
def _measure(tickets: np.ndarray, spans: np.ndarray, found: np.ndarray) -> None:
    """Set found [chunks, 2] from spans [chunks, 2]: addresses and lengths."""
    rows = np.empty(2 * LANES, np.float32)
    while True:
        chunk = take_ticket(tickets)
        if chunk >= len(spans):
            return
        found[chunk, 0], found[chunk, 1] = _sums(floats_at(spans[chunk, 0], spans[chunk, 1]), rows)


@kernel
def _scale(spans: np.ndarray, factor: float) -> None:
    share = np.float32(factor)
    for chunk in range(len(spans)):
        numbers = floats_at(spans[chunk, 0], spans[chunk, 1])
        for i in range(len(numbers)):
            numbers[i] *= share


def _chunks(tensors: list[Tensor]) -> np.ndarray:
    """Return addresses and lengths of the chunks of tensors, [chunks, 2]."""
    spans = []
    for tensor in tensors:
        address, count = tensor.data_ptr(), tensor.numel()
        spans += [(address + 4 * i, min(CHUNK, count - i)) for i in range(0, count, CHUNK)]
    return np.array(spans, np.int64).reshape(-1, 2)


def measure(tensors: list[Tensor]) -> tuple[float, bool]:
    """Return the norm of all numbers, and whether all are finite; packed float32 tensors on the CPU."""
    spans = _chunks(tensors)
    found = np.empty((len(spans), 2))
    run_tickets(_measure, spans, found, threads=None if spans[:, 1].sum() > SERIAL_BELOW else 1)
    squares, flaw = found.sum(axis=0).tolist()
    return math.sqrt(squares), flaw == 0


def scale(tensors: list[Tensor], factor: float) -> None:
    """Multiply packed float32 tensors on the CPU in place."""
    _scale(_chunks(tensors), factor)
