"""The deformation network on a block of 96 Gaussians: features are rows, Gaussians are the lanes of a row.

All matrices and biases lie in one flat array, padded with zeros to multiples of sixteen; see `Layout`.
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


@kernel
def round_up(size: int) -> int:
    """Round up to a multiple of sixteen."""
    return (size + LANES - 1) // LANES * LANES


class Layout(NamedTuple):
    """Sizes of the network, and where its matrices begin in the flat array; each is followed by its bias."""

    inputs: int  # of the query
    scores: int  # heads times parts
    width: int  # hidden width
    heads: int  # of the attention
    ask: int  # scores from the query, [scores, inputs]
    skip: int  # hidden features from the query, [width, inputs]; with the bias of the whole sum
    mix: int  # hidden features from the attention, [width, scores]; bias unused
    up: int  # [width, width]
    down: int  # [width, width]
    out: int  # [9, width]
    total: int  # length of the flat array


def layout(inputs: int, scores: int, width: int, heads: int) -> Layout:
    """Lay out a network of these sizes."""
    q, s, w = round_up(inputs), round_up(scores), round_up(width)
    starts, index = [], 0
    for rows, columns in ((s, q), (w, q), (w, s), (w, w), (w, w), (round_up(OUTPUTS), w)):
        starts.append(index)
        index += rows * (columns + 1)
    ask, skip, mix, up, down, out = starts
    return Layout(inputs, scores, width, heads, ask, skip, mix, up, down, out, index)


class Factors(NamedTuple):
    """The network's numbers."""

    flat: np.ndarray  # matrices and biases, float32, [total]
    along: np.ndarray  # bfloat16 words of the matrices (kernels/halves.py), or empty, [total / 2]
    across: np.ndarray  # bfloat16 words of their transposes, or empty, [total / 2]


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
    """Fill rows of a block with the bias that follows a matrix."""
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
    net: Factors, first: int, rows: int, columns: int, grad: np.ndarray, words: np.ndarray, result: np.ndarray,
    wanted: int,
) -> None:  # fmt: skip
    """Add the first ``wanted`` rows of the transposed matrix times a block to a block; ``words`` is scratch."""
    if len(net.across) > 0:
        pair_rows(grad, rows, BLOCK, words)
        half = rows // 2
        add_pair_product(net.across, first // 2, half, words, 0, BLOCK, half, result, 0, BLOCK, wanted, BLOCK)
    else:
        add_product(net.flat, first, 1, columns, grad, 0, BLOCK, rows, result, 0, BLOCK, wanted, BLOCK)


@kernel
def _layer_gradient(
    half: bool, grad: np.ndarray, given: np.ndarray, words: np.ndarray, transposed: np.ndarray, rows: int, columns: int,
    gradient: np.ndarray, first: int,
) -> None:  # fmt: skip
    """Add this block's gradient of a matrix and of the bias behind it; words and transposed are scratch."""
    if half:
        pair_vectors(given, columns, BLOCK, words)
        transpose(words, columns, BLOCK // 2, transposed)
        pair_vectors(grad, rows, BLOCK, words)
        add_pair_product(
            words, 0, BLOCK // 2, transposed, 0, columns, BLOCK // 2, gradient, first, columns, rows, columns
        )
    else:
        transpose(given, columns, BLOCK, transposed)
        add_product(grad, 0, BLOCK, 1, transposed, 0, columns, BLOCK, gradient, first, columns, rows, columns)
    bias = first + rows * columns
    add_row_sums(grad, rows, BLOCK, transposed, gradient[bias : bias + rows])


@kernel
def _positive(given: np.ndarray, count: int, result: np.ndarray) -> None:
    zero = splat(np.float32(0))
    for i in range(0, count, LANES):
        store(result, i, maximum(zero, load(given, i)))  # in this order a NaN stays one


@kernel
def _where_positive(given: np.ndarray, count: int, grad: np.ndarray) -> None:
    zero = splat(np.float32(0))
    for i in range(0, count, LANES):
        store(grad, i, select_gt(load(given, i), zero, load(grad, i), zero))


@kernel
def _softmax(scores: np.ndarray, heads: int, parts: int) -> None:
    """Apply softmax over the parts of each head, in place."""
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
def _softmax_back(shares: np.ndarray, heads: int, parts: int, grad: np.ndarray) -> None:
    """Compute the gradient of the scores from that of the shares, in place."""
    for head in range(heads):
        for lane in range(0, BLOCK, LANES):
            first = head * parts * BLOCK + lane
            mean = splat(np.float32(0))
            for part in range(parts):
                index = first + part * BLOCK
                mean = fma(load(shares, index), load(grad, index), mean)
            for part in range(parts):
                index = first + part * BLOCK
                store(grad, index, load(shares, index) * (load(grad, index) - mean))


class Blocks(NamedTuple):
    """Features of one block, [rows, 96]."""

    query: np.ndarray  # [inputs, 96]
    words: np.ndarray  # scratch, as large as the largest block
    shares: np.ndarray  # attention of each head over the parts, [scores, 96]
    first: np.ndarray  # hidden features before the residual layers, [width, 96]
    opened: np.ndarray  # the same after relu
    middle: np.ndarray  # inside the residual, after relu
    last: np.ndarray  # after the residual and relu
    out: np.ndarray  # outputs, nine rows of which count, [16, 96]


@kernel
def allocate_blocks(sizes: Layout) -> Blocks:
    """Allocate the features of one block."""
    inputs, scores = round_up(sizes.inputs) * BLOCK, round_up(sizes.scores) * BLOCK
    wide, out = round_up(sizes.width) * BLOCK, np.empty(LANES * BLOCK, np.float32)
    query, shares = np.empty(inputs, np.float32), np.empty(scores, np.float32)
    words, first = np.empty(max(wide, scores, inputs), np.float32), np.empty(wide, np.float32)
    opened, middle, last = np.empty_like(first), np.empty_like(first), np.empty_like(first)
    return Blocks(query, words, shares, first, opened, middle, last, out)


@kernel
def forward_block(net: Factors, sizes: Layout, blocks: Blocks) -> None:
    """Run the network on the query of one block; set the other features."""
    query, words, shares, first, opened, middle, last, out = blocks
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
    net: Factors, sizes: Layout, blocks: Blocks, grad_out: np.ndarray, grad: np.ndarray, inner: np.ndarray,
    on_shares: np.ndarray, transposed: np.ndarray, gradient: np.ndarray, on_query: np.ndarray,
) -> None:  # fmt: skip
    """Compute the gradient of one block from grad_out [16, 96], after `forward_block`.

    Adds to ``gradient``, laid out as ``flat``, and sets ``on_query`` [16, 96], the gradient of the first inputs.
    Scratch: grad, inner, on_shares, transposed.
    """
    query, words, shares, _, opened, middle, last, _ = blocks
    q, s, w = round_up(sizes.inputs), round_up(sizes.scores), round_up(sizes.width)
    half = len(net.along) > 0
    _layer_gradient(half, grad_out, last, words, transposed, LANES, w, gradient, sizes.out)
    grad[:] = 0
    _layer_back(net, sizes.out, LANES, w, grad_out, words, grad, w)
    _where_positive(last, w * BLOCK, grad)
    _layer_gradient(half, grad, middle, words, transposed, w, w, gradient, sizes.down)
    inner[:] = 0
    _layer_back(net, sizes.down, w, w, grad, words, inner, w)
    _where_positive(middle, w * BLOCK, inner)
    _layer_gradient(half, inner, opened, words, transposed, w, w, gradient, sizes.up)
    # The hidden features feed the residual and what lies inside it.
    transposed[:] = 0
    _layer_back(net, sizes.up, w, w, inner, words, transposed, w)
    _where_positive(opened, w * BLOCK, transposed)
    for i in range(0, w * BLOCK, LANES):
        store(grad, i, load(grad, i) + load(transposed, i))
    _layer_gradient(half, grad, shares, words, transposed, w, s, gradient, sizes.mix)
    on_shares[:] = 0
    _layer_back(net, sizes.mix, w, s, grad, words, on_shares, s)
    _softmax_back(shares, sizes.heads, sizes.scores // sizes.heads, on_shares)
    _layer_gradient(half, on_shares, query, words, transposed, s, q, gradient, sizes.ask)
    _layer_gradient(half, grad, query, words, transposed, w, q, gradient, sizes.skip)
    on_query[:] = 0
    _layer_back(net, sizes.ask, s, q, on_shares, words, on_query, LANES)
    _layer_back(net, sizes.skip, w, q, grad, words, on_query, LANES)
