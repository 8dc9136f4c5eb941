"""Front-to-back blending of one tile at a time, and its gradient.

A vector holds the sixteen pixels of a 4 x 4 block. Gaussians are the outer loop and the blocks that they reach the
inner one, so neighbouring steps work on different pixels and need not wait for each other; a tile's state stays in the
first cache. A closed pixel has transmittance 0 in the running state, which makes every later Gaussian vanish there.

The backward pass walks front to back too: what lies behind Gaussian i is the pixel's total minus the prefix.
"""

import math

import numpy as np

from rewild4d.rasterizer.binning import BLOCK, BLOCKS, TILE
from rewild4d.rasterizer.compiling import kernel
from rewild4d.rasterizer.conventions import MAX_ALPHA, MIN_TRANSMITTANCE
from rewild4d.rasterizer.projection import (
    CENTER_X,
    CENTER_Y,
    LOG2_MIN_ALPHA,
    LOG_OPACITY,
    RECORD,
    XX,
    XY,
    YY,
)
from rewild4d.rasterizer.simd import (
    LANES,
    bits_gt,
    columns_of_block,
    divide,
    exp2,
    fma,
    fold1,
    fold2,
    fold4,
    fold8,
    keep_where_ge,
    load,
    load_block,
    lowest_bit,
    minimum,
    rows_of_block,
    select_gt,
    splat,
    store,
    store_block,
    take_ticket,
)

MOMENTS = 6
"""Sums of q, q dx, q dy, q dx^2, q dx dy, q dy^2 that come before the channel sums in a slot, q = dL/dalpha alpha."""

LN2 = math.log(2.0)
_WEAKEST = np.float32(LOG2_MIN_ALPHA)
_STRONGEST = np.float32(math.log2(MAX_ALPHA))
_MAX_ALPHA = np.float32(MAX_ALPHA)
_MIN_TRANSMITTANCE = np.float32(MIN_TRANSMITTANCE)


def slot_width(channels: int) -> int:
    """Numbers in a slot: the moments and channel sums, rounded up to whole vectors."""
    return -(-(MOMENTS + channels) // LANES) * LANES


_slot_width = kernel(slot_width)


@kernel
def _form(records: np.ndarray, record: int) -> tuple:
    """The four coefficients of one Gaussian's exponent, each in all lanes."""
    xx, xy, yy = records[record + XX], records[record + XY], records[record + YY]
    return splat(xx), splat(xy), splat(yy), splat(records[record + LOG_OPACITY])


@kernel
def _offsets(records: np.ndarray, record: int, tile_left: int, tile_top: int) -> tuple:
    """From the Gaussian's centre to the pixel centres of the tile's first block, two vectors."""
    dx = splat(np.float32(tile_left + 0.5 - records[record + CENTER_X]))
    dy = splat(np.float32(tile_top + 0.5 - records[record + CENTER_Y]))
    return columns_of_block() + dx, rows_of_block() + dy


@kernel
def _exponent(form: tuple, offset_x: object, offset_y: object, block: int) -> tuple:
    """The offsets of one block's pixels from the centre, and log2 of alpha there before the cap."""
    xx, xy, yy, log_opacity = form
    dx = offset_x + splat(np.float32(BLOCK * (block & 3)))
    dy = offset_y + splat(np.float32(BLOCK * (block >> 2)))
    return dx, dy, fma(fma(xx, dx, xy * dy), dx, fma(yy, dy * dy, log_opacity))


@kernel
def _open_tile(tile_left: int, tile_top: int, width: int, height: int, transmittance: np.ndarray) -> int:
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
) -> None:
    """Blend tiles until no ticket is left: fill image [V, C, h, w] and alpha [V, 1, h, w].

    ``records`` and ``features`` are flat. ``pair_bits`` shrinks to the blocks where a pair really contributed.
    """
    views, channels, height, width = image.shape
    count = len(records) // (RECORD * views)
    left, final = np.empty(BLOCKS * LANES, np.float32), np.empty(BLOCKS * LANES, np.float32)
    colors = np.empty(BLOCKS * channels * LANES, np.float32)
    while True:
        tile = take_ticket(tickets)
        if tile >= views * tiles_x * tiles_y:
            return
        view, tile_top, tile_left = _tile_place(tile, tiles_x, tiles_y)
        live = _open_tile(tile_left, tile_top, width, height, left)
        final[:] = left
        colors[:] = 0
        for entry in range(starts[tile], starts[tile + 1]):
            slot = entry_slot[entry]
            bits = np.int64(pair_bits[slot]) & live
            if bits != 0:
                n = entry_gaussian[entry]
                touched, closed = _blend_entry(
                    bits, records, (view * count + n) * RECORD, features, n * channels, channels, tile_left, tile_top,
                    left, final, colors,
                )  # fmt: skip
                pair_bits[slot] = touched
                live &= ~closed
            else:
                pair_bits[slot] = 0
        _write_tile(view, tile_left, tile_top, final, colors, background, image, alpha)


@kernel
def _tile_place(tile: int, tiles_x: int, tiles_y: int) -> tuple:
    """View, top and left pixel of a tile."""
    return tile // (tiles_x * tiles_y), tile // tiles_x % tiles_y * TILE, tile % tiles_x * TILE


@kernel
def _blend_entry(
    bits: int,
    records: np.ndarray,
    record: int,
    features: np.ndarray,
    feature: int,
    channels: int,
    tile_left: int,
    tile_top: int,
    left: np.ndarray,
    final: np.ndarray,
    colors: np.ndarray,
) -> tuple:
    """Blend one Gaussian into the blocks of ``bits``; give the blocks that it touched and those that are now closed."""
    zero, least = splat(np.float32(0)), splat(_MIN_TRANSMITTANCE)
    form = _form(records, record)
    offset_x, offset_y = _offsets(records, record, tile_left, tile_top)
    touched, closed = 0, 0
    while bits != 0:
        block = lowest_bit(bits)
        bits &= bits - 1
        dx, dy, exponent = _exponent(form, offset_x, offset_y, block)
        alpha = keep_where_ge(minimum(exp2(exponent), splat(_MAX_ALPHA)), exponent, splat(_WEAKEST))
        before = load(left, block * LANES)
        weight = alpha * before
        after = before - weight
        weight = select_gt(after, least, weight, zero)
        store(final, block * LANES, select_gt(after, least, after, load(final, block * LANES)))
        after = select_gt(after, least, after, zero)
        store(left, block * LANES, after)
        touched |= (bits_gt(weight, zero) != 0) << block
        closed |= (bits_gt(after, zero) == 0) << block
        for channel in range(channels):
            place = (block * channels + channel) * LANES
            store(colors, place, fma(weight, splat(features[feature + channel]), load(colors, place)))
    return touched, closed


@kernel
def _write_tile(
    view: int,
    tile_left: int,
    tile_top: int,
    final: np.ndarray,
    colors: np.ndarray,
    background: np.ndarray,
    image: np.ndarray,
    alpha: np.ndarray,
) -> None:
    _, channels, height, width = image.shape
    pixels, mattes = image.reshape(-1), alpha.reshape(-1)
    for block in range(BLOCKS):
        x, y = tile_left + BLOCK * (block % 4), tile_top + BLOCK * (block // 4)
        through = load(final, block * LANES)
        _write_block(mattes, view * height, x, y, width, height, splat(np.float32(1)) - through)
        for channel in range(channels):
            color = load(colors, (block * channels + channel) * LANES)
            color = fma(through, splat(background[view, channel]), color)
            _write_block(pixels, (view * channels + channel) * height, x, y, width, height, color)


@kernel
def _write_block(plane: np.ndarray, first_row: int, x: int, y: int, width: int, height: int, value: object) -> None:
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


@kernel
def _read_block(plane: np.ndarray, first_row: int, x: int, y: int, width: int, height: int) -> object:
    """Load a block, zero where it leaves the image."""
    corner = (first_row + y) * width + x
    if x + BLOCK <= width and y + BLOCK <= height:
        return load_block(plane, corner, width)
    lanes = np.zeros(LANES, np.float32)
    for row in range(min(BLOCK, height - y)):
        for column in range(min(BLOCK, width - x)):
            lanes[row * BLOCK + column] = plane[corner + row * width + column]
    return load(lanes, 0)


@kernel
def blend_backward(
    tickets: np.ndarray,
    tiles_x: int,
    tiles_y: int,
    starts: np.ndarray,
    entry_gaussian: np.ndarray,
    entry_slot: np.ndarray,
    pair_bits: np.ndarray,
    records: np.ndarray,
    features: np.ndarray,
    image: np.ndarray,
    alpha: np.ndarray,
    g_image: np.ndarray,
    g_alpha: np.ndarray,
    sums: np.ndarray,
) -> None:
    """Fill the slots' rows of ``sums`` (`slot_width` numbers each) for tiles until no ticket is left."""
    views, channels, height, width = image.shape
    count = len(records) // (RECORD * views)
    left, behind = np.empty(BLOCKS * LANES, np.float32), np.empty(BLOCKS * LANES, np.float32)
    gradients = np.empty(BLOCKS * channels * LANES, np.float32)
    row_length = _slot_width(channels)
    rows = np.empty(row_length * LANES, np.float32)
    while True:
        tile = take_ticket(tickets)
        if tile >= views * tiles_x * tiles_y:
            return
        if starts[tile] == starts[tile + 1]:
            continue
        view, tile_top, tile_left = _tile_place(tile, tiles_x, tiles_y)
        _open_tile(tile_left, tile_top, width, height, left)
        _read_tile(view, tile_left, tile_top, image, alpha, g_image, g_alpha, behind, gradients)
        for entry in range(starts[tile], starts[tile + 1]):
            slot = entry_slot[entry]
            bits = np.int64(pair_bits[slot])
            if bits != 0:
                n = entry_gaussian[entry]
                _entry_backward(
                    bits, records, (view * count + n) * RECORD, features, n * channels, channels, tile_left, tile_top,
                    left, behind, gradients, rows, sums, slot * row_length,
                )  # fmt: skip


@kernel
def _read_tile(
    view: int,
    tile_left: int,
    tile_top: int,
    image: np.ndarray,
    alpha: np.ndarray,
    g_image: np.ndarray,
    g_alpha: np.ndarray,
    behind: np.ndarray,
    gradients: np.ndarray,
) -> None:
    """Load dL/dimage per block, and the loss's linear share of everything blended: sum of g.out minus T dL/dalpha."""
    _, channels, height, width = image.shape
    pixels, mattes, g_pixels, g_mattes = image.reshape(-1), alpha.reshape(-1), g_image.reshape(-1), g_alpha.reshape(-1)
    one = splat(np.float32(1))
    for block in range(BLOCKS):
        x, y = tile_left + BLOCK * (block % 4), tile_top + BLOCK * (block // 4)
        through = one - _read_block(mattes, view * height, x, y, width, height)
        total = splat(np.float32(0)) - through * _read_block(g_mattes, view * height, x, y, width, height)
        for channel in range(channels):
            first_row = (view * channels + channel) * height
            slope = _read_block(g_pixels, first_row, x, y, width, height)
            store(gradients, (block * channels + channel) * LANES, slope)
            total = fma(slope, _read_block(pixels, first_row, x, y, width, height), total)
        store(behind, block * LANES, total)


@kernel
def _entry_backward(
    bits: int,
    records: np.ndarray,
    record: int,
    features: np.ndarray,
    feature: int,
    channels: int,
    tile_left: int,
    tile_top: int,
    left: np.ndarray,
    behind: np.ndarray,
    gradients: np.ndarray,
    rows: np.ndarray,
    sums: np.ndarray,
    place: int,
) -> None:
    """Sum one Gaussian's six moments and channel gradients over the blocks of ``bits`` into sums[place:]."""
    zero, one, least = splat(np.float32(0)), splat(np.float32(1)), splat(_MIN_TRANSMITTANCE)
    form = _form(records, record)
    offset_x, offset_y = _offsets(records, record, tile_left, tile_top)
    for channel in range(channels):
        store(rows, (MOMENTS + channel) * LANES, zero)
    m, mx, my, mxx, mxy, myy = zero, zero, zero, zero, zero, zero
    while bits != 0:
        block = lowest_bit(bits)
        bits &= bits - 1
        dx, dy, exponent = _exponent(form, offset_x, offset_y, block)
        alpha = keep_where_ge(minimum(exp2(exponent), splat(_MAX_ALPHA)), exponent, splat(_WEAKEST))
        before = load(left, block * LANES)
        weight = alpha * before
        after = before - weight
        weight = select_gt(after, least, weight, zero)
        store(left, block * LANES, select_gt(after, least, after, zero))
        along = zero
        for channel in range(channels):
            slope = load(gradients, (block * channels + channel) * LANES)
            along = fma(slope, splat(features[feature + channel]), along)
            row = (MOMENTS + channel) * LANES
            store(rows, row, fma(weight, slope, load(rows, row)))
        rest = load(behind, block * LANES) - weight * along
        store(behind, block * LANES, rest)
        # alpha dL/dalpha, where the pixel took this Gaussian and the cap did not hold it.
        pull = weight * along - divide(rest * alpha, one - alpha)
        pull = select_gt(weight, zero, pull, zero)
        pull = select_gt(exponent, splat(_STRONGEST), zero, pull)
        m = m + pull
        pull_x, pull_y = pull * dx, pull * dy
        mx, my = mx + pull_x, my + pull_y
        mxx, mxy, myy = fma(pull_x, dx, mxx), fma(pull_x, dy, mxy), fma(pull_y, dy, myy)
    store(rows, 0, m)
    store(rows, LANES, mx)
    store(rows, 2 * LANES, my)
    store(rows, 3 * LANES, mxx)
    store(rows, 4 * LANES, mxy)
    store(rows, 5 * LANES, myy)
    _sum_rows(rows, MOMENTS + channels, sums, place)


@kernel
def _four_rows(rows: np.ndarray, first: int, count: int) -> object:
    zero = splat(np.float32(0))
    if first >= count:
        return zero
    a = load(rows, first * LANES)
    b = load(rows, (first + 1) * LANES) if first + 1 < count else zero
    c = load(rows, (first + 2) * LANES) if first + 2 < count else zero
    d = load(rows, (first + 3) * LANES) if first + 3 < count else zero
    return fold2(fold1(a, b), fold1(c, d))


@kernel
def _sum_rows(rows: np.ndarray, count: int, sums: np.ndarray, place: int) -> None:
    """Write the sum of each vector in ``rows`` to sums[place:], sixteen at a time."""
    for first in range(0, count, LANES):
        near = fold4(_four_rows(rows, first, count), _four_rows(rows, first + 4, count))
        far = fold4(_four_rows(rows, first + 8, count), _four_rows(rows, first + 12, count))
        store(sums, place + first, fold8(near, far))


@kernel
def gather_slots(
    view: int,
    begin: int,
    end: int,
    order: np.ndarray,
    slots: np.ndarray,
    pair_bits: np.ndarray,
    records: np.ndarray,
    sums: np.ndarray,
    width: int,
    v_means2d: np.ndarray,
    v_records: np.ndarray,
    v_features: np.ndarray,
) -> None:
    """Add each Gaussian's slots into the zeroed gradients of means2d, records and features, for sorted begin..end.

    A Gaussian occurs once in a view's order, so chunks of one view never share a row.
    """
    channels = v_features.shape[1]
    total = np.empty(width, np.float32)
    for k in range(begin, end):
        n = order[view, k]
        total[:] = 0
        for slot in range(slots[view, k], slots[view, k + 1]):
            if pair_bits[slot] != 0:
                for i in range(MOMENTS + channels):
                    total[i] += sums[slot * width + i]
        m, mx, my, mxx, mxy, myy = total[0], total[1], total[2], total[3], total[4], total[5]
        xx, xy, yy = records[view, n, XX], records[view, n, XY], records[view, n, YY]
        v_means2d[view, n, 0] = -LN2 * (2 * xx * mx + xy * my)
        v_means2d[view, n, 1] = -LN2 * (2 * yy * my + xy * mx)
        v_records[view, n, XX], v_records[view, n, XY], v_records[view, n, YY] = LN2 * mxx, LN2 * mxy, LN2 * myy
        v_records[view, n, LOG_OPACITY] = LN2 * m
        for channel in range(channels):
            v_features[n, channel] += total[MOMENTS + channel]
