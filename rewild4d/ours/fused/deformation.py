"""The deformation of all Gaussians, block by block in the cache; the backward pass runs a block again.

The twin in plain torch is `DeformNetwork.forward` itself (ours/deform.py), which also prepares the flat parameters.
"""

from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from rewild4d.kernels.arrays import array
from rewild4d.kernels.compiling import inlined, kernel
from rewild4d.kernels.halves import available
from rewild4d.kernels.powers import LOG2_E, exp2
from rewild4d.kernels.simd import LANES, divide, fma, load, maximum, minimum, splat, square_root, store, take_ticket
from rewild4d.kernels.switch import Kernel
from rewild4d.kernels.threads import run, thread_count
from rewild4d.ours.fused.layers import BLOCK, Factors, Layout, backward_block, forward_block, pair_layers, round_up
from rewild4d.ours.fused.queries import Reach, mix_back, read_query
from rewild4d.ours.fused.sampled_rows import sample_rows

DEFORMATION = Kernel(
    "deformation",
    "ce3470813534",
    "rewild4d.ours.deform:DeformNetwork.forward",
    "rewild4d.ours.deform:DeformNetwork._place",
    "rewild4d.ours.deform:DeformNetwork._attend",
    "rewild4d.ours.deform:DeformNetwork._attention",
)

CHUNK = 11 * BLOCK
"""Gaussians a unit of work holds; parameter gradients are summed over these, whatever the number of threads."""


@kernel
def _activate(reach: Reach, out: np.ndarray) -> None:
    """Rows of the output as what they mean, in place: displacement, x, y, z of a unit quaternion, change of log scale;
    its w is row 9."""
    one, strength = splat(np.float32(1)), splat(np.float32(reach.strength))
    far, grow = splat(np.float32(reach.reach * reach.strength)), splat(np.float32(reach.grow))
    twice = splat(np.float32(2 * reach.strength * LOG2_E))
    low, high = splat(np.float32(-126)), splat(np.float32(126))
    for lane in range(0, BLOCK, LANES):
        square = one
        for row in range(3):
            store(out, row * BLOCK + lane, load(out, row * BLOCK + lane) * far)
            turn = load(out, (3 + row) * BLOCK + lane) * strength
            square = fma(turn, turn, square)
            # tanh x = 1 - 2 / (1 + exp 2x); in this order of limits a NaN stays one
            power = exp2(minimum(high, maximum(low, load(out, (6 + row) * BLOCK + lane) * twice)))
            store(out, (6 + row) * BLOCK + lane, (one - divide(one + one, one + power)) * grow)
        inverse = divide(one, square_root(square))
        store(out, 9 * BLOCK + lane, inverse)
        for row in range(3, 6):
            store(out, row * BLOCK + lane, load(out, row * BLOCK + lane) * strength * inverse)


@kernel
def _apply(
    begin: int, end: int, out: np.ndarray, means: np.ndarray, quats: np.ndarray, log_scales: np.ndarray,
    new_means: np.ndarray, new_quats: np.ndarray, new_log_scales: np.ndarray,
) -> None:  # fmt: skip
    for lane in range(end - begin):
        n = begin + lane
        for i in range(3):
            new_means[n, i] = means[n, i] + out[i * BLOCK + lane]
            new_log_scales[n, i] = log_scales[n, i] + out[(6 + i) * BLOCK + lane]
        w, x, y, z = _quaternion(out, lane)
        a, b, c, d = quats[n, 0], quats[n, 1], quats[n, 2], quats[n, 3]
        new_quats[n, 0] = a * w - b * x - c * y - d * z
        new_quats[n, 1] = a * x + b * w + c * z - d * y
        new_quats[n, 2] = a * y - b * z + c * w + d * x
        new_quats[n, 3] = a * z + b * y - c * x + d * w


@inlined
def _quaternion(out: np.ndarray, lane: int) -> tuple:
    return out[9 * BLOCK + lane], out[3 * BLOCK + lane], out[4 * BLOCK + lane], out[5 * BLOCK + lane]


@kernel
def _apply_back(
    begin: int, end: int, reach: Reach, out: np.ndarray, quats: np.ndarray, g_means: np.ndarray, g_quats: np.ndarray,
    g_log_scales: np.ndarray, slope_out: np.ndarray,
) -> None:  # fmt: skip
    """From the gradients of the moved Gaussians to those of the outputs."""
    slope_out[:] = 0
    strength, far = np.float32(reach.strength), np.float32(reach.reach * reach.strength)
    steep, bend = np.float32(reach.grow * reach.strength), np.float32(reach.strength / reach.grow)
    for lane in range(end - begin):
        n = begin + lane
        for i in range(3):
            slope_out[i * BLOCK + lane] = far * g_means[n, i]
            change = out[(6 + i) * BLOCK + lane]
            slope_out[(6 + i) * BLOCK + lane] = (steep - bend * change * change) * g_log_scales[n, i]
        w, x, y, z = _quaternion(out, lane)
        a, b, c, d = quats[n, 0], quats[n, 1], quats[n, 2], quats[n, 3]
        p, q, r, s = g_quats[n, 0], g_quats[n, 1], g_quats[n, 2], g_quats[n, 3]
        v_w = p * a + q * b + r * c + s * d
        v_x = -p * b + q * a + r * d - s * c
        v_y = -p * c - q * d + r * a + s * b
        v_z = -p * d + q * c - r * b + s * a
        along = v_w * w + v_x * x + v_y * y + v_z * z
        slope_out[3 * BLOCK + lane] = strength * w * (v_x - along * x)
        slope_out[4 * BLOCK + lane] = strength * w * (v_y - along * y)
        slope_out[5 * BLOCK + lane] = strength * w * (v_z - along * z)


@kernel
def _turn_back(
    tickets: np.ndarray, quats: np.ndarray, new_quats: np.ndarray, g_quats: np.ndarray, on_quats: np.ndarray
) -> None:
    """From the gradients of the turned orientations to those of the unit quaternions that were turned."""
    while True:
        begin = take_ticket(tickets) * CHUNK
        if begin >= len(quats):
            return
        for n in range(begin, min(begin + CHUNK, len(quats))):
            a, b, c, d = quats[n, 0], quats[n, 1], quats[n, 2], quats[n, 3]
            e, f, g, h = new_quats[n, 0], new_quats[n, 1], new_quats[n, 2], new_quats[n, 3]
            w, x = a * e + b * f + c * g + d * h, a * f - b * e - c * h + d * g
            y, z = a * g + b * h - c * e - d * f, a * h - b * g + c * f - d * e
            p, q, r, s = g_quats[n, 0], g_quats[n, 1], g_quats[n, 2], g_quats[n, 3]
            on_quats[n, 0] = p * w + q * x + r * y + s * z
            on_quats[n, 1] = -p * x + q * w - r * z + s * y
            on_quats[n, 2] = -p * y + q * z + r * w - s * x
            on_quats[n, 3] = -p * z - q * y + r * x + s * w


@kernel
def _forward(
    tickets: np.ndarray, sizes: Layout, reach: Reach, net: Factors, weights: np.ndarray, anchors: np.ndarray,
    means: np.ndarray, quats: np.ndarray, log_scales: np.ndarray, new_means: np.ndarray, new_quats: np.ndarray,
    new_log_scales: np.ndarray,
) -> None:  # fmt: skip
    count, wide = len(means), round_up(sizes.width) * BLOCK
    query = np.empty(round_up(sizes.inputs) * BLOCK, np.float32)
    shares = np.empty(round_up(sizes.scores) * BLOCK, np.float32)
    first, opened, middle, last = (
        np.empty(wide, np.float32), np.empty(wide, np.float32), np.empty(wide, np.float32), np.empty(wide, np.float32)
    )  # fmt: skip
    out = np.empty(LANES * BLOCK, np.float32)
    words = np.empty(max(wide, len(shares), len(query)), np.float32)
    while True:
        begin = take_ticket(tickets) * BLOCK
        if begin >= count:
            return
        end = min(begin + BLOCK, count)
        read_query(begin, end, reach, weights, anchors, means, quats, log_scales, query)
        forward_block(net, sizes, query, words, shares, first, opened, middle, last, out)
        _activate(reach, out)
        _apply(begin, end, out, means, quats, log_scales, new_means, new_quats, new_log_scales)


@kernel
def _backward(
    turns: tuple, tickets: np.ndarray, chunk: int, sizes: Layout, reach: Reach, net: Factors, weights: np.ndarray,
    anchors: np.ndarray, means: np.ndarray, quats: np.ndarray, log_scales: np.ndarray, g_means: np.ndarray,
    g_quats: np.ndarray, g_log_scales: np.ndarray, gradients: np.ndarray, on_anchors: np.ndarray,
) -> None:  # fmt: skip
    """The parameters' gradients from these Gaussians, and ``turns``, the arguments of `_turn_back`, of all."""
    _turn_back(*turns)
    count, wide = len(means), round_up(sizes.width) * BLOCK
    query = np.empty(round_up(sizes.inputs) * BLOCK, np.float32)
    scores = round_up(sizes.scores) * BLOCK
    shares, on_shares = np.empty(scores, np.float32), np.empty(scores, np.float32)
    first, opened, middle, last = (
        np.empty(wide, np.float32), np.empty(wide, np.float32), np.empty(wide, np.float32), np.empty(wide, np.float32)
    )  # fmt: skip
    slope, inner = np.empty(wide, np.float32), np.empty(wide, np.float32)
    turned = np.empty(max(wide, scores, len(query)), np.float32)
    words = np.empty_like(turned)
    out, slope_out, on_query = (
        np.empty(LANES * BLOCK, np.float32), np.empty(LANES * BLOCK, np.float32), np.empty(LANES * BLOCK, np.float32)
    )  # fmt: skip
    while True:
        unit = take_ticket(tickets)
        if unit >= len(gradients):
            return
        for begin in range(unit * chunk, min((unit + 1) * chunk, count), BLOCK):
            end = min(begin + BLOCK, count)
            read_query(begin, end, reach, weights, anchors, means, quats, log_scales, query)
            forward_block(net, sizes, query, words, shares, first, opened, middle, last, out)
            _activate(reach, out)
            _apply_back(begin, end, reach, out, quats, g_means, g_quats, g_log_scales, slope_out)
            backward_block(
                net, sizes, query, words, shares, opened, middle, last, slope_out, slope, inner, on_shares, turned,
                gradients[unit], on_query,
            )  # fmt: skip
            if len(anchors) > 0:
                mix_back(begin, end, weights, on_query, turned, on_anchors[unit])


def deform(
    flat: Tensor, sizes: Layout, reach: Reach, half: bool, weights: Tensor, anchors: Tensor | None, means: Tensor,
    quats: Tensor, log_scales: Tensor, sampled: int = 0, offset: float = 0.0,
) -> tuple[Tensor, Tensor, Tensor]:  # fmt: skip
    """Moved Gaussians; float32 on the CPU.

    Args:
        flat: matrices and biases, [sizes.total].
        sizes: their layout.
        reach: what the outputs mean.
        half: round the factors of all products to bfloat16 where the machine multiplies such pairs; sums keep single
            precision.
        weights: skinning weights, taken as given, [n, J].
        anchors: of the parts; a query holds their weighted sum, D at most sixteen. None: it holds the weights, [J, D].
        means: [n, 3]; like the next two, differentiable only as what is moved, not as the network's input.
        quats: unit, [n, 4].
        log_scales: [n, 3].
        sampled: Gaussians that stand for all in the gradients of ``flat`` and ``anchors``; 0: every one counts.
        offset: uniform in [0, 1), decides which.

    Returns:
        Means [n, 3], quats [n, 4] and log scales [n, 3].
    """
    half = half and available()
    return _Deform.apply(flat, anchors, means, quats, log_scales, weights, sizes, reach, half, sampled, offset)


def _factors(flat: np.ndarray, sizes: Layout, half: bool) -> Factors:
    along, across = (np.empty(sizes.total // 2 if half else 0, np.int32) for _ in range(2))
    if half:
        pair_layers(flat.view(np.int32), sizes, along, across)
    return Factors(flat, along.view(np.float32), across.view(np.float32))


class _Deform(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any, flat: Tensor, anchors: Tensor | None, means: Tensor, quats: Tensor, log_scales: Tensor,
        weights: Tensor, sizes: Layout, reach: Reach, half: bool, sampled: int, offset: float,
    ) -> tuple[Tensor, Tensor, Tensor]:  # fmt: skip
        made = torch.empty_like(means), torch.empty_like(quats), torch.empty_like(log_scales)
        wide = np.zeros((0 if anchors is None else len(anchors), LANES), np.float32)
        if anchors is not None:
            wide[:, : anchors.shape[1]] = array(anchors)
        ctx.network = sizes, reach, _factors(array(flat), sizes, half)
        ctx.wide, ctx.anchors = wide.ravel(), None if anchors is None else anchors.shape
        ctx.sampled, ctx.offset = sampled, offset
        moved = map(array, (means, quats, log_scales))
        call = (*ctx.network, array(weights), ctx.wide, *moved, *(tensor.numpy() for tensor in made))
        run(_forward, [(np.zeros(1, np.int64), *call)] * thread_count())
        ctx.save_for_backward(flat, weights, means, quats, log_scales, made[1])
        return made

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, g_means: Tensor, g_quats: Tensor, g_log_scales: Tensor) -> tuple[Tensor | None, ...]:
        _, *given, turned = map(array, ctx.saved_tensors)
        slopes = array(g_means), array(g_quats), array(g_log_scales)
        on_quats = torch.empty(g_quats.shape, dtype=torch.float32)
        turns = np.zeros(1, np.int64), given[2], turned, slopes[1], on_quats.numpy()
        flat, on_anchors = _parameter_gradients(ctx, given, turns, slopes)
        by_anchors = None
        if ctx.anchors is not None:
            summed = on_anchors.reshape(-1, LANES)[:, : ctx.anchors[1]]
            by_anchors = torch.from_numpy(np.ascontiguousarray(summed))
        return torch.from_numpy(flat), by_anchors, g_means, on_quats, g_log_scales, *[None] * 6


def _parameter_gradients(
    ctx: Any, given: list[np.ndarray], turns: tuple[np.ndarray, ...], slopes: tuple[np.ndarray, np.ndarray, np.ndarray]
) -> tuple[np.ndarray, np.ndarray]:
    """Of the flat parameters and of the anchors, summed over the Gaussians or over those that stand for them.

    Runs `_turn_back` with ``turns`` meanwhile.
    """
    sizes, reach, _ = ctx.network
    if 0 < ctx.sampled < len(given[0]):
        rows, factors = sample_rows(reach.reach, reach.grow, turns[2], *slopes, ctx.sampled, ctx.offset)
        given = [each.take(rows, axis=0) for each in given]
        on_means, on_quats, on_scales = (each.take(rows, axis=0) * factors[:, None] for each in slopes)
        slopes = on_means, on_quats, on_scales
    chunks = max(1, -(-len(given[0]) // CHUNK))
    gradients, on_anchors = np.zeros((chunks, sizes.total), np.float32), np.zeros((chunks, len(ctx.wide)), np.float32)
    weighed, *moved = given
    network = (np.zeros(1, np.int64), CHUNK, *ctx.network, weighed, ctx.wide)
    run(_backward, [(turns, *network, *moved, *slopes, gradients, on_anchors)] * thread_count())
    return gradients.sum(axis=0), on_anchors.sum(axis=0)
