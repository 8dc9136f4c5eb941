"""Which Gaussian touches which tile, front to back.

Three steps: sort the visible Gaussians of each view by depth; mark, for every (Gaussian, tile) pair of the bounding
rectangles, which of the tile's sixteen 4 x 4 blocks the ellipse reaches; counting-sort the pairs into tiles. A pair's
place before all sorting (Gaussian by Gaussian) is its `slot`: the backward pass leaves its sums there.
"""

from typing import Any

import numpy as np

from rewild4d.kernels.compiling import inlined, kernel
from rewild4d.kernels.simd import bits_gt, fma, load, maximum, minimum, splat
from rewild4d.rasterizer.projection import (
    ALONG_X,
    ALONG_Y,
    CENTER_X,
    CENTER_Y,
    DOWN,
    LOG2_MIN_ALPHA,
    LOG_OPACITY,
    TILE,
)

BLOCK, BLOCKS = 4, 16
"""A tile is sixteen blocks of 4 x 4 pixels, numbered row by row."""

BLOCK_LEFT = np.array([BLOCK * (block % 4) for block in range(BLOCKS)], np.float32)
BLOCK_TOP = np.array([BLOCK * (block // 4) for block in range(BLOCKS)], np.float32)

SLACK = np.float32(1e-3)
"""Added to the reach in exponent units, so that rounding never drops a block that the blend would draw into."""

RADIX_BITS = 11
RADIX = 1 << RADIX_BITS


@kernel
def _sort_run(run: np.ndarray, depths: np.ndarray) -> None:
    """Sort indices by depth, stable; a run is short unless thousands share one plane."""
    for k in range(1, len(run)):
        if depths[run[k]] < depths[run[k - 1]]:
            run[:] = run[np.argsort(depths[run], kind="mergesort")]
            return


@kernel
def sort_by_depth(
    view: int, radii: np.ndarray, depths: np.ndarray, order: np.ndarray, keys: np.ndarray, spare: np.ndarray
) -> int:
    """Write the visible Gaussians of one view, nearest first (ties by index), to order[view]; give their number.

    ``keys`` and ``spare`` are int64 scratch of length N: bits of the depth in single precision above, index below. What
    is equal so is put right afterwards.
    """
    bits = depths[view].astype(np.float32).view(np.int32)
    count, lowest, highest = 0, np.int64(1) << 31, np.int64(0)
    for n in range(radii.shape[1]):
        if radii[view, n] > 0:
            key = np.int64(bits[n])
            keys[count] = (key << 32) | n
            lowest, highest = min(lowest, key), max(highest, key)
            count += 1
    # What all depths have in common needs no sorting: an animal's differ in the lower two digits.
    shift = 32
    while (highest - lowest) >> (shift - 32) > 0:
        histogram = np.zeros(RADIX, np.int64)
        for k in range(count):
            histogram[((keys[k] - (lowest << 32)) >> shift) & (RADIX - 1)] += 1
        total = 0
        for value in range(RADIX):
            here = histogram[value]
            histogram[value] = total
            total += here
        for k in range(count):
            value = ((keys[k] - (lowest << 32)) >> shift) & (RADIX - 1)
            spare[histogram[value]] = keys[k]
            histogram[value] += 1
        keys, spare = spare, keys
        shift += RADIX_BITS
    first = 0
    for k in range(count):
        order[view, k] = keys[k] & 0xFFFFFFFF
        if keys[k] >> 32 != keys[first] >> 32:
            if k > first + 1:
                _sort_run(order[view, first:k], depths[view])
            first = k
    _sort_run(order[view, first:count], depths[view])
    return count


@inlined
def _squares(a: float, b: float, c: float, x: Any, y: Any) -> Any:
    """By how much the exponent falls from the centre to (x, y)."""
    t, u = fma(splat(a), x, splat(b) * y), splat(c) * y
    return fma(t, t, u * u)


@inlined
def _reached_blocks(
    records: np.ndarray, view: int, n: int, left: int, top: int, block_left: np.ndarray, block_top: np.ndarray
) -> int:
    """Bits of the blocks in which the exponent at some point between pixel centres exceeds log2(1/255).

    The maximum over a rectangle lies on one of the two sides that face the centre, at the clamped one-dimensional
    optimum; all sixteen blocks are tested at once.
    """
    zero, span = splat(np.float32(0)), splat(np.float32(BLOCK - 1))
    a, b, c = records[view, n, ALONG_X], records[view, n, ALONG_Y], records[view, n, DOWN]
    low_x = load(block_left, 0) + splat(np.float32(left + 0.5 - records[view, n, CENTER_X]))
    low_y = load(block_top, 0) + splat(np.float32(top + 0.5 - records[view, n, CENTER_Y]))
    high_x, high_y = low_x + span, low_y + span
    near_x, near_y = minimum(maximum(zero, low_x), high_x), minimum(maximum(zero, low_y), high_y)
    best_y = minimum(maximum(near_x * splat(-a * b / (b * b + c * c)), low_y), high_y)
    best_x = minimum(maximum(near_y * splat(-b / a), low_x), high_x)
    least = minimum(_squares(a, b, c, near_x, best_y), _squares(a, b, c, best_x, near_y))
    reach = records[view, n, LOG_OPACITY] - np.float32(LOG2_MIN_ALPHA)
    return bits_gt(splat(reach * np.float32(1.0001) + SLACK), least)


@kernel
def mark_pairs(
    view: int,
    begin: int,
    end: int,
    order: np.ndarray,
    records: np.ndarray,
    tiles: np.ndarray,
    slots: np.ndarray,
    tiles_x: int,
    tiles_y: int,
    block_left: np.ndarray,
    block_top: np.ndarray,
    pair_tile: np.ndarray,
    pair_bits: np.ndarray,
    histogram: np.ndarray,
) -> None:
    """Fill tile and block bits of the pairs of sorted Gaussians begin..end, and count them per tile."""
    for k in range(begin, end):
        n = order[view, k]
        slot = slots[view, n]
        for tile_y in range(np.int64(tiles[view, n, 2]), np.int64(tiles[view, n, 3])):
            for tile_x in range(np.int64(tiles[view, n, 0]), np.int64(tiles[view, n, 1])):
                bits = _reached_blocks(records, view, n, tile_x * TILE, tile_y * TILE, block_left, block_top)
                tile = (view * tiles_y + tile_y) * tiles_x + tile_x
                pair_tile[slot] = tile
                pair_bits[slot] = bits
                histogram[tile] += bits != 0
                slot += 1


@kernel
def start_tiles(histograms: np.ndarray, starts: np.ndarray) -> int:
    """Turn per-chunk counts [chunks, tiles] into where each chunk writes; starts [tiles + 1]; give the longest list."""
    total, longest = 0, 0
    for tile in range(histograms.shape[1]):
        starts[tile] = total
        for chunk in range(histograms.shape[0]):
            here = histograms[chunk, tile]
            histograms[chunk, tile] = total
            total += here
        longest = max(longest, total - starts[tile])
    starts[histograms.shape[1]] = total
    return longest


@kernel
def scatter_pairs(
    view: int,
    begin: int,
    end: int,
    order: np.ndarray,
    slots: np.ndarray,
    pair_tile: np.ndarray,
    pair_bits: np.ndarray,
    cursor: np.ndarray,
    entry_gaussian: np.ndarray,
    entry_slot: np.ndarray,
    entry_bits: np.ndarray,
) -> None:
    """Write the pairs of sorted Gaussians begin..end into their tiles' lists, in depth order."""
    for k in range(begin, end):
        n = order[view, k]
        for slot in range(slots[view, n], slots[view, n + 1]):
            if pair_bits[slot] != 0:
                place = cursor[pair_tile[slot]]
                cursor[pair_tile[slot]] = place + 1
                entry_gaussian[place] = n
                entry_slot[place] = slot
                entry_bits[place] = pair_bits[slot]
