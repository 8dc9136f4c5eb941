"""The deformation network on a block of 96 Gaussians: features are rows, Gaussians are the lanes of a row.

All matrices and biases lie in one flat array, each padded with zeros to multiples of sixteen; `Layout` says where.
"""

from typing import NamedTuple

import numpy as np

from rewild4d.kernels.compiling import kernel
from rewild4d.kernels.halves import add_pair_product, pair_matrix, pair_rows, pair_vectors
from rewild4d.kernels.matrix import add_product, transpose
from rewild4d.kernels.powers import LOG2_E, exp2
from rewild4d.kernels.rows import add_row_sums
from rewild4d.kernels.simd import LANES, divide, fma, load, maximum, select_gt, splat, store

BLOCK = 96
"""Gaussians side by side: six vectors."""
OUTPUTS = 9


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


class Factors(NamedTuple):
    """The network's numbers.

    Attributes:
        flat: matrices and biases, float32, [total].
        along: words of the matrices (kernels/halves.py), the one at ``first`` from first // 2; empty where products are
            to be made in single precision, [total / 2].
        across: words of their transposes, likewise.
    """

    flat: np.ndarray
    along: np.ndarray
    across: np.ndarray


@kernel
def round_up(size: int) -> int:
    """The next multiple of sixteen."""
    return (size + LANES - 1) // LANES * LANES


@kernel
def pair_layers(bits: np.ndarray, sizes: Layout, along: np.ndarray, across: np.ndarray) -> None:
    """Set the words of `Factors`, as int32, from the bits of its flat array."""
    q, s, w = round_up(sizes.inputs), round_up(sizes.scores), round_up(sizes.width)
    pair_matrix(bits, sizes.ask, s, q, along, across, sizes.ask // 2)
    pair_matrix(bits, sizes.skip, w, q, along, across, sizes.skip // 2)
    pair_matrix(bits, sizes.mix, w, s, along, across, sizes.mix // 2)
    pair_matrix(bits, sizes.up, w, w, along, across, sizes.up // 2)
    pair_matrix(bits, sizes.down, w, w, along, across, sizes.down // 2)
    pair_matrix(bits, sizes.out, LANES, w, along, across, sizes.out // 2)


@kernel
def _bias(flat: np.ndarray, first: int, rows: int, columns: int, result: np.ndarray) -> None:
    """Start rows of a block with the bias that follows a matrix."""
    for row in range(rows):
        value = splat(flat[first + rows * columns + row])
        for lane in range(0, BLOCK, LANES):
            store(result, row * BLOCK + lane, value)


@kernel
def _layer(
    net: Factors, first: int, rows: int, columns: int, given: np.ndarray, words: np.ndarray, result: np.ndarray
) -> None:
    """Add matrix times block to a block; ``words`` is scratch."""
    if len(net.along) > 0:
        pair_rows(given, columns, BLOCK, words)
        half = columns // 2
        add_pair_product(net.along, first // 2, half, words, 0, BLOCK, half, result, 0, BLOCK, rows, BLOCK)
    else:
        add_product(net.flat, first, columns, 1, given, 0, BLOCK, columns, result, 0, BLOCK, rows, BLOCK)


@kernel
def _layer_back(
    net: Factors, first: int, rows: int, columns: int, slope: np.ndarray, words: np.ndarray, result: np.ndarray,
    wanted: int,
) -> None:  # fmt: skip
    """Add the first ``wanted`` rows of the transposed matrix, times a block, to a block; ``words`` is scratch."""
    if len(net.across) > 0:
        pair_rows(slope, rows, BLOCK, words)
        half = rows // 2
        add_pair_product(net.across, first // 2, half, words, 0, BLOCK, half, result, 0, BLOCK, wanted, BLOCK)
    else:
        add_product(net.flat, first, 1, columns, slope, 0, BLOCK, rows, result, 0, BLOCK, wanted, BLOCK)


@kernel
def _layer_gradient(
    half: bool, slope: np.ndarray, given: np.ndarray, words: np.ndarray, turned: np.ndarray, rows: int, columns: int,
    gradient: np.ndarray, first: int,
) -> None:  # fmt: skip
    """Add this block's share to the gradient of a matrix and of the bias behind it; words and turned are scratch."""
    if half:
        pair_vectors(given, columns, BLOCK, words)
        transpose(words, columns, BLOCK // 2, turned)
        pair_vectors(slope, rows, BLOCK, words)
        add_pair_product(words, 0, BLOCK // 2, turned, 0, columns, BLOCK // 2, gradient, first, columns, rows, columns)
    else:
        transpose(given, columns, BLOCK, turned)
        add_product(slope, 0, BLOCK, 1, turned, 0, columns, BLOCK, gradient, first, columns, rows, columns)
    bias = first + rows * columns
    add_row_sums(slope, rows, BLOCK, turned, gradient[bias : bias + rows])


@kernel
def _positive(given: np.ndarray, count: int, result: np.ndarray) -> None:
    zero = splat(np.float32(0))
    for i in range(0, count, LANES):
        store(result, i, maximum(zero, load(given, i)))  # in this order a NaN stays one


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
                power = exp2(maximum(lowest, (load(scores, first + part * BLOCK) - top) * log2_e))
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
    net: Factors, sizes: Layout, query: np.ndarray, words: np.ndarray, shares: np.ndarray, first: np.ndarray,
    opened: np.ndarray, middle: np.ndarray, last: np.ndarray, out: np.ndarray,
) -> None:  # fmt: skip
    """Run the network on one block.

    Args:
        net: matrices and biases.
        sizes: their layout.
        query: given, [inputs, 96].
        words: scratch, as large as the largest block.
        shares: attention of each head over the parts, [scores, 96].
        first: hidden features before the residual layers; kept after relu in ``opened``, [width, 96].
        opened: [width, 96].
        middle: inside the residual, after relu, [width, 96].
        last: hidden features after it, after relu, [width, 96].
        out: [16, 96], nine rows count.
    """
    q, s, w = round_up(sizes.inputs), round_up(sizes.scores), round_up(sizes.width)
    _bias(net.flat, sizes.ask, s, q, shares)
    _layer(net, sizes.ask, s, q, query, words, shares)
    _softmax(shares, sizes.heads, sizes.scores // sizes.heads)
    _bias(net.flat, sizes.skip, w, q, first)
    _layer(net, sizes.skip, w, q, query, words, first)
    _layer(net, sizes.mix, w, s, shares, words, first)
    _positive(first, w * BLOCK, opened)
    _bias(net.flat, sizes.up, w, w, middle)
    _layer(net, sizes.up, w, w, opened, words, middle)
    _positive(middle, w * BLOCK, middle)
    _bias(net.flat, sizes.down, w, w, last)
    for i in range(0, w * BLOCK, LANES):
        store(last, i, load(last, i) + load(first, i))
    _layer(net, sizes.down, w, w, middle, words, last)
    _positive(last, w * BLOCK, last)
    _bias(net.flat, sizes.out, LANES, w, out)
    _layer(net, sizes.out, LANES, w, last, words, out)


@kernel
def backward_block(
    net: Factors, sizes: Layout, query: np.ndarray, words: np.ndarray, shares: np.ndarray, opened: np.ndarray,
    middle: np.ndarray, last: np.ndarray, slope_out: np.ndarray, slope: np.ndarray, inner: np.ndarray,
    on_shares: np.ndarray, turned: np.ndarray, gradient: np.ndarray, on_query: np.ndarray,
) -> None:  # fmt: skip
    """The gradient of one block, after `forward_block` has filled its arguments.

    Args:
        net: matrices and biases.
        sizes: their layout.
        query: given, [inputs, 96].
        words: scratch, as large as the largest block.
        shares: from the forward pass.
        opened: from the forward pass.
        middle: from the forward pass.
        last: from the forward pass.
        slope_out: gradient of ``out``, [16, 96].
        slope: scratch, [width, 96].
        inner: scratch, [width, 96].
        on_shares: scratch, [scores, 96].
        turned: scratch for a transposed block.
        gradient: as ``flat``, added to.
        on_query: gradient of the first sixteen inputs, set, [16, 96].
    """
    q, s, w = round_up(sizes.inputs), round_up(sizes.scores), round_up(sizes.width)
    half = len(net.along) > 0
    _layer_gradient(half, slope_out, last, words, turned, LANES, w, gradient, sizes.out)
    slope[:] = 0
    _layer_back(net, sizes.out, LANES, w, slope_out, words, slope, w)
    _where_positive(last, w * BLOCK, slope)
    _layer_gradient(half, slope, middle, words, turned, w, w, gradient, sizes.down)
    inner[:] = 0
    _layer_back(net, sizes.down, w, w, slope, words, inner, w)
    _where_positive(middle, w * BLOCK, inner)
    _layer_gradient(half, inner, opened, words, turned, w, w, gradient, sizes.up)
    # The hidden features feed the residual and what lies inside it.
    turned[:] = 0
    _layer_back(net, sizes.up, w, w, inner, words, turned, w)
    _where_positive(opened, w * BLOCK, turned)
    for i in range(0, w * BLOCK, LANES):
        store(slope, i, load(slope, i) + load(turned, i))
    _layer_gradient(half, slope, shares, words, turned, w, s, gradient, sizes.mix)
    on_shares[:] = 0
    _layer_back(net, sizes.mix, w, s, slope, words, on_shares, s)
    _softmax_back(shares, sizes.heads, sizes.scores // sizes.heads, on_shares)
    _layer_gradient(half, on_shares, query, words, turned, s, q, gradient, sizes.ask)
    _layer_gradient(half, slope, query, words, turned, w, q, gradient, sizes.skip)
    on_query[:] = 0
    _layer_back(net, sizes.ask, s, q, on_shares, words, on_query, LANES)
    _layer_back(net, sizes.skip, w, q, slope, words, on_query, LANES)
