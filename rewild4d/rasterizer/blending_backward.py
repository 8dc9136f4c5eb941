"""The gradient of blending, tile by tile.

It goes front to back like the blend: the sum behind a Gaussian is the pixel's total minus the prefix, so that nothing
is divided back, and one number per pixel suffices for any number of channels.
"""

import math
from typing import Any

import numpy as np

from rewild4d.kernels.compiling import inlined, kernel
from rewild4d.kernels.powers import exp2
from rewild4d.kernels.rows import sum_rows
from rewild4d.kernels.simd import (
    LANES,
    broadcast,
    divide,
    fma,
    fnma,
    fold1,
    fold2,
    fold4,
    fold8,
    keep_where_ge,
    load,
    lowest_bit,
    minimum,
    select_gt,
    splat,
    store,
    take_ticket,
)
from rewild4d.rasterizer.binning import BLOCKS
from rewild4d.rasterizer.blending import AHEAD, PLACED, open_tile, place_in_tile, tile_place
from rewild4d.rasterizer.blocks import load_blocks
from rewild4d.rasterizer.conventions import MAX_ALPHA, MIN_TRANSMITTANCE
from rewild4d.rasterizer.crowds import crowd_backward
from rewild4d.rasterizer.projection import ALONG_X, ALONG_Y, DOWN, LOG2_MIN_ALPHA, LOG_OPACITY, RECORD
from rewild4d.rasterizer.projection_backward import TT, TU, UU

MOMENTS = 6
"""Sums of q, q t, q u, q t^2, q t u, q u^2 at the start of a slot, q = dL/dalpha alpha."""
FEW = 3
"""Channels whose sums stay in registers."""

LN2 = math.log(2.0)
_WEAKEST, _LEAST_LEFT = np.float32(LOG2_MIN_ALPHA), np.float32(MIN_TRANSMITTANCE)
_STRONGEST_ALPHA, _STRONGEST = np.float32(MAX_ALPHA), np.float32(math.log2(MAX_ALPHA))


def slot_width(channels: int) -> int:
    """Return the numbers in a slot: a vector of moments and up to three channel sums; more have further vectors."""
    return LANES + (0 if channels <= FEW else -(-channels // LANES) * LANES)


@inlined
def _first_channel(channels: int) -> int:
    """Return the index of the first channel sum in a slot."""
    return MOMENTS if channels <= FEW else LANES


_slot_width = kernel(slot_width)


@kernel
def blend_backward(
    tickets: np.ndarray, tiles_x: int, tiles_y: int, lists: tuple, records: np.ndarray, features: np.ndarray,
    background: np.ndarray, image: np.ndarray, alpha: np.ndarray, g_image: np.ndarray, g_alpha: np.ndarray,
    geometry: bool, crowd: int, sums: np.ndarray,
) -> None:  # fmt: skip
    """Fill the slots' rows of ``sums`` (`slot_width` numbers each) for tiles until no ticket is left.

    Without ``geometry`` the moments are zero. Tiles with more than ``crowd`` Gaussians use double precision.
    """
    views, channels, height, width = image.shape
    count = len(records) // (RECORD * views)
    starts, entry_gaussian, entry_slot, entry_bits = lists
    left, behind = np.empty(BLOCKS * LANES, np.float32), np.empty(BLOCKS * LANES, np.float32)
    placed = np.empty(AHEAD * PLACED, np.float32)
    gradients = np.zeros(BLOCKS * max(channels, FEW) * LANES, np.float32)
    row_length = _slot_width(channels)
    rows = np.empty(row_length * LANES, np.float32)
    while True:
        tile = take_ticket(tickets)
        if tile >= views * tiles_x * tiles_y:
            return
        if starts[tile] == starts[tile + 1]:
            continue
        view, tile_top, tile_left = tile_place(tile, tiles_x, tiles_y)
        first, last = starts[tile], starts[tile + 1]
        if geometry and last - first > crowd:
            crowd_backward(
                view, tile_left, tile_top, entry_slot[first:last], entry_gaussian[first:last], entry_bits[first:last],
                records, features, background, g_image, g_alpha, _first_channel(channels), row_length, sums,
            )  # fmt: skip
            continue
        open_tile(tile_left, tile_top, width, height, left)
        _read_tile(view, tile_left, tile_top, image, alpha, g_image, g_alpha, behind, gradients)
        for begin in range(first, last, AHEAD):
            end = min(begin + AHEAD, last)
            for entry in range(begin, end):
                record = (view * count + entry_gaussian[entry]) * RECORD
                place_in_tile(records, record, tile_left, tile_top, placed, (entry - begin) * PLACED)
            for entry in range(begin, end):
                bits = np.int64(entry_bits[entry])
                if bits != 0:
                    n = entry_gaussian[entry]
                    log_opacity = broadcast(records, (view * count + n) * RECORD + LOG_OPACITY)
                    _entry_backward(
                        bits, log_opacity, features, n * channels, channels, geometry, placed,
                        (entry - begin) * PLACED, left, behind, gradients, rows, sums,
                        entry_slot[entry] * row_length,
                    )  # fmt: skip


@inlined
def _read_tile(
    view: int, tile_left: int, tile_top: int, image: np.ndarray, alpha: np.ndarray, g_image: np.ndarray,
    g_alpha: np.ndarray, behind: np.ndarray, gradients: np.ndarray,
) -> None:  # fmt: skip
    """Load dL/dimage per block, and the loss's linear share of all that is blended: sum of g.out minus T dL/dalpha."""
    _, channels, height, width = image.shape
    pixels, mattes, g_pixels, g_mattes = image.reshape(-1), alpha.reshape(-1), g_image.reshape(-1), g_alpha.reshape(-1)
    one, zero, step = splat(np.float32(1)), splat(np.float32(0)), max(channels, FEW) * LANES
    for block in range(0, BLOCKS, 4):
        x, y = tile_left, tile_top + block
        a, b, c, d = load_blocks(mattes, view * height, x, y, width, height)
        p, q, r, s = load_blocks(g_mattes, view * height, x, y, width, height)
        p, q, r, s = zero - (one - a) * p, zero - (one - b) * q, zero - (one - c) * r, zero - (one - d) * s
        for channel in range(channels):
            first_row = (view * channels + channel) * height
            a, b, c, d = load_blocks(g_pixels, first_row, x, y, width, height)
            place = block * step + channel * LANES
            store(gradients, place, a)
            store(gradients, place + step, b)
            store(gradients, place + 2 * step, c)
            store(gradients, place + 3 * step, d)
            e, f, g, h = load_blocks(pixels, first_row, x, y, width, height)
            p, q, r, s = fma(a, e, p), fma(b, f, q), fma(c, g, r), fma(d, h, s)
        store(behind, block * LANES, p)
        store(behind, (block + 1) * LANES, q)
        store(behind, (block + 2) * LANES, r)
        store(behind, (block + 3) * LANES, s)


@inlined
def _entry_backward(
    bits: int, log_opacity: Any, features: np.ndarray, feature: int, channels: int, geometry: bool, placed: np.ndarray,
    place: int, left: np.ndarray, behind: np.ndarray, gradients: np.ndarray, rows: np.ndarray, sums: np.ndarray,
    row: int,
) -> None:  # fmt: skip
    """Sum one Gaussian's six moments and channel gradients over the blocks of ``bits`` into sums[row:]."""
    # constants are literals, as the sums occupy the registers
    zero, one, least = splat(np.float32(0)), splat(np.float32(1)), splat(_LEAST_LEFT)
    strongest, weakest = splat(_STRONGEST_ALPHA), splat(_WEAKEST)
    first_t, first_u = load(placed, place), load(placed, place + LANES)
    step_t, step_u = place + 2 * LANES, place + 3 * LANES
    red, green, blue, on_red, on_green, on_blue = zero, zero, zero, zero, zero, zero
    if channels <= FEW:
        red = broadcast(features, feature)
        green = broadcast(features, feature + 1) if channels > 1 else zero
        blue = broadcast(features, feature + 2) if channels > 2 else zero
    else:
        for channel in range(channels):
            store(rows, channel * LANES, zero)
    m, mt, mu, mtt, mtu, muu = zero, zero, zero, zero, zero, zero
    while bits != 0:
        block = lowest_bit(bits)
        bits &= bits - 1
        t, u = first_t + broadcast(placed, step_t + block), first_u + broadcast(placed, step_u + block)
        exponent = fnma(t, t, fnma(u, u, log_opacity))
        alpha = minimum(exp2(exponent), strongest)
        before = load(left, block * LANES)
        weight = keep_where_ge(alpha, exponent, weakest) * before
        after = before - weight
        weight = select_gt(after, least, weight, zero)
        store(left, block * LANES, select_gt(after, least, after, zero))
        along, place_of_block = zero, block * max(channels, FEW) * LANES
        if channels <= FEW:  # sums in registers
            first = load(gradients, place_of_block)
            second, third = load(gradients, place_of_block + LANES), load(gradients, place_of_block + 2 * LANES)
            along = fma(first, red, fma(second, green, third * blue))
            on_red, on_green, on_blue = (
                fma(weight, first, on_red),
                fma(weight, second, on_green),
                fma(weight, third, on_blue),
            )
        else:
            for channel in range(channels):
                gradient = load(gradients, place_of_block + channel * LANES)
                along = fma(gradient, broadcast(features, feature + channel), along)
                store(rows, channel * LANES, fma(weight, gradient, load(rows, channel * LANES)))
        if not geometry:
            continue
        rest = load(behind, block * LANES) - weight * along
        store(behind, block * LANES, rest)
        # alpha dL/dalpha, where the Gaussian was blended and not capped
        pull = weight * along - divide(rest * alpha, one - alpha)
        pull = select_gt(weight, zero, pull, zero)
        pull = select_gt(exponent, splat(_STRONGEST), zero, pull)
        m = m + pull
        pull_t, pull_u = pull * t, pull * u
        mt, mu = mt + pull_t, mu + pull_u
        mtt, mtu, muu = fma(pull_t, t, mtt), fma(pull_t, u, mtu), fma(pull_u, u, muu)
    near = fold4(fold2(fold1(m, mt), fold1(mu, mtt)), fold2(fold1(mtu, muu), fold1(on_red, on_green)))
    store(sums, row, fold8(near, fold4(fold2(fold1(on_blue, zero), zero), zero)))
    sum_rows(rows, 0 if channels <= FEW else channels, sums, row + LANES)


@kernel
def gather_slots(
    view: int, begin: int, end: int, slots: np.ndarray, pair_bits: np.ndarray, records: np.ndarray, sums: np.ndarray,
    width: int, v_means2d: np.ndarray, v_records: np.ndarray, v_features: np.ndarray,
) -> None:  # fmt: skip
    """Add the slots of Gaussians begin..end into the zeroed gradients of means2d, records and features."""
    channels = v_features.shape[1]
    total = np.empty(width, np.float32)
    for n in range(begin, end):
        if slots[view, n] == slots[view, n + 1]:
            continue
        for i in range(0, width, LANES):
            added = splat(np.float32(0))
            for slot in range(slots[view, n], slots[view, n + 1]):
                if pair_bits[slot] != 0:
                    added = added + load(sums, slot * width + i)
            store(total, i, added)
        m, mt, mu, mtt, mtu, muu = total[0], total[1], total[2], total[3], total[4], total[5]
        along_x, along_y, down = records[view, n, ALONG_X], records[view, n, ALONG_Y], records[view, n, DOWN]
        v_means2d[view, n, 0] = 2 * LN2 * along_x * mt
        v_means2d[view, n, 1] = 2 * LN2 * (along_y * mt + down * mu)
        v_records[view, n, TT], v_records[view, n, TU], v_records[view, n, UU] = LN2 * mtt, LN2 * mtu, LN2 * muu
        v_records[view, n, LOG_OPACITY] = LN2 * m
        for channel in range(channels):
            v_features[n, channel] += total[_first_channel(channels) + channel]
