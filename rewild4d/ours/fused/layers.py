"""The deformation network on a block of 48 Gaussians: features are rows, Gaussians are the lanes of a row.

All matrices and biases lie in one flat array, each padded with zeros to multiples of sixteen; `Layout` says where.
"""

from typing import NamedTuple

import numpy as np

from rewild4d.kernels.compiling import kernel
from rewild4d.kernels.matrix import add_product, transpose_tile
from rewild4d.kernels.rows import sum_rows
from rewild4d.kernels.simd import LANES, divide, exp2, fma, load, maximum, select_gt, splat, store

BLOCK = 48
"""Gaussians side by side: three vectors."""
OUTPUTS = 9
LOG2_E = np.float32(1.4426950408889634)


def padded(size: int) -> int:
    """The next multiple of sixteen."""
    return -(-size // LANES) * LANES


class Layout(NamedTuple):
    """Sizes of the network, and where its parts begin in the flat array (each matrix is followed by its bias).

    Attributes:
        inputs: of the query.
        scores: heads times parts.
        width: hidden width.
        heads: of the attention.
        ask: scores from the query, [scores, inputs].
        skip: hidden from the query, [width, inputs]; its bias is that of the whole sum.
        mix: hidden from the attention, [width, scores]; its bias is not used.
        up: [width, width].
        down: [width, width].
        out: [9, width].
        total: length of the flat array.
    """

    inputs: int
    scores: int
    width: int
    heads: int
    ask: int
    skip: int
    mix: int
    up: int
    down: int
    out: int
    total: int


def layout(inputs: int, scores: int, width: int, heads: int) -> Layout:
    """Where everything lies for a network of these sizes."""
    q, s, w = padded(inputs), padded(scores), padded(width)
    starts, place = [], 0
    for rows, columns in ((s, q), (w, q), (w, s), (w, w), (w, w), (padded(OUTPUTS), w)):
        starts.append(place)
        place += rows * (columns + 1)
    ask, skip, mix, up, down, out = starts
    return Layout(inputs, scores, width, heads, ask, skip, mix, up, down, out, place)


@kernel
def round_up(size: int) -> int:
    """The next multiple of sixteen."""
    return (size + LANES - 1) // LANES * LANES


@kernel
def _bias(flat: np.ndarray, first: int, rows: int, columns: int, result: np.ndarray) -> None:
    """Start rows of a block with the bias that follows a matrix."""
    for row in range(rows):
        value = splat(flat[first + rows * columns + row])
        for lane in range(0, BLOCK, LANES):
            store(result, row * BLOCK + lane, value)


@kernel
def _layer(flat: np.ndarray, first: int, rows: int, columns: int, given: np.ndarray, result: np.ndarray) -> None:
    """Add matrix times block to a block."""
    add_product(flat, first, columns, 1, given, 0, BLOCK, columns, result, 0, BLOCK, rows, BLOCK)


@kernel
def _layer_back(flat: np.ndarray, first: int, rows: int, columns: int, slope: np.ndarray, result: np.ndarray) -> None:
    """Set a block to the transposed matrix times a block."""
    result[: columns * BLOCK] = 0
    add_product(flat, first, 1, columns, slope, 0, BLOCK, rows, result, 0, BLOCK, columns, BLOCK)


@kernel
def _layer_gradient(
    slope: np.ndarray, given: np.ndarray, turned: np.ndarray, rows: int, columns: int, gradient: np.ndarray, first: int
) -> None:
    """Add this block's share to the gradient of a matrix and of the bias behind it."""
    for feature in range(0, columns, LANES):
        for lane in range(0, BLOCK, LANES):
            transpose_tile(given, feature * BLOCK + lane, BLOCK, turned, lane * columns + feature, columns)
    add_product(slope, 0, BLOCK, 1, turned, 0, columns, BLOCK, gradient, first, columns, rows, columns)
    # Scratch again: each row's three vectors become one, then one number.
    for row in range(rows):
        place = row * BLOCK
        total = load(slope, place) + load(slope, place + LANES) + load(slope, place + 2 * LANES)
        store(turned, row * LANES, total)
    sum_rows(turned, rows, turned, 0)
    bias = first + rows * columns
    for row in range(0, rows, LANES):
        store(gradient, bias + row, load(gradient, bias + row) + load(turned, row))


@kernel
def _positive(given: np.ndarray, count: int, result: np.ndarray) -> None:
    zero = splat(np.float32(0))
    for i in range(0, count, LANES):
        store(result, i, maximum(load(given, i), zero))


@kernel
def _where_positive(given: np.ndarray, count: int, slope: np.ndarray) -> None:
    zero = splat(np.float32(0))
    for i in range(0, count, LANES):
        store(slope, i, select_gt(load(given, i), zero, load(slope, i), zero))


@kernel
def _softmax(scores: np.ndarray, heads: int, parts: int) -> None:
    """Over the parts of each head, in place."""
    lowest, log2_e = splat(np.float32(-126)), splat(LOG2_E)
    for head in range(heads):
        for lane in range(0, BLOCK, LANES):
            first = head * parts * BLOCK + lane
            top = load(scores, first)
            for part in range(1, parts):
                top = maximum(top, load(scores, first + part * BLOCK))
            total = splat(np.float32(0))
            for part in range(parts):
                power = exp2(maximum((load(scores, first + part * BLOCK) - top) * log2_e, lowest))
                store(scores, first + part * BLOCK, power)
                total = total + power
            share = divide(splat(np.float32(1)), total)
            for part in range(parts):
                store(scores, first + part * BLOCK, load(scores, first + part * BLOCK) * share)


@kernel
def _softmax_back(shares: np.ndarray, heads: int, parts: int, slope: np.ndarray) -> None:
    """From the slope of the shares to that of the scores, in place."""
    for head in range(heads):
        for lane in range(0, BLOCK, LANES):
            first = head * parts * BLOCK + lane
            mean = splat(np.float32(0))
            for part in range(parts):
                place = first + part * BLOCK
                mean = fma(load(shares, place), load(slope, place), mean)
            for part in range(parts):
                place = first + part * BLOCK
                store(slope, place, load(shares, place) * (load(slope, place) - mean))


@kernel
def forward_block(
    flat: np.ndarray, sizes: Layout, query: np.ndarray, shares: np.ndarray, first: np.ndarray, opened: np.ndarray,
    middle: np.ndarray, last: np.ndarray, out: np.ndarray,
) -> None:  # fmt: skip
    """Run the network on one block.

    Args:
        flat: matrices and biases.
        sizes: its layout.
        query: given, [inputs, 48].
        shares: attention of each head over the parts, [scores, 48].
        first: hidden features before the residual layers; kept after relu in ``opened``, [width, 48].
        opened: [width, 48].
        middle: inside the residual, after relu, [width, 48].
        last: hidden features after it, after relu, [width, 48].
        out: [16, 48], nine rows count.
    """
    q, s, w = round_up(sizes.inputs), round_up(sizes.scores), round_up(sizes.width)
    _bias(flat, sizes.ask, s, q, shares)
    _layer(flat, sizes.ask, s, q, query, shares)
    _softmax(shares, sizes.heads, sizes.scores // sizes.heads)
    _bias(flat, sizes.skip, w, q, first)
    _layer(flat, sizes.skip, w, q, query, first)
    _layer(flat, sizes.mix, w, s, shares, first)
    _positive(first, w * BLOCK, opened)
    _bias(flat, sizes.up, w, w, middle)
    _layer(flat, sizes.up, w, w, opened, middle)
    _positive(middle, w * BLOCK, middle)
    _bias(flat, sizes.down, w, w, last)
    for i in range(0, w * BLOCK, LANES):
        store(last, i, load(last, i) + load(first, i))
    _layer(flat, sizes.down, w, w, middle, last)
    _positive(last, w * BLOCK, last)
    _bias(flat, sizes.out, LANES, w, out)
    _layer(flat, sizes.out, LANES, w, last, out)


@kernel
def backward_block(
    flat: np.ndarray, sizes: Layout, query: np.ndarray, shares: np.ndarray, opened: np.ndarray, middle: np.ndarray,
    last: np.ndarray, slope_out: np.ndarray, slope: np.ndarray, inner: np.ndarray, on_shares: np.ndarray,
    turned: np.ndarray, gradient: np.ndarray, on_query: np.ndarray,
) -> None:  # fmt: skip
    """The gradient of one block, after `forward_block` has filled its arguments.

    Args:
        flat: matrices and biases.
        sizes: its layout.
        query: given, [inputs, 48].
        shares: from the forward pass.
        opened: from the forward pass.
        middle: from the forward pass.
        last: from the forward pass.
        slope_out: gradient of ``out``, [16, 48].
        slope: scratch, [width, 48].
        inner: scratch, [width, 48].
        on_shares: scratch, [scores, 48].
        turned: scratch for a transposed block.
        gradient: as ``flat``, added to.
        on_query: gradient of the first sixteen inputs, set, [16, 48].
    """
    q, s, w = round_up(sizes.inputs), round_up(sizes.scores), round_up(sizes.width)
    _layer_gradient(slope_out, last, turned, LANES, w, gradient, sizes.out)
    _layer_back(flat, sizes.out, LANES, w, slope_out, slope)
    _where_positive(last, w * BLOCK, slope)
    _layer_gradient(slope, middle, turned, w, w, gradient, sizes.down)
    _layer_back(flat, sizes.down, w, w, slope, inner)
    _where_positive(middle, w * BLOCK, inner)
    _layer_gradient(inner, opened, turned, w, w, gradient, sizes.up)
    # The hidden features feed the residual and what lies inside it.
    _layer_back(flat, sizes.up, w, w, inner, turned)
    _where_positive(opened, w * BLOCK, turned)
    for i in range(0, w * BLOCK, LANES):
        store(slope, i, load(slope, i) + load(turned, i))
    _layer_gradient(slope, shares, turned, w, s, gradient, sizes.mix)
    _layer_back(flat, sizes.mix, w, s, slope, on_shares)
    _softmax_back(shares, sizes.heads, sizes.scores // sizes.heads, on_shares)
    _layer_gradient(on_shares, query, turned, s, q, gradient, sizes.ask)
    _layer_gradient(slope, query, turned, w, q, gradient, sizes.skip)
    on_query[:] = 0
    add_product(flat, sizes.ask, 1, q, on_shares, 0, BLOCK, s, on_query, 0, BLOCK, LANES, BLOCK)
    add_product(flat, sizes.skip, 1, q, slope, 0, BLOCK, w, on_query, 0, BLOCK, LANES, BLOCK)
