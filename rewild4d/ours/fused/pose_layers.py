"""The layers of the pose network on a few codes: features are rows, tokens are the lanes of a row.

Parameters come as addresses in the order of `PoseNetwork.parameters`; ``starts`` says where each one's gradient begins
in a flat array.
"""

from functools import cache
from typing import NamedTuple

import numpy as np

from rewild4d.kernels.compiling import kernel
from rewild4d.kernels.matrix import add_product
from rewild4d.kernels.pointers import floats_at
from rewild4d.kernels.simd import LANES, fma, load, splat, store
from rewild4d.ours.fused.tokens import (
    attend,
    attend_back,
    gelu,
    linear,
    linear_back,
    linear_gradient,
    normalise,
    normalise_back,
    scale_rows,
    transpose,
)

ITEMS = 12
"""Codes of a unit of work; gradients are summed by unit, so they do not depend on the number of threads."""
OUTPUTS = 7
"""Quaternion and shift of a joint."""
OF_BLOCK = 12
"""Parameters of a block: two of each norm, then of qkv, project, up and down."""


class Sizes(NamedTuple):
    """Sizes of a network and of a unit of work."""

    joints: int  # tokens of an item
    anchor: int  # length of an anchor
    inputs: int  # of the embedding, anchor and code
    width: int  # of a token
    heads: int  # of the attention
    blocks: int  # how many
    shift_scale: float  # shift per unit of the head's output
    items: int  # of a full unit
    wide: int  # its tokens, padded to sixteen
    shares: int  # numbers of its attention in a block
    kept: int  # numbers that a unit keeps for the backward pass


def fits_sizes(width: int, heads: int) -> bool:
    """Tell whether the kernels support this width and number of heads."""
    return width % LANES == 0 and width % (8 * heads) == 0


@cache
def sizes_of(
    joints: int, anchor: int, inputs: int, width: int, heads: int, blocks: int, shift_scale: float, items: int
) -> Sizes:
    """Return the sizes for a batch of ``items``."""
    items = min(max(1, items), ITEMS)
    wide, tile = (-(-count // LANES) * LANES for count in (items * joints, joints))
    shares = items * heads * tile * tile
    of_block = (10 * width + 2) * wide + shares
    kept = (-(-inputs // LANES) * LANES + width + 1 + 8) * wide + blocks * of_block
    return Sizes(joints, anchor, inputs, width, heads, blocks, shift_scale, items, wide, shares, kept)


@kernel
def _ends(kept: np.ndarray, s: Sizes) -> tuple:
    """Return views of what a unit keeps beside its blocks: inputs, last norm, its inverse deviation, outputs."""
    inputs = (s.inputs + LANES - 1) // LANES * LANES * s.wide
    plain, inverse = inputs + s.width * s.wide, inputs + (s.width + 1) * s.wide
    return kept[:inputs], kept[inputs:plain], kept[plain:inverse], kept[inverse : inverse + 8 * s.wide]


@kernel
def outputs(kept: np.ndarray, s: Sizes) -> np.ndarray:
    """Return the head's outputs of a unit, [8, wide]."""
    return _ends(kept, s)[3]


@kernel
def _block(kept: np.ndarray, s: Sizes, block: int) -> tuple:
    """Return views of what a unit keeps of a block: norms, inverse deviations, attention, perceptron, derivative."""
    of_block = (10 * s.width + 2) * s.wide + s.shares
    own = kept[len(kept) - (s.blocks - block) * of_block :]
    layer, inverse, spare = s.width * s.wide, 10 * s.width * s.wide, (10 * s.width + 2) * s.wide
    return (
        own[:layer], own[inverse : inverse + s.wide], own[layer : 4 * layer], own[spare : spare + s.shares],
        own[4 * layer : 5 * layer], own[5 * layer : 6 * layer], own[inverse + s.wide : spare],
        own[6 * layer : 8 * layer], own[8 * layer : 10 * layer],
    )  # fmt: skip


@kernel
def _parameter(addresses: np.ndarray, starts: np.ndarray, index: int) -> np.ndarray:
    return floats_at(addresses[index], starts[index + 1] - starts[index])


@kernel
def _gradient(flat: np.ndarray, starts: np.ndarray, index: int) -> np.ndarray:
    return flat[starts[index] : starts[index + 1]]


@kernel
def _embed(
    s: Sizes, addresses: np.ndarray, starts: np.ndarray, code: np.ndarray, inputs: np.ndarray, hidden: np.ndarray
) -> None:
    """Write anchors and code of each token as rows, then embed them."""
    anchors = _parameter(addresses, starts, 0)
    inputs[:] = 0
    for item in range(len(code)):
        for joint in range(s.joints):
            lane = item * s.joints + joint
            for i in range(s.anchor):
                inputs[i * s.wide + lane] = anchors[joint * s.anchor + i]
            for i in range(s.inputs - s.anchor):
                inputs[(s.anchor + i) * s.wide + lane] = code[item, i]
    hidden[:] = 0
    linear(_parameter(addresses, starts, 1), _parameter(addresses, starts, 2), inputs, s.wide, hidden)


@kernel
def _forward_blocks(
    s: Sizes, addresses: np.ndarray, starts: np.ndarray, items: int, kept: np.ndarray, hidden: np.ndarray,
    scaled: np.ndarray,
) -> None:  # fmt: skip
    for block in range(s.blocks):
        plain, inverse, qkv, shares, mixed, plain2, inverse2, opened, bend = _block(kept, s, block)
        at = 3 + OF_BLOCK * block
        normalise(hidden, s.width, s.wide, plain, inverse)
        scale_rows(plain, _parameter(addresses, starts, at), _parameter(addresses, starts, at + 1), s.wide, scaled)
        qkv[:] = 0
        linear(_parameter(addresses, starts, at + 4), _parameter(addresses, starts, at + 5), scaled, s.wide, qkv)
        attend(qkv, s.width, s.heads, s.joints, items, s.wide, shares, mixed)
        linear(_parameter(addresses, starts, at + 6), _parameter(addresses, starts, at + 7), mixed, s.wide, hidden)
        normalise(hidden, s.width, s.wide, plain2, inverse2)
        scale_rows(plain2, _parameter(addresses, starts, at + 2), _parameter(addresses, starts, at + 3), s.wide, scaled)
        opened[:] = 0
        linear(_parameter(addresses, starts, at + 8), _parameter(addresses, starts, at + 9), scaled, s.wide, opened)
        gelu(opened, len(opened), bend)
        linear(_parameter(addresses, starts, at + 10), _parameter(addresses, starts, at + 11), opened, s.wide, hidden)


@kernel
def _head(s: Sizes, addresses: np.ndarray, starts: np.ndarray, weight: np.ndarray, bias: np.ndarray) -> None:
    """Copy the head, with an eighth output that is always zero."""
    last = 3 + OF_BLOCK * s.blocks
    weight[:] = 0
    bias[:] = 0
    weight[: OUTPUTS * s.width] = _parameter(addresses, starts, last + 2)
    bias[:OUTPUTS] = _parameter(addresses, starts, last + 3)


@kernel
def forward_unit(
    s: Sizes, addresses: np.ndarray, starts: np.ndarray, code: np.ndarray, kept: np.ndarray, tokens_first: np.ndarray
) -> np.ndarray:
    """Run the network on codes [items, inputs - anchor]; return the outputs [8, wide], a part of ``kept``.

    Sets ``kept`` for `backward_unit`, and ``tokens_first``, the features of each token, [wide, width].
    """
    inputs, plain, inverse, out = _ends(kept, s)
    layer = s.width * s.wide
    hidden, scaled = np.empty(layer, np.float32), np.empty(layer, np.float32)
    _embed(s, addresses, starts, code, inputs, hidden)
    _forward_blocks(s, addresses, starts, len(code), kept, hidden, scaled)
    last = 3 + OF_BLOCK * s.blocks
    normalise(hidden, s.width, s.wide, plain, inverse)
    scale_rows(plain, _parameter(addresses, starts, last), _parameter(addresses, starts, last + 1), s.wide, scaled)
    weight, bias = np.empty(8 * s.width, np.float32), np.empty(8, np.float32)
    _head(s, addresses, starts, weight, bias)
    out[:] = 0
    linear(weight, bias, scaled, s.wide, out)
    transpose(scaled, s.width, s.wide, tokens_first)
    return out


@kernel
def _head_back(
    s: Sizes, addresses: np.ndarray, starts: np.ndarray, tokens: int, plain: np.ndarray, on_out: np.ndarray,
    grad: np.ndarray, scaled: np.ndarray, scratch: np.ndarray, flat: np.ndarray,
) -> None:  # fmt: skip
    """Add the head's gradients, and its part of the features' gradient."""
    last = 3 + OF_BLOCK * s.blocks
    scale_rows(plain, _parameter(addresses, starts, last), _parameter(addresses, starts, last + 1), s.wide, scaled)
    weight, bias = np.empty(8 * s.width, np.float32), np.empty(8, np.float32)
    _head(s, addresses, starts, weight, bias)
    add_product(weight, 0, 1, s.width, on_out, 0, s.wide, OUTPUTS, grad, 0, s.wide, s.width, s.wide)
    weight[:] = 0
    transpose(scaled, s.width, s.wide, scratch)
    add_product(on_out, 0, s.wide, 1, scratch, 0, s.width, tokens, weight, 0, s.width, 8, s.width)
    on_weight, on_bias = _gradient(flat, starts, last + 2), _gradient(flat, starts, last + 3)
    for i in range(len(on_weight)):
        on_weight[i] += weight[i]
    for row in range(OUTPUTS):
        for lane in range(tokens):
            on_bias[row] += on_out[row * s.wide + lane]


@kernel
def _embed_back(
    s: Sizes, addresses: np.ndarray, starts: np.ndarray, tokens: int, inputs: np.ndarray, grad: np.ndarray,
    scratch: np.ndarray, flat: np.ndarray,
) -> None:  # fmt: skip
    """Add the gradients of the embedding and of the anchors."""
    wide_inputs = len(inputs) // s.wide
    wider = np.zeros(s.width * wide_inputs, np.float32)
    linear_gradient(grad, inputs, wide_inputs, s.wide, tokens, scratch, wider, _gradient(flat, starts, 2))
    on_weight, on_anchors = _gradient(flat, starts, 1), _gradient(flat, starts, 0)
    for row in range(s.width):
        for i in range(s.inputs):
            on_weight[row * s.inputs + i] += wider[row * wide_inputs + i]
    weight, lanes = _parameter(addresses, starts, 1), np.empty(s.wide, np.float32)
    for i in range(s.anchor):
        lanes[:] = 0
        for row in range(s.width):
            factor = splat(weight[row * s.inputs + i])
            for lane in range(0, s.wide, LANES):
                store(lanes, lane, fma(factor, load(grad, row * s.wide + lane), load(lanes, lane)))
        for lane in range(tokens):
            on_anchors[lane % s.joints * s.anchor + i] += lanes[lane]


@kernel
def _layer_back(
    addresses: np.ndarray, starts: np.ndarray, index: int, grad: np.ndarray, given: np.ndarray, wide: int, tokens: int,
    scratch: np.ndarray, flat: np.ndarray, on_given: np.ndarray,
) -> None:  # fmt: skip
    """Add the gradients of the matrix at ``index`` and of the bias behind it; set that of its input."""
    weight, on_bias = _parameter(addresses, starts, index), _gradient(flat, starts, index + 1)
    rows = len(on_bias)
    depth = len(weight) // rows
    linear_gradient(grad, given, depth, wide, tokens, scratch, _gradient(flat, starts, index), on_bias)
    linear_back(weight, rows, grad, wide, on_given)


@kernel
def _block_back(
    s: Sizes, addresses: np.ndarray, starts: np.ndarray, items: int, block: int, kept: np.ndarray, grad: np.ndarray,
    scaled: np.ndarray, inner: np.ndarray, scratch: np.ndarray, flat: np.ndarray,
) -> None:  # fmt: skip
    """Add the gradients of one block; replace ``grad`` after it by that before it."""
    plain, inverse, qkv, shares, mixed, plain2, inverse2, opened, bend = _block(kept, s, block)
    at, tokens, layer = 3 + OF_BLOCK * block, items * s.joints, s.width * s.wide
    on_opened, on_scaled, on_qkv = inner[: 2 * layer], inner[3 * layer : 4 * layer + LANES], inner[: 3 * layer]
    _layer_back(addresses, starts, at + 10, grad, opened, s.wide, tokens, scratch, flat, on_opened)
    for i in range(0, 2 * layer, LANES):
        store(on_opened, i, load(on_opened, i) * load(bend, i))
    norm, shift = _parameter(addresses, starts, at + 2), _parameter(addresses, starts, at + 3)
    scale_rows(plain2, norm, shift, s.wide, scaled)
    _layer_back(addresses, starts, at + 8, on_opened, scaled, s.wide, tokens, scratch, flat, on_scaled)
    on_norm, on_shift = _gradient(flat, starts, at + 2), _gradient(flat, starts, at + 3)
    normalise_back(plain2, inverse2, norm, s.wide, on_scaled, scratch, on_norm, on_shift, grad)
    _layer_back(addresses, starts, at + 6, grad, mixed, s.wide, tokens, scratch, flat, on_scaled)
    on_qkv[:] = 0
    attend_back(qkv, s.width, s.heads, s.joints, items, s.wide, shares, on_scaled, on_qkv)
    norm, shift = _parameter(addresses, starts, at), _parameter(addresses, starts, at + 1)
    scale_rows(plain, norm, shift, s.wide, scaled)
    _layer_back(addresses, starts, at + 4, on_qkv, scaled, s.wide, tokens, scratch, flat, on_scaled)
    on_norm, on_shift = _gradient(flat, starts, at), _gradient(flat, starts, at + 1)
    normalise_back(plain, inverse, norm, s.wide, on_scaled, scratch, on_norm, on_shift, grad)


@kernel
def backward_unit(
    s: Sizes, addresses: np.ndarray, starts: np.ndarray, items: int, kept: np.ndarray, on_out: np.ndarray,
    tokens_first: np.ndarray, flat: np.ndarray,
) -> None:  # fmt: skip
    """Add the gradients of a unit to ``flat``, after `forward_unit` has filled ``kept``.

    ``on_out`` [8, wide] and ``tokens_first`` [wide, width] are the gradients of outputs and features, zero in unused
    lanes.
    """
    inputs, plain, inverse, _ = _ends(kept, s)
    last, layer, tokens = 3 + OF_BLOCK * s.blocks, s.width * s.wide, items * s.joints
    scaled, inner = np.empty(layer, np.float32), np.empty(4 * layer + LANES, np.float32)
    scratch = np.empty(max(2 * layer, 3 * s.width * LANES, len(inputs)), np.float32)
    features, grad = np.empty(layer, np.float32), np.zeros(layer, np.float32)
    transpose(tokens_first, s.wide, s.width, features)
    _head_back(s, addresses, starts, tokens, plain, on_out, features, scaled, scratch, flat)
    on_norm, on_shift = _gradient(flat, starts, last), _gradient(flat, starts, last + 1)
    norm = _parameter(addresses, starts, last)
    normalise_back(plain, inverse, norm, s.wide, features, scratch, on_norm, on_shift, grad)
    for block in range(s.blocks - 1, -1, -1):
        _block_back(s, addresses, starts, items, block, kept, grad, scaled, inner, scratch, flat)
    _embed_back(s, addresses, starts, tokens, inputs, grad, scratch, flat)
