"""The deformation of all Gaussians, block by block in the cache; the backward pass runs a block again.

The twin in plain torch is `DeformNetwork.forward` itself (ours/deform.py), which also prepares the flat parameters.
"""

import math
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from rewild4d.kernels.arrays import array
from rewild4d.kernels.compiling import kernel
from rewild4d.kernels.simd import LANES, fma, load, splat, store, take_ticket
from rewild4d.kernels.threads import run, thread_count
from rewild4d.ours.fused.layers import BLOCK, Layout, backward_block, forward_block, round_up

CHUNK = 43 * BLOCK
"""Gaussians a unit of work holds; parameter gradients are summed over these, whatever the number of threads."""


class Reach(NamedTuple):
    """What an output of one means.

    Attributes:
        place: scale of the position before its code.
        frequencies: octaves of the code.
        parts: inputs before the position.
        strength: the ramp.
        reach: displacement.
        grow: bound on the change of log scale.
    """

    place: float
    frequencies: int
    parts: int
    strength: float
    reach: float
    grow: float


@kernel
def _sines(query: np.ndarray, row: int, sine: int, cosine: int) -> None:
    """Sine and cosine of a row of angles, by Taylor series of a quarter and two doublings, absolute error 3e-7."""
    for lane in range(0, BLOCK, LANES):
        x = load(query, row * BLOCK + lane)
        magic = splat(np.float32(1.5 * 2.0**23))
        turns = (fma(x, splat(np.float32(0.5 / math.pi)), magic)) - magic
        # Two pi as the sum of a short and a long part, so that the product loses nothing.
        x = fma(turns, splat(np.float32(-6.28125)), x)
        x = fma(turns, splat(np.float32(6.28125 - 2 * math.pi)), x)
        x = x * splat(np.float32(0.25))
        xx = x * x
        s = fma(xx, splat(np.float32(1 / 362880)), splat(np.float32(-1 / 5040)))
        s = fma(xx, s, splat(np.float32(1 / 120)))
        s = fma(xx, s, splat(np.float32(-1 / 6)))
        s = fma(x * xx, s, x)
        c = fma(xx, splat(np.float32(-1 / 3628800)), splat(np.float32(1 / 40320)))
        c = fma(xx, c, splat(np.float32(-1 / 720)))
        c = fma(xx, c, splat(np.float32(1 / 24)))
        c = fma(xx, c, splat(np.float32(-0.5)))
        c = fma(xx, c, splat(np.float32(1)))
        for _ in range(2):
            s, c = _doubled(s, c)
        store(query, sine * BLOCK + lane, s)
        store(query, cosine * BLOCK + lane, c)


@kernel
def _doubled(s: Any, c: Any) -> tuple:
    """Sine and cosine of twice the angle."""
    twice = s + s
    return twice * c, splat(np.float32(1)) - twice * s


@kernel
def _read_query(
    begin: int, end: int, reach: Reach, parts: np.ndarray, means: np.ndarray, quats: np.ndarray, log_scales: np.ndarray,
    query: np.ndarray,
) -> None:  # fmt: skip
    """Parts, position code, orientation (w >= 0) and log scale of Gaussians begin..end, as rows; the rest is zero."""
    query[:] = 0
    code = reach.parts + 3
    tail = code + 6 * reach.frequencies
    for lane in range(end - begin):
        n = begin + lane
        for i in range(reach.parts):
            query[i * BLOCK + lane] = parts[n, i]
        sign = np.float32(-1.0) if quats[n, 0] < 0 else np.float32(1.0)
        for i in range(3):
            query[(reach.parts + i) * BLOCK + lane] = means[n, i] * np.float32(reach.place)
            query[(tail + 4 + i) * BLOCK + lane] = log_scales[n, i]
        for i in range(4):
            query[(tail + i) * BLOCK + lane] = sign * quats[n, i]
    cosines = code + 3 * reach.frequencies
    for axis in range(3):
        _sines(query, reach.parts + axis, code + axis, cosines + axis)
        for octave in range(1, reach.frequencies):
            row = 3 * octave + axis
            for lane in range(0, BLOCK, LANES):
                before = (code + row - 3) * BLOCK + lane, (cosines + row - 3) * BLOCK + lane
                s, c = _doubled(load(query, before[0]), load(query, before[1]))
                store(query, (code + row) * BLOCK + lane, s)
                store(query, (cosines + row) * BLOCK + lane, c)


@kernel
def _turn(out: np.ndarray, lane: int, strength: float) -> tuple:
    """The unit quaternion (1, x, y, z) of three outputs, and one over its length."""
    x, y, z = (
        strength * out[3 * BLOCK + lane],
        strength * out[4 * BLOCK + lane],
        strength * out[5 * BLOCK + lane],
    )
    inverse = 1.0 / math.sqrt(1.0 + x * x + y * y + z * z)
    return inverse, x * inverse, y * inverse, z * inverse


@kernel
def _apply(
    begin: int, end: int, reach: Reach, out: np.ndarray, means: np.ndarray, quats: np.ndarray, log_scales: np.ndarray,
    new_means: np.ndarray, new_quats: np.ndarray, new_log_scales: np.ndarray,
) -> None:  # fmt: skip
    strength = reach.strength
    for lane in range(end - begin):
        n = begin + lane
        for i in range(3):
            new_means[n, i] = means[n, i] + reach.reach * strength * out[i * BLOCK + lane]
            new_log_scales[n, i] = log_scales[n, i] + reach.grow * math.tanh(strength * out[(6 + i) * BLOCK + lane])
        w, x, y, z = _turn(out, lane, strength)
        a, b, c, d = quats[n, 0], quats[n, 1], quats[n, 2], quats[n, 3]
        new_quats[n, 0] = a * w - b * x - c * y - d * z
        new_quats[n, 1] = a * x + b * w + c * z - d * y
        new_quats[n, 2] = a * y - b * z + c * w + d * x
        new_quats[n, 3] = a * z + b * y - c * x + d * w


@kernel
def _apply_back(
    begin: int, end: int, reach: Reach, out: np.ndarray, quats: np.ndarray, g_means: np.ndarray, g_quats: np.ndarray,
    g_log_scales: np.ndarray, slope_out: np.ndarray, on_quats: np.ndarray,
) -> None:  # fmt: skip
    """From the gradients of the moved Gaussians to those of the outputs and of the orientations."""
    slope_out[:] = 0
    strength = reach.strength
    for lane in range(end - begin):
        n = begin + lane
        for i in range(3):
            slope_out[i * BLOCK + lane] = reach.reach * strength * g_means[n, i]
            change = math.tanh(strength * out[(6 + i) * BLOCK + lane])
            slope_out[(6 + i) * BLOCK + lane] = reach.grow * strength * (1 - change * change) * g_log_scales[n, i]
        w, x, y, z = _turn(out, lane, strength)
        a, b, c, d = quats[n, 0], quats[n, 1], quats[n, 2], quats[n, 3]
        p, q, r, s = g_quats[n, 0], g_quats[n, 1], g_quats[n, 2], g_quats[n, 3]
        on_quats[n, 0] = p * w + q * x + r * y + s * z
        on_quats[n, 1] = -p * x + q * w - r * z + s * y
        on_quats[n, 2] = -p * y + q * z + r * w - s * x
        on_quats[n, 3] = -p * z - q * y + r * x + s * w
        v_w = p * a + q * b + r * c + s * d
        v_x = -p * b + q * a + r * d - s * c
        v_y = -p * c - q * d + r * a + s * b
        v_z = -p * d + q * c - r * b + s * a
        along = v_w * w + v_x * x + v_y * y + v_z * z
        slope_out[3 * BLOCK + lane] = strength * w * (v_x - along * x)
        slope_out[4 * BLOCK + lane] = strength * w * (v_y - along * y)
        slope_out[5 * BLOCK + lane] = strength * w * (v_z - along * z)


@kernel
def _forward(
    tickets: np.ndarray, sizes: Layout, reach: Reach, flat: np.ndarray, parts: np.ndarray, means: np.ndarray,
    quats: np.ndarray, log_scales: np.ndarray, new_means: np.ndarray, new_quats: np.ndarray, new_log_scales: np.ndarray,
) -> None:  # fmt: skip
    count, wide = len(means), round_up(sizes.width) * BLOCK
    query = np.empty(round_up(sizes.inputs) * BLOCK, np.float32)
    shares = np.empty(round_up(sizes.scores) * BLOCK, np.float32)
    first, opened, middle, last = (
        np.empty(wide, np.float32), np.empty(wide, np.float32), np.empty(wide, np.float32), np.empty(wide, np.float32)
    )  # fmt: skip
    out = np.empty(LANES * BLOCK, np.float32)
    while True:
        begin = take_ticket(tickets) * BLOCK
        if begin >= count:
            return
        end = min(begin + BLOCK, count)
        _read_query(begin, end, reach, parts, means, quats, log_scales, query)
        forward_block(flat, sizes, query, shares, first, opened, middle, last, out)
        _apply(begin, end, reach, out, means, quats, log_scales, new_means, new_quats, new_log_scales)


@kernel
def _backward(
    tickets: np.ndarray, chunk: int, sizes: Layout, reach: Reach, flat: np.ndarray, parts: np.ndarray,
    means: np.ndarray, quats: np.ndarray, log_scales: np.ndarray, g_means: np.ndarray, g_quats: np.ndarray,
    g_log_scales: np.ndarray, gradients: np.ndarray, on_parts: np.ndarray, on_quats: np.ndarray,
) -> None:  # fmt: skip
    count, wide = len(means), round_up(sizes.width) * BLOCK
    query = np.empty(round_up(sizes.inputs) * BLOCK, np.float32)
    scores = round_up(sizes.scores) * BLOCK
    shares, on_shares = np.empty(scores, np.float32), np.empty(scores, np.float32)
    first, opened, middle, last = (
        np.empty(wide, np.float32), np.empty(wide, np.float32), np.empty(wide, np.float32), np.empty(wide, np.float32)
    )  # fmt: skip
    slope, inner = np.empty(wide, np.float32), np.empty(wide, np.float32)
    turned = np.empty(max(wide, scores, len(query)), np.float32)
    out, slope_out, on_query = (
        np.empty(LANES * BLOCK, np.float32), np.empty(LANES * BLOCK, np.float32), np.empty(LANES * BLOCK, np.float32)
    )  # fmt: skip
    while True:
        unit = take_ticket(tickets)
        if unit >= len(gradients):
            return
        for begin in range(unit * chunk, min((unit + 1) * chunk, count), BLOCK):
            end = min(begin + BLOCK, count)
            _read_query(begin, end, reach, parts, means, quats, log_scales, query)
            forward_block(flat, sizes, query, shares, first, opened, middle, last, out)
            _apply_back(begin, end, reach, out, quats, g_means, g_quats, g_log_scales, slope_out, on_quats)
            backward_block(
                flat, sizes, query, shares, opened, middle, last, slope_out, slope, inner, on_shares, turned,
                gradients[unit], on_query,
            )  # fmt: skip
            for lane in range(end - begin):
                for i in range(reach.parts):
                    on_parts[begin + lane, i] = on_query[i * BLOCK + lane]


def deform(
    flat: Tensor, sizes: Layout, reach: Reach, parts: Tensor, means: Tensor, quats: Tensor, log_scales: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """Moved Gaussians; float32 on the CPU.

    Args:
        flat: matrices and biases, [sizes.total].
        sizes: their layout.
        reach: what the outputs mean.
        parts: part mixtures, at most sixteen inputs, [n, D].
        means: [n, 3]; like the next two, differentiable only as what is moved, not as the network's input.
        quats: unit, [n, 4].
        log_scales: [n, 3].

    Returns:
        Means [n, 3], quats [n, 4] and log scales [n, 3].
    """
    return _Deform.apply(flat, parts, means, quats, log_scales, sizes, reach)


class _Deform(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any, flat: Tensor, parts: Tensor, means: Tensor, quats: Tensor, log_scales: Tensor, sizes: Layout,
        reach: Reach,
    ) -> tuple[Tensor, Tensor, Tensor]:  # fmt: skip
        given = flat, parts, means, quats, log_scales
        made = torch.empty_like(means), torch.empty_like(quats), torch.empty_like(log_scales)
        call = np.zeros(1, np.int64), sizes, reach, *map(array, given), *(tensor.numpy() for tensor in made)
        run(_forward, [call] * thread_count())
        ctx.save_for_backward(*given)
        ctx.shape = sizes, reach
        return made

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, g_means: Tensor, g_quats: Tensor, g_log_scales: Tensor) -> tuple[Tensor | None, ...]:
        flat, parts, means, quats, log_scales = ctx.saved_tensors
        chunks = max(1, -(-len(means) // CHUNK))
        gradients = np.zeros((chunks, len(flat)), np.float32)
        on_parts, on_quats = torch.empty_like(parts), torch.empty_like(quats)
        call = (
            np.zeros(1, np.int64), CHUNK, *ctx.shape, *map(array, ctx.saved_tensors),
            *map(array, (g_means, g_quats, g_log_scales)), gradients, on_parts.numpy(), on_quats.numpy(),
        )  # fmt: skip
        run(_backward, [call] * thread_count())
        return torch.from_numpy(gradients.sum(axis=0)), on_parts, g_means, on_quats, g_log_scales, None, None
