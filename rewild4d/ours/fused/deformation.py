"""Deformation of all Gaussians, block by block in the cache; the backward pass recomputes each block."""

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
from rewild4d.kernels.threads import run_tickets
from rewild4d.ours.fused.layers import (
    BLOCK,
    Factors,
    Layout,
    allocate_blocks,
    backward_block,
    forward_block,
    pair_layers,
)
from rewild4d.ours.fused.quaternions import back_times, read_row, times
from rewild4d.ours.fused.queries import Scales, mix_back, read_query
from rewild4d.ours.fused.sampled_rows import sample_rows

DEFORMATION = Kernel(
    "deformation",
    "9a70e27e7c54",
    "rewild4d.ours.deform:DeformNetwork.__init__",
    "rewild4d.ours.deform:DeformNetwork.forward",
    "rewild4d.ours.deform:DeformNetwork._position_code",
    "rewild4d.ours.deform:DeformNetwork._attend",
    "rewild4d.ours.deform:DeformNetwork._attention",
    reads_layers=True,
)

CHUNK = 11 * BLOCK
"""Gaussians of a unit of work; gradients are summed by unit, so they do not depend on the number of threads."""


@kernel
def _activate(scales: Scales, out: np.ndarray) -> None:
    """Replace the outputs by displacement, x, y, z of a unit quaternion and change of log scale; w goes to row 9."""
    one, strength = splat(np.float32(1)), splat(np.float32(scales.strength))
    far, grow = splat(np.float32(scales.offset * scales.strength)), splat(np.float32(scales.log_scale))
    twice = splat(np.float32(2 * scales.strength * LOG2_E))
    low, high = splat(np.float32(-126)), splat(np.float32(126))
    for lane in range(0, BLOCK, LANES):
        square = one
        for row in range(3):
            store(out, row * BLOCK + lane, load(out, row * BLOCK + lane) * far)
            part = load(out, (3 + row) * BLOCK + lane) * strength
            square = fma(part, part, square)
            # tanh x = 1 - 2 / (1 + exp 2x); in this order of limits a NaN stays one
            power = exp2(minimum(high, maximum(low, load(out, (6 + row) * BLOCK + lane) * twice)))
            store(out, (6 + row) * BLOCK + lane, (one - divide(one + one, one + power)) * grow)
        inverse = divide(one, square_root(square))
        store(out, 9 * BLOCK + lane, inverse)
        for row in range(3, 6):
            store(out, row * BLOCK + lane, load(out, row * BLOCK + lane) * strength * inverse)


@kernel
def _apply(begin: int, end: int, out: np.ndarray, posed: tuple, moved: tuple) -> None:
    (means, quats, log_scales), (new_means, new_quats, new_log_scales) = posed, moved
    for lane in range(end - begin):
        n = begin + lane
        for i in range(3):
            new_means[n, i] = means[n, i] + out[i * BLOCK + lane]
            new_log_scales[n, i] = log_scales[n, i] + out[(6 + i) * BLOCK + lane]
        rotated = times(read_row(quats, n), _quaternion(out, lane))
        for i in range(4):
            new_quats[n, i] = rotated[i]


@inlined
def _quaternion(out: np.ndarray, lane: int) -> tuple:
    return out[9 * BLOCK + lane], out[3 * BLOCK + lane], out[4 * BLOCK + lane], out[5 * BLOCK + lane]


@kernel
def _apply_back(
    begin: int, end: int, scales: Scales, out: np.ndarray, quats: np.ndarray, grads: tuple, grad_out: np.ndarray
) -> None:
    """Compute the gradients of the outputs from those of the deformed Gaussians."""
    g_means, g_quats, g_log_scales = grads
    grad_out[:] = 0
    strength, far = np.float32(scales.strength), np.float32(scales.offset * scales.strength)
    steep, bend = np.float32(scales.log_scale * scales.strength), np.float32(scales.strength / scales.log_scale)
    for lane in range(end - begin):
        n = begin + lane
        for i in range(3):
            grad_out[i * BLOCK + lane] = far * g_means[n, i]
            change = out[(6 + i) * BLOCK + lane]
            grad_out[(6 + i) * BLOCK + lane] = (steep - bend * change * change) * g_log_scales[n, i]
        w, x, y, z = _quaternion(out, lane)
        (a, b, c, d), (p, q, r, s) = read_row(quats, n), read_row(g_quats, n)
        v_w = p * a + q * b + r * c + s * d
        v_x = -p * b + q * a + r * d - s * c
        v_y = -p * c - q * d + r * a + s * b
        v_z = -p * d + q * c - r * b + s * a
        along = v_w * w + v_x * x + v_y * y + v_z * z
        grad_out[3 * BLOCK + lane] = strength * w * (v_x - along * x)
        grad_out[4 * BLOCK + lane] = strength * w * (v_y - along * y)
        grad_out[5 * BLOCK + lane] = strength * w * (v_z - along * z)


@kernel
def _rotation_back(
    tickets: np.ndarray, quats: np.ndarray, new_quats: np.ndarray, g_quats: np.ndarray, on_quats: np.ndarray
) -> None:
    """Compute the gradients of the undeformed orientations from those of the deformed ones."""
    while True:
        begin = take_ticket(tickets) * CHUNK
        if begin >= len(quats):
            return
        for n in range(begin, min(begin + CHUNK, len(quats))):
            w, x, y, z = back_times(read_row(quats, n), read_row(new_quats, n))
            p, q, r, s = read_row(g_quats, n)
            on_quats[n, 0] = p * w + q * x + r * y + s * z
            on_quats[n, 1] = -p * x + q * w - r * z + s * y
            on_quats[n, 2] = -p * y + q * z + r * w - s * x
            on_quats[n, 3] = -p * z - q * y + r * x + s * w


@kernel
def _forward(
    tickets: np.ndarray, sizes: Layout, scales: Scales, net: Factors, weights: np.ndarray, anchors: np.ndarray,
    posed: tuple, moved: tuple,
) -> None:  # fmt: skip
    blocks, count = allocate_blocks(sizes), len(weights)
    while True:
        begin = take_ticket(tickets) * BLOCK
        if begin >= count:
            return
        end = min(begin + BLOCK, count)
        read_query(begin, end, scales, weights, anchors, posed, blocks.query)
        forward_block(net, sizes, blocks)
        _activate(scales, blocks.out)
        _apply(begin, end, blocks.out, posed, moved)


@kernel
def _backward(
    tickets: np.ndarray, rotation_call: tuple, chunk: int, sizes: Layout, scales: Scales, net: Factors,
    weights: np.ndarray, anchors: np.ndarray, posed: tuple, grads: tuple, gradients: np.ndarray, on_anchors: np.ndarray,
) -> None:  # fmt: skip
    """Compute the parameters' gradients from these Gaussians; first run `_rotation_back` on all."""
    _rotation_back(*rotation_call)
    blocks, count = allocate_blocks(sizes), len(weights)
    on_shares, transposed = np.empty_like(blocks.shares), np.empty_like(blocks.words)
    grad, inner = np.empty_like(blocks.first), np.empty_like(blocks.first)
    grad_out, on_query = np.empty_like(blocks.out), np.empty_like(blocks.out)
    while True:
        unit = take_ticket(tickets)
        if unit >= len(gradients):
            return
        for begin in range(unit * chunk, min((unit + 1) * chunk, count), BLOCK):
            end = min(begin + BLOCK, count)
            read_query(begin, end, scales, weights, anchors, posed, blocks.query)
            forward_block(net, sizes, blocks)
            _activate(scales, blocks.out)
            _apply_back(begin, end, scales, blocks.out, posed[1], grads, grad_out)
            backward_block(net, sizes, blocks, grad_out, grad, inner, on_shares, transposed, gradients[unit], on_query)
            if len(anchors) > 0:
                mix_back(begin, end, weights, on_query, transposed, on_anchors[unit])


def deform(
    flat: Tensor, sizes: Layout, scales: Scales, half: bool, weights: Tensor, anchors: Tensor | None, means: Tensor,
    quats: Tensor, log_scales: Tensor, sampled: int = 0, offset: float = 0.0,
) -> tuple[Tensor, Tensor, Tensor]:  # fmt: skip
    """Deform Gaussians as `DeformNetwork.forward`, whose layers are folded into ``flat``; float32 on the CPU.

    ``half`` rounds the factors of products to bfloat16 where the CPU multiplies such pairs. Means, quats and log_scales
    are differentiable as what is moved, not as the network's input. ``sampled`` Gaussians (0: all), drawn by
    ``offset``, give the gradients of ``flat`` and ``anchors`` [J, D], D at most 16.
    """
    half = half and available()
    return _Deform.apply(flat, anchors, means, quats, log_scales, weights, sizes, scales, half, sampled, offset)


def _factors(flat: np.ndarray, sizes: Layout, half: bool) -> Factors:
    along, across = (np.empty(sizes.total // 2 if half else 0, np.int32) for _ in range(2))
    if half:
        pair_layers(flat.view(np.int32), sizes, along, across)
    return Factors(flat, along.view(np.float32), across.view(np.float32))


class _Deform(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any, flat: Tensor, anchors: Tensor | None, means: Tensor, quats: Tensor, log_scales: Tensor,
        weights: Tensor, sizes: Layout, scales: Scales, half: bool, sampled: int, offset: float,
    ) -> tuple[Tensor, Tensor, Tensor]:  # fmt: skip
        made = torch.empty_like(means), torch.empty_like(quats), torch.empty_like(log_scales)
        wide = np.zeros((0 if anchors is None else len(anchors), LANES), np.float32)
        if anchors is not None:
            wide[:, : anchors.shape[1]] = array(anchors)
        ctx.network = sizes, scales, _factors(array(flat), sizes, half)
        ctx.wide, ctx.anchors = wide.ravel(), None if anchors is None else anchors.shape
        ctx.sampled, ctx.offset = sampled, offset
        posed, moved = tuple(map(array, (means, quats, log_scales))), tuple(tensor.numpy() for tensor in made)
        run_tickets(_forward, *ctx.network, array(weights), ctx.wide, posed, moved)
        ctx.save_for_backward(flat, weights, means, quats, log_scales, made[1])
        return made

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, g_means: Tensor, g_quats: Tensor, g_log_scales: Tensor) -> tuple[Tensor | None, ...]:
        _, *given, rotated = map(array, ctx.saved_tensors)
        grads = array(g_means), array(g_quats), array(g_log_scales)
        on_quats = torch.empty(g_quats.shape, dtype=torch.float32)
        rotation_call = np.zeros(1, np.int64), given[2], rotated, grads[1], on_quats.numpy()
        flat, on_anchors = _parameter_gradients(ctx, given, rotation_call, grads)
        by_anchors = None
        if ctx.anchors is not None:
            summed = on_anchors.reshape(-1, LANES)[:, : ctx.anchors[1]]
            by_anchors = torch.from_numpy(np.ascontiguousarray(summed))
        return torch.from_numpy(flat), by_anchors, g_means, on_quats, g_log_scales, *[None] * 6


def _parameter_gradients(
    ctx: Any,
    given: list[np.ndarray],
    rotation_call: tuple[np.ndarray, ...],
    grads: tuple[np.ndarray, np.ndarray, np.ndarray],
) -> tuple[np.ndarray, np.ndarray]:
    """Sum the gradients of the flat parameters and of the anchors over all Gaussians or a weighted sample; also run
    `_rotation_back` with ``rotation_call``."""
    sizes, scales, _ = ctx.network
    if 0 < ctx.sampled < len(given[0]):
        rows, factors = sample_rows(scales.offset, scales.log_scale, rotation_call[2], *grads, ctx.sampled, ctx.offset)
        given = [each.take(rows, axis=0) for each in given]
        on_means, on_quats, on_scales = (each.take(rows, axis=0) * factors[:, None] for each in grads)
        grads = on_means, on_quats, on_scales
    chunks = max(1, -(-len(given[0]) // CHUNK))
    gradients, on_anchors = np.zeros((chunks, sizes.total), np.float32), np.zeros((chunks, len(ctx.wide)), np.float32)
    weights, *posed = given
    network = (CHUNK, *ctx.network, weights, ctx.wide)
    run_tickets(_backward, rotation_call, *network, tuple(posed), grads, gradients, on_anchors)
    return gradients.sum(axis=0), on_anchors.sum(axis=0)
