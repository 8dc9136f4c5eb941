"""Colour of every Gaussian from one viewpoint, its direction turned back into the canonical frame first.

The twin in plain torch is `Gaussians.seen_rgb` (ours/canonical.py).
"""

import math
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from rewild4d.kernels.arrays import array
from rewild4d.kernels.compiling import inlined, kernel
from rewild4d.kernels.harmonics import CHUNK, set_basis
from rewild4d.kernels.simd import take_ticket
from rewild4d.kernels.threads import run, thread_count


@inlined
def _cross(a: tuple, b: tuple) -> tuple:
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


@inlined
def _direction(means: np.ndarray, quats: np.ndarray, rest: np.ndarray, n: int, eye: np.ndarray) -> tuple:
    """Unit direction from the eye to a Gaussian, as the Gaussian saw it at rest."""
    x, y, z = means[n, 0] - eye[0], means[n, 1] - eye[1], means[n, 2] - eye[2]
    inverse = 1 / max(math.sqrt(x * x + y * y + z * z), 1e-12)
    p, s = quats[n], rest[n]
    # The quaternion rest conj(posed) turns back; it may have any length.
    w = s[0] * p[0] + s[1] * p[1] + s[2] * p[2] + s[3] * p[3]
    axis = (
        -s[0] * p[1] + s[1] * p[0] - s[2] * p[3] + s[3] * p[2],
        -s[0] * p[2] + s[1] * p[3] + s[2] * p[0] - s[3] * p[1],
        -s[0] * p[3] - s[1] * p[2] + s[2] * p[1] + s[3] * p[0],
    )
    scale = 2 / max(w * w + axis[0] * axis[0] + axis[1] * axis[1] + axis[2] * axis[2], 1e-24)
    once = _cross(axis, (x, y, z))
    twice = _cross(axis, once)
    return (
        (x + scale * (w * once[0] + twice[0])) * inverse,
        (y + scale * (w * once[1] + twice[1])) * inverse,
        (z + scale * (w * once[2] + twice[2])) * inverse,
    )


@kernel
def _forward(
    tickets: np.ndarray, colors: np.ndarray, means: np.ndarray, quats: np.ndarray, rest: np.ndarray, eye: np.ndarray,
    degree: int, gain: float, seen: np.ndarray,
) -> None:  # fmt: skip
    values = np.empty(15, np.float32)
    count = (degree + 1) ** 2 - 1
    while True:
        begin = take_ticket(tickets) * CHUNK
        if begin >= len(means):
            return
        for n in range(begin, min(begin + CHUNK, len(means))):
            set_basis(_direction(means, quats, rest, n, eye), degree, values)
            for channel in range(3):
                total = np.float32(0)
                for k in range(count):
                    total += values[k] * colors[n, k + 1, channel]
                seen[n, channel] = max(colors[n, 0, channel] + total / np.float32(gain), np.float32(0))


@kernel
def _backward(
    tickets: np.ndarray, means: np.ndarray, quats: np.ndarray, rest: np.ndarray, eye: np.ndarray, degree: int,
    gain: float, seen: np.ndarray, slope: np.ndarray, on_colors: np.ndarray,
) -> None:  # fmt: skip
    values = np.empty(15, np.float32)
    count = (degree + 1) ** 2 - 1
    zero, share_of_one = np.float32(0), np.float32(1 / gain)
    while True:
        begin = take_ticket(tickets) * CHUNK
        if begin >= len(means):
            return
        for n in range(begin, min(begin + CHUNK, len(means))):
            set_basis(_direction(means, quats, rest, n, eye), degree, values)
            on_colors[n] = 0
            red, green, blue = (
                slope[n, 0] if seen[n, 0] > 0 else zero,
                slope[n, 1] if seen[n, 1] > 0 else zero,
                slope[n, 2] if seen[n, 2] > 0 else zero,
            )
            on_colors[n, 0, 0], on_colors[n, 0, 1], on_colors[n, 0, 2] = red, green, blue
            for k in range(count):
                share = values[k] * share_of_one
                on_colors[n, k + 1, 0] = share * red
                on_colors[n, k + 1, 1] = share * green
                on_colors[n, k + 1, 2] = share * blue


def seen_rgb(
    colors: Tensor, means: Tensor, quats: Tensor, rest: Tensor, eye: Tensor, degree: int, gain: float
) -> Tensor:
    """Colours from a viewpoint; float32, CPU. Gradients reach the colours alone.

    Args:
        colors: RGB, then ``gain`` times the coefficients above degree 0, [n, k, 3].
        means: posed, [n, 3].
        quats: posed, any length, [n, 4].
        rest: canonical, any length, [n, 4].
        eye: [3].
        degree: in use, 1 to 3.
        gain: of the coefficients.

    Returns:
        Not below 0, [n, 3].
    """
    if not 1 <= degree <= 3:
        raise ValueError(f"expected a degree from 1 to 3, got {degree}")
    return _Seen.apply(colors, means, quats, rest, eye, degree, gain)


class _Seen(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any, colors: Tensor, means: Tensor, quats: Tensor, rest: Tensor, eye: Tensor, degree: int, gain: float
    ) -> Tensor:
        seen = torch.empty_like(means)
        given = *map(array, (means, quats, rest, eye.float())), degree, gain
        run(_forward, [(np.zeros(1, np.int64), array(colors), *given, seen.numpy())] * thread_count())
        ctx.given, ctx.seen, ctx.shape = given, seen.numpy(), colors.shape
        return seen

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, slope: Tensor) -> tuple[Tensor | None, ...]:
        on_colors = torch.empty(ctx.shape)
        call = np.zeros(1, np.int64), *ctx.given, ctx.seen, array(slope), on_colors.numpy()
        run(_backward, [call] * thread_count())
        return on_colors, None, None, None, None, None, None
