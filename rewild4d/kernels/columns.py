"""Transpose rows in memory to columns of lanes and back: each number of many Gaussians side by side."""

from typing import Any

import numpy as np

from rewild4d.kernels.compiling import inlined, kernel
from rewild4d.kernels.matrix import transpose_tile
from rewild4d.kernels.simd import LANES, load
from rewild4d.kernels.tails import store_first

BLOCK = 64
"""Gaussians side by side."""


@inlined
def load_four(numbers: np.ndarray, index: int, step: int) -> tuple[Any, Any, Any, Any]:
    """Load four vectors, ``step`` numbers apart."""
    return (
        load(numbers, index),
        load(numbers, index + step),
        load(numbers, index + 2 * step),
        load(numbers, index + 3 * step),
    )


@inlined
def four_rows(columns: np.ndarray, first: int, lane: int) -> tuple[Any, Any, Any, Any]:
    """Load four numbers, from the first on, of sixteen Gaussians of a block."""
    return load_four(columns, first * BLOCK + lane, BLOCK)


@kernel
def read_columns(rows: np.ndarray, begin: int, end: int, columns: np.ndarray, wide: int) -> None:
    """Set columns [numbers, wide] to the rows begin..end of [n, numbers], at most ``wide``; lanes past the end get
    zeros.

    ``columns`` is flat, with room for a multiple of sixteen numbers; those past the rows' own are undefined.
    """
    numbers = rows.shape[1]
    flat, length = rows.reshape(-1), rows.size
    for lane in range(0, wide, LANES):
        first = (begin + lane) * numbers
        for number in range(0, numbers, LANES):
            last = first + (LANES - 1) * numbers + number + LANES
            if begin + lane + LANES <= end and last <= length:
                transpose_tile(flat, first + number, numbers, columns, number * wide + lane, wide)
                continue
            for i in range(number, min(number + LANES, numbers)):
                for j in range(LANES):
                    inside = begin + lane + j < end
                    columns[i * wide + lane + j] = flat[first + j * numbers + i] if inside else np.float32(0)


@kernel
def write_columns(columns: np.ndarray, wide: int, rows: np.ndarray, begin: int, end: int) -> None:
    """Set the rows begin..end of [n, numbers] to columns [numbers, wide]; see `read_columns`."""
    numbers = rows.shape[1]
    flat, tile = rows.reshape(-1), np.empty(LANES * LANES, np.float32)
    for first in range(begin, end, LANES):
        for number in range(0, numbers, LANES):
            transpose_tile(columns, number * wide + first - begin, wide, tile, 0, LANES)
            for j in range(min(LANES, end - first)):
                index = (first + j) * numbers + number
                store_first(flat, index, numbers - number, load(tile, j * LANES))
