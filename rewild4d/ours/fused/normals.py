"""Normals of Gaussians, and how well those of neighbouring pixels agree."""

import math
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from rewild4d.kernels.arrays import array
from rewild4d.kernels.compiling import inlined, kernel
from rewild4d.kernels.simd import LANES, absolute, fma, load, select_gt, splat, store
from rewild4d.kernels.switch import Kernel
from rewild4d.kernels.tails import store_first
from rewild4d.ours.fused.quaternions import unit_grad, unit_row

NORMALS = Kernel(
    "normals",
    "06ebfda50913",
    "rewild4d.ours.losses.regularizers:_normals",
    "rewild4d.ours.losses.regularizers:_disagreement",
)

LEAST_COVER = 1e-6
"""Added to the weight of all pairs, so that an empty image has no loss (the paper's epsilon)."""


@kernel
def _forward(
    quats: np.ndarray, log_scales: np.ndarray, means: np.ndarray, eye: np.ndarray, normals: np.ndarray,
    chosen: np.ndarray,
) -> None:  # fmt: skip
    """Set the normals; ``chosen`` [n] gets 1, 2, 3 for the axis, negative where it was flipped."""
    one, two = np.float32(1), np.float32(2)
    for n in range(len(quats)):
        axis = 0
        for i in range(1, 3):
            if log_scales[n, i] < log_scales[n, axis]:
                axis = i
        w, x, y, z, _ = unit_row(quats, n)
        if axis == 0:
            a, b, c = one - two * (y * y + z * z), two * (x * y + w * z), two * (x * z - w * y)
        elif axis == 1:
            a, b, c = two * (x * y - w * z), one - two * (x * x + z * z), two * (y * z + w * x)
        else:
            a, b, c = two * (x * z + w * y), two * (y * z - w * x), one - two * (x * x + y * y)
        towards = (eye[0] - means[n, 0]) * a + (eye[1] - means[n, 1]) * b + (eye[2] - means[n, 2]) * c
        sign = np.float32(-1) if towards < 0 else np.float32(1)
        chosen[n] = -1 - axis if towards < 0 else 1 + axis
        normals[n, 0], normals[n, 1], normals[n, 2] = sign * a, sign * b, sign * c


@kernel
def _backward(quats: np.ndarray, chosen: np.ndarray, grad: np.ndarray, on_quats: np.ndarray) -> None:
    two = np.float32(2)
    for n in range(len(quats)):
        unit = unit_row(quats, n)
        w, x, y, z, _ = unit
        twice = two if chosen[n] > 0 else -two
        a, b, c = twice * grad[n, 0], twice * grad[n, 1], twice * grad[n, 2]
        axis = abs(chosen[n])
        if axis == 1:
            g_w, g_x = z * b - y * c, y * b + z * c
            g_y, g_z = x * b - w * c - two * y * a, w * b + x * c - two * z * a
        elif axis == 2:
            g_w, g_x = x * c - z * a, y * a + w * c - two * x * b
            g_y, g_z = x * a + z * c, y * c - w * a - two * z * b
        else:
            g_w, g_x = y * a - x * b, z * a - w * b - two * x * c
            g_y, g_z = w * a + z * b - two * y * c, x * a + y * b
        on_quat = unit_grad(unit, (g_w, g_x, g_y, g_z))
        for i in range(4):
            on_quats[n, i] = on_quat[i]


def smallest_axes(quats: Tensor, log_scales: Tensor, means: Tensor, eye: Tensor) -> Tensor:
    """Compute `regularizers._normals`; float32 on the CPU, gradient for quats only."""
    return _SmallestAxes.apply(quats, log_scales, means, eye)


class _SmallestAxes(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, quats: Tensor, log_scales: Tensor, means: Tensor, eye: Tensor) -> Tensor:
        normals, given, chosen = torch.empty(means.shape), array(quats), np.empty(len(quats), np.int8)
        _forward(given, array(log_scales), array(means), array(eye), normals.numpy(), chosen)
        ctx.given, ctx.chosen = given, chosen
        return normals

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor | None, ...]:
        on_quats = torch.empty(ctx.given.shape)
        _backward(ctx.given, ctx.chosen, array(grad), on_quats.numpy())
        return on_quats, None, None, None


@kernel
def _read(
    image: np.ndarray, matte: np.ndarray, stride: int, field: np.ndarray, cover: np.ndarray, over: np.ndarray
) -> None:
    """Set unit vectors [3, (h + 2) stride], mattes and inverse lengths [(h + 2) stride], zero around the image."""
    height, width = matte.shape
    field[:], cover[:], over[:] = 0, 0, 0
    for y in range(height):
        row = slice((y + 1) * stride + LANES, (y + 1) * stride + LANES + width)
        a, b, c, inverse = image[0, y], image[1, y], image[2, y], over[row]
        for x in range(width):
            inverse[x] = np.float32(1) / math.sqrt(a[x] * a[x] + b[x] * b[x] + c[x] * c[x] + np.float32(1e-24))
        cover[row] = matte[y]
        for i in range(3):
            out, given = field[i][row], image[i, y]
            for x in range(width):
                out[x] = given[x] * inverse[x]


@inlined
def _beside(field: np.ndarray, cover: np.ndarray, index: int, other: int, scale: np.float32) -> tuple:
    """Return weight, cosine and the gradient by the first direction for sixteen pairs of pixels."""
    a, b, c = load(field[0], other), load(field[1], other), load(field[2], other)
    agree = fma(load(field[0], index), a, fma(load(field[1], index), b, load(field[2], index) * c))
    both, zero = load(cover, index) * load(cover, other) * splat(scale), splat(np.float32(0))
    share = select_gt(agree, zero, both, select_gt(zero, agree, zero - both, zero))
    return both, agree, share * a, share * b, share * c


@kernel
def _lacking(image: np.ndarray, matte: np.ndarray, right: float, down: float, grad: np.ndarray) -> float:
    """Return the loss, whose pairs along a row weigh ``right`` and along a column ``down``; set its gradient by the
    image [3, h, w]."""
    height, width = matte.shape
    stride = (width + LANES - 1) // LANES * LANES + LANES
    room = (height + 2) * stride + LANES
    field, cover, over = np.empty((3, room), np.float32), np.empty(room, np.float32), np.empty(room, np.float32)
    _read(image, matte, stride, field, cover, over)
    one, along_row, along_column = splat(np.float32(1)), np.float32(right), np.float32(down)
    sums, total = np.empty(LANES, np.float32), 0.0
    for y in range(height):
        lacking = splat(np.float32(0))
        for x in range(0, width, LANES):
            index = (y + 1) * stride + LANES + x
            beside, r_cos, a, b, c = _beside(field, cover, index, index + 1, along_row)
            below, b_cos, d, e, f = _beside(field, cover, index, index + stride, along_column)
            lacking = lacking + (beside * (one - absolute(r_cos)) + below * (one - absolute(b_cos)))
            a, b, c = a + d, b + e, c + f
            for other, scale in ((index - 1, along_row), (index - stride, along_column)):
                _, _, d, e, f = _beside(field, cover, index, other, scale)
                a, b, c = a + d, b + e, c + f
            p, q, r = load(field[0], index), load(field[1], index), load(field[2], index)
            along, inverse = fma(a, p, fma(b, q, c * r)), load(over, index)
            target = y * width + x
            store_first(grad[0], target, width - x, inverse * fma(along, p, splat(np.float32(0)) - a))
            store_first(grad[1], target, width - x, inverse * fma(along, q, splat(np.float32(0)) - b))
            store_first(grad[2], target, width - x, inverse * fma(along, r, splat(np.float32(0)) - c))
        store(sums, 0, lacking)
        total += sums.sum()
    return total


def disagreement(image: Tensor, matte: Tensor) -> Tensor:
    """Compute `regularizers._disagreement`; float32 on the CPU, gradient for the image only."""
    return _Disagreement.apply(image, matte)


class _Disagreement(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, image: Tensor, matte: Tensor) -> Tensor:
        ctx.grad, cover = torch.empty(image.shape), array(matte)
        right, down = (float((a * b).sum()) for a, b in ((cover[:, 1:], cover[:, :-1]), (cover[1:], cover[:-1])))
        weights = 1 / (right + LEAST_COVER), 1 / (down + LEAST_COVER)
        total = _lacking(array(image), cover, *weights, ctx.grad.numpy().reshape(3, -1))
        return torch.tensor(total, dtype=torch.float32)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor | None, ...]:
        return ctx.grad * grad.item(), None
