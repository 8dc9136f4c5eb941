"""Front-to-back blending of one tile at a time; blending_backward.py has its gradient.

A vector holds the sixteen pixels of a 4 x 4 block. Gaussians are the outer loop and the blocks that they touch the
inner one, so that consecutive steps are independent; a tile's state stays in the first cache. A closed pixel keeps its
last transmittance, with a minus sign.
"""

from typing import Any

import numpy as np

from rewild4d.kernels.columns import load_four
from rewild4d.kernels.compiling import inlined, kernel
from rewild4d.kernels.powers import POWER_TERMS, exp2_with, load_terms
from rewild4d.kernels.simd import (
    LANES,
    absolute,
    bits_gt,
    broadcast,
    columns_of_block,
    fma,
    fnma,
    keep_where_ge,
    load,
    lowest_bit,
    minimum,
    negated_absolute,
    rows_of_block,
    select_gt,
    splat,
    store,
    take_ticket,
)
from rewild4d.rasterizer.binning import BLOCK, BLOCKS, TILE
from rewild4d.rasterizer.blocks import store_blocks
from rewild4d.rasterizer.conventions import MAX_ALPHA, MIN_TRANSMITTANCE
from rewild4d.rasterizer.projection import (
    ALONG_X,
    ALONG_Y,
    CENTER_X,
    CENTER_Y,
    DOWN,
    LOG2_MIN_ALPHA,
    LOG_OPACITY,
    RECORD,
    REST_X,
    REST_Y,
)

CONSTANTS = np.array([LOG2_MIN_ALPHA, MAX_ALPHA, MIN_TRANSMITTANCE, *POWER_TERMS], np.float32)
"""An argument of the kernels, so that the loop over blocks holds them in registers."""
WEAKEST, STRONGEST_ALPHA, LEAST_LEFT, TERMS = range(4)
AHEAD = 16
"""Gaussians whose position in a tile is computed together, to hide its latency."""
PLACED = 4 * LANES
"""Numbers of a position in a tile."""


@inlined
def place_in_tile(
    records: np.ndarray, record: int, tile_left: int, tile_top: int, placed: np.ndarray, place: int
) -> None:
    """Fill four vectors: t and u of the pixels in a tile's first block, and what each block adds to them."""
    left, top = splat(np.float32(tile_left + 0.5)), splat(np.float32(tile_top + 0.5))
    along_x, along_y = broadcast(records, record + ALONG_X), broadcast(records, record + ALONG_Y)
    down = broadcast(records, record + DOWN)
    dx = columns_of_block() + (left - broadcast(records, record + CENTER_X) - broadcast(records, record + REST_X))
    dy = rows_of_block() + (top - broadcast(records, record + CENTER_Y) - broadcast(records, record + REST_Y))
    block = splat(np.float32(BLOCK))
    step_x, step_y = block * columns_of_block(), block * rows_of_block()  # lane i here stands for block i
    store(placed, place, fma(along_x, dx, along_y * dy))
    store(placed, place + LANES, down * dy)
    store(placed, place + 2 * LANES, fma(along_x, step_x, along_y * step_y))
    store(placed, place + 3 * LANES, down * step_y)


@inlined
def alpha_at(log_opacity: Any, t: Any, u: Any, strongest: Any, terms: tuple) -> tuple:
    """Compute alpha before the lower cut, and log2 of alpha before the upper one."""
    exponent = fnma(t, t, fnma(u, u, log_opacity))
    return minimum(exp2_with(terms, exponent), strongest), exponent


@inlined
def open_tile(tile_left: int, tile_top: int, width: int, height: int, transmittance: np.ndarray) -> int:
    """Set transmittance to 1 inside the image and 0 outside; return the bits of the blocks with a pixel in it."""
    if tile_left + TILE <= width and tile_top + TILE <= height:
        transmittance[:] = 1
        return (1 << BLOCKS) - 1
    live = 0
    for block in range(BLOCKS):
        for lane in range(LANES):
            x = tile_left + BLOCK * (block % 4) + lane % 4
            y = tile_top + BLOCK * (block // 4) + lane // 4
            inside = x < width and y < height
            transmittance[block * LANES + lane] = 1 if inside else 0
            if inside:
                live |= 1 << block
    return live


@kernel
def blend(
    tickets: np.ndarray, constants: np.ndarray, tiles_x: int, tiles_y: int, lists: tuple, pair_bits: np.ndarray,
    records: np.ndarray, features: np.ndarray, background: np.ndarray, image: np.ndarray, alpha: np.ndarray,
    through: np.ndarray,
) -> None:  # fmt: skip
    """Blend tiles until no ticket is left: fill image [V, C, h, w], alpha [V, 1, h, w] and ``through``, 1 - alpha.

    ``lists`` are starts, entry_gaussian, entry_slot and entry_bits of `start_tiles` and `scatter_pairs`; ``records``
    and ``features`` are flat. ``entry_bits`` shrinks to the blocks where an entry contributed or closed a pixel;
    ``pair_bits`` is written only where it becomes 0, since threads share its cache lines. ``through`` is flat and keeps
    the digits that alpha loses near 1; it may be empty. Closed blocks are skipped from the next `AHEAD` Gaussians on:
    a test after each Gaussian would stall.
    """
    views, channels, height, width = image.shape
    count = len(records) // (RECORD * views)
    starts, entry_gaussian, entry_slot, entry_bits = lists
    left, placed = np.empty(BLOCKS * LANES, np.float32), np.empty(AHEAD * PLACED, np.float32)
    colors = np.empty(BLOCKS * channels * LANES, np.float32)
    while True:
        tile = take_ticket(tickets)
        if tile >= views * tiles_x * tiles_y:
            return
        view, tile_top, tile_left = tile_place(tile, tiles_x, tiles_y)
        live = open_tile(tile_left, tile_top, width, height, left)
        colors[:] = 0
        for first in range(starts[tile], starts[tile + 1], AHEAD):
            last = min(first + AHEAD, starts[tile + 1])
            seen = live
            if seen != 0:
                for entry in range(first, last):
                    record = (view * count + entry_gaussian[entry]) * RECORD
                    place_in_tile(records, record, tile_left, tile_top, placed, (entry - first) * PLACED)
            for entry in range(first, last):
                bits, touched = np.int64(entry_bits[entry]) & seen, 0
                if bits != 0:
                    n = entry_gaussian[entry]
                    log_opacity = broadcast(records, (view * count + n) * RECORD + LOG_OPACITY)
                    touched, closed = _blend_entry(
                        bits, constants, log_opacity, features, n * channels, channels, placed,
                        (entry - first) * PLACED, left, colors,
                    )  # fmt: skip
                    live &= ~closed
                entry_bits[entry] = touched
                if touched == 0:
                    pair_bits[entry_slot[entry]] = 0
        _write_tile(view, tile_left, tile_top, left, colors, background, image, alpha, through)


@inlined
def tile_place(tile: int, tiles_x: int, tiles_y: int) -> tuple:
    """Return the view, top and left pixel of a tile."""
    return tile // (tiles_x * tiles_y), tile // tiles_x % tiles_y * TILE, tile % tiles_x * TILE


@inlined
def _add_channel(weight: Any, features: np.ndarray, feature: int, colors: np.ndarray, place: int) -> None:
    store(colors, place, fma(weight, broadcast(features, feature), load(colors, place)))


@inlined
def _blend_entry(
    bits: int, constants: np.ndarray, log_opacity: Any, features: np.ndarray, feature: int, channels: int,
    placed: np.ndarray, place: int, left: np.ndarray, colors: np.ndarray,
) -> tuple:  # fmt: skip
    """Blend one Gaussian into the blocks of ``bits``; return the blocks it touched and those that are now closed."""
    zero, least, weakest = splat(np.float32(0)), broadcast(constants, LEAST_LEFT), broadcast(constants, WEAKEST)
    strongest, terms = broadcast(constants, STRONGEST_ALPHA), load_terms(constants, TERMS)
    first_t, first_u = load(placed, place), load(placed, place + LANES)
    step_t, step_u = place + 2 * LANES, place + 3 * LANES
    touched, closed = 0, 0
    while bits != 0:
        block = lowest_bit(bits)
        bits &= bits - 1
        t, u = first_t + broadcast(placed, step_t + block), first_u + broadcast(placed, step_u + block)
        alpha, exponent = alpha_at(log_opacity, t, u, strongest, terms)
        before = load(left, block * LANES)
        weight = keep_where_ge(alpha, exponent, weakest) * before
        touched |= (bits_gt(weight, zero) != 0) << block  # also what closes a pixel, for the backward pass
        after = before - weight
        store(left, block * LANES, select_gt(after, least, after, negated_absolute(before)))
        weight = select_gt(after, least, weight, zero)
        closed |= (bits_gt(after, least) == 0) << block
        color = block * channels * LANES
        if channels == 3:  # without a loop
            _add_channel(weight, features, feature, colors, color)
            _add_channel(weight, features, feature + 1, colors, color + LANES)
            _add_channel(weight, features, feature + 2, colors, color + 2 * LANES)
        else:
            for channel in range(channels):
                _add_channel(weight, features, feature + channel, colors, color + channel * LANES)
    return touched, closed


@inlined
def _write_tile(
    view: int, tile_left: int, tile_top: int, left: np.ndarray, colors: np.ndarray, background: np.ndarray,
    image: np.ndarray, alpha: np.ndarray, through: np.ndarray,
) -> None:  # fmt: skip
    _, channels, height, width = image.shape
    pixels, mattes, one = image.reshape(-1), alpha.reshape(-1), splat(np.float32(1))
    for block in range(0, BLOCKS, 4):
        x, y = tile_left, tile_top + block
        a, b, c, d = load_four(left, block * LANES, LANES)
        a, b, c, d = absolute(a), absolute(b), absolute(c), absolute(d)
        store_blocks(mattes, view * height, x, y, width, height, (one - a, one - b, one - c, one - d))
        if len(through) > 0:
            store_blocks(through, view * height, x, y, width, height, (a, b, c, d))
        for channel in range(channels):
            e, f, g, h = load_four(colors, (block * channels + channel) * LANES, channels * LANES)
            behind = splat(background[view, channel])
            composed = fma(a, behind, e), fma(b, behind, f), fma(c, behind, g), fma(d, behind, h)
            store_blocks(pixels, (view * channels + channel) * height, x, y, width, height, composed)
