"""List the Gaussians of each tile, front to back.

Three steps: sort the visible Gaussians of each view by depth; mark, for every (Gaussian, tile) pair of the bounding
rectangles, the tile's 4 x 4 blocks that the ellipse touches; counting-sort the pairs into tiles. A pair's index before
sorting (Gaussian by Gaussian) is its `slot`, where the backward pass writes its sums.
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
"""Added to the extent in exponent units, so that rounding never drops a block that the blend would draw into."""
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
def sort_by_depth(view: int, depths: np.ndarray, order: np.ndarray, keys: np.ndarray, spare: np.ndarray) -> int:
    """Write the visible Gaussians of one view (depth above 0) to order[view], nearest first; return their number.

    ``keys`` and ``spare`` are int64 scratch of length N: bits of the depth in single precision above, index below. Runs
    of equal keys are sorted afterwards.
    """
    bits = depths[view].astype(np.float32).view(np.int32)
    count, lowest, highest = 0, np.int64(1) << 31, np.int64(0)
    for n in range(depths.shape[1]):
        if depths[view, n] > 0:
            key = np.int64(bits[n])
            keys[count] = (key << 32) | n
            lowest, highest = min(lowest, key), max(highest, key)
            count += 1
    # leading digits that all depths share need no sorting
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
    """Return the decrease of the exponent from the centre to (x, y)."""
    t, u = fma(splat(a), x, splat(b) * y), splat(c) * y
    return fma(t, t, u * u)


@inlined
def _shape(records: np.ndarray, view: int, n: int) -> tuple:
    """Return ALONG_X, ALONG_Y, DOWN, slopes to the largest exponent on a vertical and a horizontal line, the extent."""
    a, b, c = records[view, n, ALONG_X], records[view, n, ALONG_Y], records[view, n, DOWN]
    extent = records[view, n, LOG_OPACITY] - np.float32(LOG2_MIN_ALPHA)
    return a, b, c, -a * b / (b * b + c * c), -b / a, extent * np.float32(1.0001) + SLACK


@inlined
def _touched_blocks(shape: tuple, left: float, top: float, block_left: np.ndarray, block_top: np.ndarray) -> int:
    """Return bits of the blocks in which the exponent at some point between pixel centres exceeds log2(1/255).

    The maximum over a rectangle lies on one of the two sides that face the centre, at the clamped one-dimensional
    optimum; all sixteen blocks are tested at once. ``left`` and ``top`` are the tile's first pixel less the centre.
    """
    a, b, c, slope_y, slope_x, extent = shape
    zero, span = splat(np.float32(0)), splat(np.float32(BLOCK - 1))
    low_x, low_y = load(block_left, 0) + splat(np.float32(left)), load(block_top, 0) + splat(np.float32(top))
    high_x, high_y = low_x + span, low_y + span
    near_x, near_y = minimum(maximum(zero, low_x), high_x), minimum(maximum(zero, low_y), high_y)
    best_y = minimum(maximum(near_x * splat(slope_y), low_y), high_y)
    best_x = minimum(maximum(near_y * splat(slope_x), low_x), high_x)
    least = minimum(_squares(a, b, c, near_x, best_y), _squares(a, b, c, best_x, near_y))
    return bits_gt(splat(extent), least)


@inlined
def _is_before(depths: np.ndarray, view: int, first: int, second: int) -> bool:
    """Tell whether one Gaussian is in front of another."""
    here, there = depths[view, first], depths[view, second]
    return here < there or (here == there and first < second)


@kernel
def mark_pairs(
    view: int, begin: int, end: int, firsts: np.ndarray, depths: np.ndarray, records: np.ndarray, tiles: np.ndarray,
    slots: np.ndarray, tiles_x: int, tiles_y: int, block_left: np.ndarray, block_top: np.ndarray, pair_tile: np.ndarray,
    pair_bits: np.ndarray, histograms: np.ndarray,
) -> None:  # fmt: skip
    """Set tile and block bits of the pairs of Gaussians begin..end by slot, and count the pairs by piece and tile.

    Gaussians are taken by number, not by depth, so that threads hardly ever write to one cache line.

    Args:
        firsts: the foremost Gaussian of each piece of `scatter_pairs`, front to back, [P].
        tiles: first and one past the last, x then y, [V, N, 4].
        slots: [V, N + 1].
        histograms: added to, [P, tiles of all views].
        depths, records: [V, N] and [V, N, 8]; block_left and block_top are `BLOCK_LEFT` and `BLOCK_TOP`.
    """
    for n in range(begin, end):
        slot, piece = slots[view, n], 0
        if slot == slots[view, n + 1]:
            continue
        while piece + 1 < len(firsts) and not _is_before(depths, view, n, firsts[piece + 1]):
            piece += 1
        shape, x, y = _shape(records, view, n), records[view, n, CENTER_X], records[view, n, CENTER_Y]
        for tile_y in range(np.int64(tiles[view, n, 2]), np.int64(tiles[view, n, 3])):
            for tile_x in range(np.int64(tiles[view, n, 0]), np.int64(tiles[view, n, 1])):
                left, top = tile_x * TILE + 0.5 - x, tile_y * TILE + 0.5 - y
                bits = _touched_blocks(shape, left, top, block_left, block_top)
                tile = (view * tiles_y + tile_y) * tiles_x + tile_x
                pair_tile[slot], pair_bits[slot] = tile, bits
                histograms[piece, tile] += bits != 0
                slot += 1


@kernel
def start_tiles(histograms: np.ndarray, starts: np.ndarray) -> None:
    """Convert counts by marker, piece and tile, [M, P, tiles], to the piece's first index in each tile, [0, P, tiles].

    ``starts`` [tiles + 1] is set to the first index of each tile's list.
    """
    markers, pieces, tiles = histograms.shape
    total = 0
    for tile in range(tiles):
        starts[tile] = total
        for piece in range(pieces):
            here = 0
            for marker in range(markers):
                here += histograms[marker, piece, tile]
            histograms[0, piece, tile] = total
            total += here
    starts[tiles] = total


@kernel
def scatter_pairs(
    view: int, begin: int, end: int, order: np.ndarray, slots: np.ndarray, pair_tile: np.ndarray, pair_bits: np.ndarray,
    cursor: np.ndarray, entry_gaussian: np.ndarray, entry_slot: np.ndarray, entry_bits: np.ndarray,
) -> None:  # fmt: skip
    """Write the pairs of sorted Gaussians begin..end to their tiles' lists, the entry arrays, in depth order.

    ``order`` [V, N] is front to back; ``cursor`` [tiles of all views] has the index of each tile's next entry.
    """
    for k in range(begin, end):
        n = order[view, k]
        for slot in range(slots[view, n], slots[view, n + 1]):
            if pair_bits[slot] != 0:
                entry = cursor[pair_tile[slot]]
                cursor[pair_tile[slot]] = entry + 1
                entry_gaussian[entry], entry_slot[entry], entry_bits[entry] = n, slot, pair_bits[slot]
