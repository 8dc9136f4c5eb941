"""Norms of many gradients in one call, and their scaling; the twin is `torch.nn.utils.clip_grad_norm_`."""

import math

import numpy as np
from torch import Tensor

from rewild4d.kernels.compiling import kernel
from rewild4d.kernels.pointers import floats_at
from rewild4d.kernels.simd import LANES, fma, load, splat, store, take_ticket
from rewild4d.kernels.switch import Kernel
from rewild4d.kernels.threads import run, thread_count

GRADIENTS = Kernel(
    "norms of gradients",
    "31dcb7f87689",
    "rewild4d.ours.gradients:clip_gradients",
    "rewild4d.ours.gradients:all_finite",
    "rewild4d.ours.gradients:_norm",
    "rewild4d.ours.gradients:_flat",
)

CHUNK = 65536
"""Numbers a unit of work holds; sums are added over these, whatever the number of threads."""
SERIAL_BELOW = 8 * CHUNK
"""Numbers for which a second thread is not woken."""


@kernel
def _sums(numbers: np.ndarray, rows: np.ndarray) -> tuple:
    """The sum of squares, and zero or (where one is not finite) NaN; ``rows`` is scratch of 32 numbers."""
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
def _measure(tickets: np.ndarray, places: np.ndarray, found: np.ndarray) -> None:
    """Set found [chunks, 2] from places [chunks, 2], which are addresses and lengths."""
    rows = np.empty(2 * LANES, np.float32)
    while True:
        chunk = take_ticket(tickets)
        if chunk >= len(places):
            return
        found[chunk, 0], found[chunk, 1] = _sums(floats_at(places[chunk, 0], places[chunk, 1]), rows)


@kernel
def _scale(places: np.ndarray, factor: float) -> None:
    share = np.float32(factor)
    for chunk in range(len(places)):
        numbers = floats_at(places[chunk, 0], places[chunk, 1])
        for i in range(len(numbers)):
            numbers[i] *= share


def _chunks(tensors: list[Tensor]) -> np.ndarray:
    """Addresses and lengths of the chunks of tensors, [chunks, 2]."""
    places = []
    for tensor in tensors:
        address, count = tensor.data_ptr(), tensor.numel()
        places += [(address + 4 * i, min(CHUNK, count - i)) for i in range(0, count, CHUNK)]
    return np.array(places, np.int64).reshape(-1, 2)


def measure(tensors: list[Tensor]) -> tuple[float, bool]:
    """The norm of all numbers, and whether each is finite; float32, CPU, without gaps."""
    places = _chunks(tensors)
    found = np.empty((len(places), 2))
    threads = thread_count() if places[:, 1].sum() > SERIAL_BELOW else 1
    run(_measure, [(np.zeros(1, np.int64), places, found)] * threads)
    squares, flaw = found.sum(axis=0).tolist()
    return math.sqrt(squares), flaw == 0


def scale(tensors: list[Tensor], factor: float) -> None:
    """Multiply in place; float32, CPU, without gaps."""
    _scale(_chunks(tensors), factor)
