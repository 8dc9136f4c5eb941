"""Front-to-back blending of one tile at a time; blending_backward.py has its gradient.

A vector holds the sixteen pixels of a 4 x 4 block. Gaussians are the outer loop and the blocks that they reach the
inner one, so neighbouring steps work on different pixels and need not wait for each other; a tile's state stays in the
first cache. A closed pixel keeps its last transmittance, with a minus sign, and takes nothing more.
"""

from typing import Any

import numpy as np

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
    store_block,
    take_ticket,
)
from rewild4d.rasterizer.binning import BLOCK, BLOCKS, TILE
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
"""An argument of the kernels, so that the loop over blocks finds them in registers."""
WEAKEST, STRONGEST_ALPHA, LEAST_LEFT, TERMS = range(4)


@inlined
def place_in_tile(records: np.ndarray, record: int, tile_left: int, tile_top: int, steps: np.ndarray) -> tuple:
    """The coordinates t and u of the pixels in a tile's first block; fill ``steps`` [32] with what each block adds."""
    left, top = splat(np.float32(tile_left + 0.5)), splat(np.float32(tile_top + 0.5))
    along_x, along_y = broadcast(records, record + ALONG_X), broadcast(records, record + ALONG_Y)
    down = broadcast(records, record + DOWN)
    dx = columns_of_block() + (left - broadcast(records, record + CENTER_X) - broadcast(records, record + REST_X))
    dy = rows_of_block() + (top - broadcast(records, record + CENTER_Y) - broadcast(records, record + REST_Y))
    block = splat(np.float32(BLOCK))
    step_x, step_y = block * columns_of_block(), block * rows_of_block()  # lane i here stands for block i
    store(steps, 0, fma(along_x, step_x, along_y * step_y))
    store(steps, LANES, down * step_y)
    return fma(along_x, dx, along_y * dy), down * dy


@inlined
def alpha_at(log_opacity: Any, t: Any, u: Any, strongest: Any, terms: tuple) -> tuple:
    """Alpha before the lower cut, and log2 of alpha before the upper one."""
    exponent = fnma(t, t, fnma(u, u, log_opacity))
    return minimum(exp2_with(terms, exponent), strongest), exponent


@inlined
def open_tile(tile_left: int, tile_top: int, width: int, height: int, transmittance: np.ndarray) -> int:
    """Set transmittance to 1 inside the image and 0 outside; give the bits of the blocks that hold a pixel."""
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
    tickets: np.ndarray,
    constants: np.ndarray,
    tiles_x: int,
    tiles_y: int,
    starts: np.ndarray,
    entry_gaussian: np.ndarray,
    entry_slot: np.ndarray,
    pair_bits: np.ndarray,
    records: np.ndarray,
    features: np.ndarray,
    background: np.ndarray,
    image: np.ndarray,
    alpha: np.ndarray,
    through: np.ndarray,
) -> None:
    """Blend tiles until no ticket is left: fill image [V, C, h, w], alpha [V, 1, h, w] and ``through``, 1 - alpha.

    ``records`` and ``features`` are flat. ``pair_bits`` shrinks to the blocks where a pair really contributed.
    ``through`` is flat and keeps the digits that alpha has lost near 1; empty where nobody needs them.
    """
    views, channels, height, width = image.shape
    count = len(records) // (RECORD * views)
    left, steps = np.empty(BLOCKS * LANES, np.float32), np.empty(2 * LANES, np.float32)
    colors = np.empty(BLOCKS * channels * LANES, np.float32)
    while True:
        tile = take_ticket(tickets)
        if tile >= views * tiles_x * tiles_y:
            return
        view, tile_top, tile_left = tile_place(tile, tiles_x, tiles_y)
        live = open_tile(tile_left, tile_top, width, height, left)
        colors[:] = 0
        for entry in range(starts[tile], starts[tile + 1]):
            slot = entry_slot[entry]
            bits = np.int64(pair_bits[slot]) & live
            if bits != 0:
                n = entry_gaussian[entry]
                touched, closed = _blend_entry(
                    bits, constants, records, (view * count + n) * RECORD, features, n * channels, channels, tile_left,
                    tile_top, steps, left, colors,
                )  # fmt: skip
                pair_bits[slot] = touched
                live &= ~closed
            else:
                pair_bits[slot] = 0
        _write_tile(view, tile_left, tile_top, left, colors, background, image, alpha, through)


@inlined
def tile_place(tile: int, tiles_x: int, tiles_y: int) -> tuple:
    """View, top and left pixel of a tile."""
    return tile // (tiles_x * tiles_y), tile // tiles_x % tiles_y * TILE, tile % tiles_x * TILE


@inlined
def _add_channel(weight: Any, features: np.ndarray, feature: int, colors: np.ndarray, place: int) -> None:
    store(colors, place, fma(weight, broadcast(features, feature), load(colors, place)))


@inlined
def _blend_entry(
    bits: int,
    constants: np.ndarray,
    records: np.ndarray,
    record: int,
    features: np.ndarray,
    feature: int,
    channels: int,
    tile_left: int,
    tile_top: int,
    steps: np.ndarray,
    left: np.ndarray,
    colors: np.ndarray,
) -> tuple:
    """Blend one Gaussian into the blocks of ``bits``; give the blocks that it touched and those that are now closed."""
    zero, least, weakest = splat(np.float32(0)), broadcast(constants, LEAST_LEFT), broadcast(constants, WEAKEST)
    strongest, terms = broadcast(constants, STRONGEST_ALPHA), load_terms(constants, TERMS)
    log_opacity = broadcast(records, record + LOG_OPACITY)
    first_t, first_u = place_in_tile(records, record, tile_left, tile_top, steps)
    touched, closed = 0, 0
    while bits != 0:
        block = lowest_bit(bits)
        bits &= bits - 1
        t, u = first_t + broadcast(steps, block), first_u + broadcast(steps, LANES + block)
        alpha, exponent = alpha_at(log_opacity, t, u, strongest, terms)
        before = load(left, block * LANES)
        weight = keep_where_ge(alpha, exponent, weakest) * before
        after = before - weight
        store(left, block * LANES, select_gt(after, least, after, negated_absolute(before)))
        weight = select_gt(after, least, weight, zero)
        open_lanes = bits_gt(after, least)
        touched |= (open_lanes & bits_gt(exponent, weakest) != 0) << block
        closed |= (open_lanes == 0) << block
        place = block * channels * LANES
        if channels == 3:  # the usual case without a loop
            _add_channel(weight, features, feature, colors, place)
            _add_channel(weight, features, feature + 1, colors, place + LANES)
            _add_channel(weight, features, feature + 2, colors, place + 2 * LANES)
        else:
            for channel in range(channels):
                _add_channel(weight, features, feature + channel, colors, place + channel * LANES)
    return touched, closed


@inlined
def _write_tile(
    view: int,
    tile_left: int,
    tile_top: int,
    left: np.ndarray,
    colors: np.ndarray,
    background: np.ndarray,
    image: np.ndarray,
    alpha: np.ndarray,
    through: np.ndarray,
) -> None:
    _, channels, height, width = image.shape
    pixels, mattes = image.reshape(-1), alpha.reshape(-1)
    for block in range(BLOCKS):
        x, y = tile_left + BLOCK * (block % 4), tile_top + BLOCK * (block // 4)
        passed = absolute(load(left, block * LANES))
        _write_block(mattes, view * height, x, y, width, height, splat(np.float32(1)) - passed)
        if len(through) > 0:
            _write_block(through, view * height, x, y, width, height, passed)
        for channel in range(channels):
            color = load(colors, (block * channels + channel) * LANES)
            color = fma(passed, splat(background[view, channel]), color)
            _write_block(pixels, (view * channels + channel) * height, x, y, width, height, color)


@inlined
def _write_block(plane: np.ndarray, first_row: int, x: int, y: int, width: int, height: int, value: Any) -> None:
    """Store the part of a block that lies in the image."""
    corner = (first_row + y) * width + x
    if x + BLOCK <= width and y + BLOCK <= height:
        store_block(plane, corner, width, value)
    elif x < width and y < height:
        lanes = np.empty(LANES, np.float32)
        store(lanes, 0, value)
        for row in range(min(BLOCK, height - y)):
            for column in range(min(BLOCK, width - x)):
                plane[corner + row * width + column] = lanes[row * BLOCK + column]
