"""Transformer layers on a few tokens: features are rows, tokens are the lanes of a row."""

import math

import numpy as np

from rewild4d.kernels.compiling import kernel
from rewild4d.kernels.matrix import add_product, transpose
from rewild4d.kernels.powers import LOG2_E, exp2
from rewild4d.kernels.rows import add_row_sums, sum_rows
from rewild4d.kernels.simd import LANES, absolute, divide, fma, load, maximum, select_gt, splat, store

NORM_EPS = 1e-5
"""As in `torch.nn.LayerNorm`."""


@kernel
def linear(weight: np.ndarray, bias: np.ndarray, given: np.ndarray, wide: int, result: np.ndarray) -> None:
    """Add matrix times rows, and the bias, to rows of ``wide`` lanes; a multiple of 8 outputs."""
    rows = len(bias)
    depth = len(weight) // rows
    for row in range(rows):
        value = splat(bias[row])
        for index in range(row * wide, (row + 1) * wide, LANES):
            store(result, index, load(result, index) + value)
    add_product(weight, 0, depth, 1, given, 0, wide, depth, result, 0, wide, rows, wide)


@kernel
def linear_back(weight: np.ndarray, rows: int, grad: np.ndarray, wide: int, result: np.ndarray) -> None:
    """Set rows to the transposed matrix times a gradient; a multiple of 8 inputs."""
    depth = len(weight) // rows
    result[: depth * wide] = 0
    add_product(weight, 0, 1, depth, grad, 0, wide, rows, result, 0, wide, depth, wide)


@kernel
def linear_gradient(
    grad: np.ndarray, given: np.ndarray, inputs: int, wide: int, tokens: int, scratch: np.ndarray, weight: np.ndarray,
    bias: np.ndarray,
) -> None:  # fmt: skip
    """Add the gradients of a matrix and of its bias; multiples of sixteen inputs and outputs."""
    rows = len(bias)
    transpose(given, inputs, wide, scratch)
    add_product(grad, 0, wide, 1, scratch, 0, inputs, tokens, weight, 0, inputs, rows, inputs)
    add_row_sums(grad, rows, wide, scratch, bias)


@kernel
def normalise(hidden: np.ndarray, width: int, wide: int, plain: np.ndarray, inverse: np.ndarray) -> None:
    """Normalise each token to mean 0 and deviation 1; set one over the deviation."""
    share = splat(np.float32(1 / width))
    for lane in range(0, wide, LANES):
        mean, square = splat(np.float32(0)), splat(np.float32(0))
        for row in range(width):
            mean = mean + load(hidden, row * wide + lane)
        mean = mean * share
        for row in range(width):
            apart = load(hidden, row * wide + lane) - mean
            square = fma(apart, apart, square)
        store(inverse, lane, square * share)
        for i in range(lane, lane + LANES):
            inverse[i] = np.float32(1 / math.sqrt(inverse[i] + NORM_EPS))
        factor = load(inverse, lane)
        for row in range(width):
            store(plain, row * wide + lane, (load(hidden, row * wide + lane) - mean) * factor)


@kernel
def scale_rows(plain: np.ndarray, weight: np.ndarray, bias: np.ndarray, wide: int, result: np.ndarray) -> None:
    """Multiply each row by a weight and add a bias."""
    for row in range(len(weight)):
        factor, start = splat(weight[row]), splat(bias[row])
        for index in range(row * wide, (row + 1) * wide, LANES):
            store(result, index, fma(factor, load(plain, index), start))


@kernel
def normalise_back(
    plain: np.ndarray, inverse: np.ndarray, weight: np.ndarray, wide: int, grad: np.ndarray, scratch: np.ndarray,
    on_weight: np.ndarray, on_bias: np.ndarray, on_hidden: np.ndarray,
) -> None:  # fmt: skip
    """Add the gradients of `normalise` and `scale_rows`; overwrites ``grad``."""
    width = len(weight)
    add_row_sums(grad, width, wide, scratch, on_bias)
    for row in range(width):
        total, factor = splat(np.float32(0)), splat(weight[row])
        for index in range(row * wide, (row + 1) * wide, LANES):
            value = load(grad, index)
            total = fma(value, load(plain, index), total)
            store(grad, index, value * factor)
        store(scratch, row * LANES, total)
    sum_rows(scratch, width, scratch, 0)
    for row in range(0, width, LANES):
        store(on_weight, row, load(on_weight, row) + load(scratch, row))
    share = splat(np.float32(1 / width))
    for lane in range(0, wide, LANES):
        mean, along = splat(np.float32(0)), splat(np.float32(0))
        for row in range(width):
            value = load(grad, row * wide + lane)
            mean, along = mean + value, fma(value, load(plain, row * wide + lane), along)
        mean, along, factor = mean * share, along * share, load(inverse, lane)
        for row in range(width):
            index = row * wide + lane
            change = load(grad, index) - mean - along * load(plain, index)
            store(on_hidden, index, fma(change, factor, load(on_hidden, index)))


@kernel
def gelu(given: np.ndarray, count: int, bend: np.ndarray) -> None:
    """Compute x Phi(x) in place, and its derivative; Phi to 8e-8 (Abramowitz and Stegun 7.1.26)."""
    zero, one, half = splat(np.float32(0)), splat(np.float32(1)), splat(np.float32(0.5))
    lowest, exponent = splat(np.float32(-126)), splat(np.float32(-0.5) * LOG2_E)
    for index in range(0, count, LANES):
        x = load(given, index)
        bell = exp2(maximum(lowest, x * x * exponent))
        t = divide(one, fma(absolute(x), splat(np.float32(0.3275911 / math.sqrt(2.0))), one))
        tail = fma(t, splat(np.float32(1.061405429)), splat(np.float32(-1.453152027)))
        tail = fma(tail, t, splat(np.float32(1.421413741)))
        tail = fma(tail, t, splat(np.float32(-0.284496736)))
        tail = fma(tail, t, splat(np.float32(0.254829592))) * t * bell * half
        below = select_gt(x, zero, one - tail, tail)
        store(given, index, x * below)
        store(bend, index, fma(x * bell, splat(np.float32(1 / math.sqrt(2 * math.pi))), below))


@kernel
def softmax(scores: np.ndarray, first: int, keys: int, wide: int, factor: float) -> None:
    """Apply softmax over the rows to the scores times a factor, in place."""
    lowest, scale = splat(np.float32(-126)), splat(np.float32(factor) * LOG2_E)
    for lane in range(first, first + wide, LANES):
        top, total = load(scores, lane), splat(np.float32(0))
        for key in range(1, keys):
            top = maximum(top, load(scores, lane + key * wide))
        for key in range(keys):
            power = exp2(maximum(lowest, (load(scores, lane + key * wide) - top) * scale))
            store(scores, lane + key * wide, power)
            total = total + power
        share = divide(splat(np.float32(1)), total)
        for key in range(keys):
            store(scores, lane + key * wide, load(scores, lane + key * wide) * share)


@kernel
def softmax_back(shares: np.ndarray, first: int, keys: int, wide: int, factor: float, grad: np.ndarray) -> None:
    """Compute the gradient of the scores from that of the shares, in place."""
    scale = splat(np.float32(factor))
    for lane in range(0, wide, LANES):
        mean = splat(np.float32(0))
        for key in range(keys):
            mean = fma(load(shares, first + lane + key * wide), load(grad, lane + key * wide), mean)
        for key in range(keys):
            index = lane + key * wide
            store(grad, index, load(shares, first + index) * (load(grad, index) - mean) * scale)


@kernel
def _copy_lanes(
    source: np.ndarray, wide: int, lanes: int, rows: int, target: np.ndarray, index: int, step: int
) -> None:
    """Copy the first lanes of rows ``wide`` apart to rows ``step`` apart."""
    for row in range(rows):
        for lane in range(lanes):
            target[index + row * step + lane] = source[row * wide + lane]


@kernel
def attend(qkv: np.ndarray, width: int, heads: int, joints: int, items: int, wide: int, shares: np.ndarray,
           mixed: np.ndarray) -> None:  # fmt: skip
    """Apply self-attention within each item; item b has the lanes from b joints on.

    Reads queries, keys and values, [3 width, wide]. Sets the weights of keys (rows) for queries (lanes), [items, heads,
    P, P] with P joints padded to sixteen, and mixed [width, wide], zero in unused lanes.
    """
    size, tile = width // heads, (joints + LANES - 1) // LANES * LANES
    keys = (joints + 7) // 8 * 8
    part = np.empty(size * tile, np.float32)
    shares[:] = 0
    mixed[:] = 0
    # Columns and rows past an item's own belong to its neighbours: computed, never used.
    for item in range(items):
        for head in range(heads):
            query, slot = head * size * wide + item * joints, (item * heads + head) * tile * tile
            key, value = query + width * wide, query + 2 * width * wide
            add_product(qkv, key, 1, wide, qkv, query, wide, size, shares, slot, tile, keys, tile)
            softmax(shares, slot, joints, tile, size**-0.5)
            part[:] = 0
            add_product(qkv, value, wide, 1, shares, slot, tile, joints, part, 0, tile, size, tile)
            _copy_lanes(part, tile, joints, size, mixed, query, wide)


@kernel
def attend_back(qkv: np.ndarray, width: int, heads: int, joints: int, items: int, wide: int, shares: np.ndarray,
                on_mixed: np.ndarray, on_qkv: np.ndarray) -> None:  # fmt: skip
    """Set ``on_qkv``, the gradient of `attend`, in the items' lanes; ``on_mixed`` has sixteen numbers to spare."""
    size, tile = width // heads, (joints + LANES - 1) // LANES * LANES
    keys = (joints + 7) // 8 * 8
    part, on_shares = np.empty(size * tile, np.float32), np.empty(tile * tile, np.float32)
    transposed = np.empty(tile * tile, np.float32)
    for item in range(items):
        for head in range(heads):
            query, slot = head * size * wide + item * joints, (item * heads + head) * tile * tile
            key, value = query + width * wide, query + 2 * width * wide
            transpose(shares[slot : slot + tile * tile], tile, tile, transposed)
            part[:] = 0
            add_product(on_mixed, query, wide, 1, transposed, 0, tile, joints, part, 0, tile, size, tile)
            _copy_lanes(part, tile, joints, size, on_qkv, value, wide)
            on_shares[:] = 0
            add_product(qkv, value, 1, wide, on_mixed, query, wide, size, on_shares, 0, tile, keys, tile)
            softmax_back(shares, slot, joints, tile, size**-0.5, on_shares)
            part[:] = 0
            add_product(qkv, key, wide, 1, on_shares, 0, tile, joints, part, 0, tile, size, tile)
            _copy_lanes(part, tile, joints, size, on_qkv, query, wide)
            transpose(on_shares, tile, tile, transposed)
            part[:] = 0
            add_product(qkv, query, wide, 1, transposed, 0, tile, joints, part, 0, tile, size, tile)
            _copy_lanes(part, tile, joints, size, on_qkv, key, wide)
