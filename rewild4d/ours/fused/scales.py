"""Standard deviations of Gaussians from their log scales; the twin is in `Gaussians.scales` (ours/canonical.py)."""

import math
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from rewild4d.kernels.arrays import array
from rewild4d.kernels.compiling import kernel
from rewild4d.kernels.powers import LOG2_E, exp2
from rewild4d.kernels.simd import LANES, maximum, minimum, splat
from rewild4d.kernels.tails import load_first, store_first

MOST = np.float32(126)
"""Squares lie between 2^-126 and 2^126."""


@kernel
def _forward(log_scales: np.ndarray, blur: float, scales: np.ndarray) -> None:
    nothing, square = splat(np.float32(0)), np.float32(blur * blur)
    for i in range(0, len(scales), LANES):
        bits = load_first(log_scales, i, len(scales) - i, nothing) * splat(2 * LOG2_E)
        bits = minimum(splat(MOST), maximum(splat(-MOST), bits))  # in this order a NaN stays one
        store_first(scales, i, len(scales) - i, exp2(bits))
    for i in range(len(scales)):
        scales[i] = math.sqrt(scales[i] + square)


@kernel
def _backward(scales: np.ndarray, slope: np.ndarray, blur: float, on_log_scales: np.ndarray) -> None:
    square = np.float32(blur * blur)
    for i in range(len(scales)):
        on_log_scales[i] = slope[i] * (scales[i] - square / scales[i])


def blurred_scales(log_scales: Tensor, blur: float) -> Tensor:
    """Compute sqrt(exp(2 x) + blur^2); float32, CPU, any shape."""
    return _Scales.apply(log_scales, blur)


class _Scales(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, log_scales: Tensor, blur: float) -> Tensor:
        scales, ctx.blur = torch.empty(log_scales.shape), blur
        ctx.scales = scales.numpy().ravel()
        _forward(array(log_scales).ravel(), blur, ctx.scales)
        return scales

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, slope: Tensor) -> tuple[Tensor | None, ...]:
        on_log_scales = torch.empty(slope.shape)
        _backward(ctx.scales, array(slope).ravel(), ctx.blur, on_log_scales.numpy().ravel())
        return on_log_scales, None
