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
def sort_by_depth(view: int, depths: np.ndarray, order: np.ndarray, keys: np.ndarray, spare: np.ndarray) -> int:
    """Write the visible Gaussians of one view, nearest first (ties by index), to order[view]; give their number.

    They are those of a positive depth: a radius may round to zero where a Gaussian has a tile.

    ``keys`` and ``spare`` are int64 scratch of length N: bits of the depth in single precision above, index below. What
    is equal so is put right afterwards.
    """
    bits = depths[view].astype(np.float32).view(np.int32)
    count, lowest, highest = 0, np.int64(1) << 31, np.int64(0)
    for n in range(depths.shape[1]):
        if depths[view, n] > 0:
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
def _shape(records: np.ndarray, view: int, n: int) -> tuple:
    """Of one Gaussian: ALONG_X, ALONG_Y, DOWN, where along one side of a block the exponent is largest, its reach."""
    a, b, c = records[view, n, ALONG_X], records[view, n, ALONG_Y], records[view, n, DOWN]
    reach = records[view, n, LOG_OPACITY] - np.float32(LOG2_MIN_ALPHA)
    return a, b, c, -a * b / (b * b + c * c), -b / a, reach * np.float32(1.0001) + SLACK


@inlined
def _reached_blocks(shape: tuple, left: float, top: float, block_left: np.ndarray, block_top: np.ndarray) -> int:
    """Return bits of the blocks in which the exponent at some point between pixel centres exceeds log2(1/255).

    The maximum over a rectangle lies on one of the two sides that face the centre, at the clamped one-dimensional
    optimum; all sixteen blocks are tested at once. ``left`` and ``top`` are the tile's first pixel less the centre.
    """
    a, b, c, slope_y, slope_x, reach = shape
    zero, span = splat(np.float32(0)), splat(np.float32(BLOCK - 1))
    low_x, low_y = load(block_left, 0) + splat(np.float32(left)), load(block_top, 0) + splat(np.float32(top))
    high_x, high_y = low_x + span, low_y + span
    near_x, near_y = minimum(maximum(zero, low_x), high_x), minimum(maximum(zero, low_y), high_y)
    best_y = minimum(maximum(near_x * splat(slope_y), low_y), high_y)
    best_x = minimum(maximum(near_y * splat(slope_x), low_x), high_x)
    least = minimum(_squares(a, b, c, near_x, best_y), _squares(a, b, c, best_x, near_y))
    return bits_gt(splat(reach), least)


@inlined
def _is_before(depths: np.ndarray, view: int, first: int, second: int) -> bool:
    """Tell whether one Gaussian comes before another front to back."""
    here, there = depths[view, first], depths[view, second]
    return here < there or (here == there and first < second)


@kernel
def mark_pairs(
    view: int, begin: int, end: int, firsts: np.ndarray, depths: np.ndarray, records: np.ndarray, tiles: np.ndarray,
    slots: np.ndarray, tiles_x: int, tiles_y: int, block_left: np.ndarray, block_top: np.ndarray, pair_tile: np.ndarray,
    pair_bits: np.ndarray, histograms: np.ndarray,
) -> None:  # fmt: skip
    """Fill tile and block bits of the pairs of Gaussians begin..end, and count them by piece and tile.

    They are taken as they are numbered, not front to back: so their slots are neighbours, and hardly any two
    threads write to one cache line.

    Args:
        view: theirs.
        begin: the first of them.
        end: one past the last.
        firsts: the foremost Gaussian of each piece that `scatter_pairs` takes, front to back, [P].
        depths: [V, N].
        records: [V, N, 8].
        tiles: first and one past the last, x then y, [V, N, 4].
        slots: [V, N + 1].
        tiles_x: tiles of a row.
        tiles_y: rows.
        block_left: `BLOCK_LEFT`.
        block_top: `BLOCK_TOP`.
        pair_tile: set, by slot.
        pair_bits: set, by slot.
        histograms: added to, [P, tiles of all views].
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
                bits = _reached_blocks(shape, left, top, block_left, block_top)
                tile = (view * tiles_y + tile_y) * tiles_x + tile_x
                pair_tile[slot], pair_bits[slot] = tile, bits
                histograms[piece, tile] += bits != 0
                slot += 1


@kernel
def start_tiles(histograms: np.ndarray, starts: np.ndarray) -> None:
    """Turn counts by who marked, piece and tile, [M, P, tiles], into where each piece writes, [0, P, tiles].

    ``starts`` [tiles + 1] is set to where the tiles' lists begin.
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
    """Write the pairs of sorted Gaussians begin..end into their tiles' lists, in depth order.

    Args:
        view: theirs.
        begin: the first of them.
        end: one past the last.
        order: front to back, [V, N].
        slots: [V, N + 1].
        pair_tile: by slot.
        pair_bits: by slot.
        cursor: where the next entry of each tile goes, counted up, [tiles of all views].
        entry_gaussian: set.
        entry_slot: set.
        entry_bits: set.
    """
    for k in range(begin, end):
        n = order[view, k]
        for slot in range(slots[view, n], slots[view, n + 1]):
            if pair_bits[slot] != 0:
                place = cursor[pair_tile[slot]]
                cursor[pair_tile[slot]] = place + 1
                entry_gaussian[place], entry_slot[place], entry_bits[place] = n, slot, pair_bits[slot]
