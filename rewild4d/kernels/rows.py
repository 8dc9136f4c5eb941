"""Sums over vectors and rows of any length on the sixteen lanes of simd.py."""

from typing import Any

import numpy as np

from rewild4d.kernels.compiling import inlined, kernel
from rewild4d.kernels.simd import LANES, fma, fold1, fold2, fold4, fold8, load, splat, store
from rewild4d.kernels.tails import load_first, store_first


@inlined
def _four_rows(rows: np.ndarray, first: int, count: int) -> Any:
    zero = splat(np.float32(0))
    if first >= count:
        return zero
    a = load(rows, first * LANES)
    b = load(rows, (first + 1) * LANES) if first + 1 < count else zero
    c = load(rows, (first + 2) * LANES) if first + 2 < count else zero
    d = load(rows, (first + 3) * LANES) if first + 3 < count else zero
    return fold2(fold1(a, b), fold1(c, d))


@inlined
def sum_rows(rows: np.ndarray, count: int, sums: np.ndarray, index: int) -> None:
    """Write the sum of each of ``count`` vectors in ``rows`` to sums[index:], sixteen at a time."""
    for first in range(0, count, LANES):
        near = fold4(_four_rows(rows, first, count), _four_rows(rows, first + 4, count))
        far = fold4(_four_rows(rows, first + 8, count), _four_rows(rows, first + 12, count))
        store(sums, index + first, fold8(near, far))


@inlined
def add_scaled(share: float, source: np.ndarray, start: int, target: np.ndarray, index: int, count: int) -> None:
    """Add ``share`` times source[start : start + count] to target[index:], both 1D."""
    whole = count // LANES * LANES
    factor = splat(share)
    for i in range(0, whole, LANES):
        store(target, index + i, fma(factor, load(source, start + i), load(target, index + i)))
    if whole < count:
        own = load_first(target, index + whole, count - whole, factor)
        own = fma(factor, load_first(source, start + whole, count - whole, factor), own)
        store_first(target, index + whole, count - whole, own)


@kernel
def add_row_sums(rows: np.ndarray, count: int, wide: int, scratch: np.ndarray, sums: np.ndarray) -> None:
    """Add the sum of each of ``count`` rows to ``sums``; both lengths are multiples of sixteen."""
    for row in range(count):
        total = splat(np.float32(0))
        for index in range(row * wide, (row + 1) * wide, LANES):
            total = total + load(rows, index)
        store(scratch, row * LANES, total)
    sum_rows(scratch, count, scratch, 0)
    for row in range(0, count, LANES):
        store(sums, row, load(sums, row) + load(scratch, row))
