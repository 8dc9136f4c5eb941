"""Colour of every Gaussian from one viewpoint, whose direction is first rotated into the canonical frame."""

from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from rewild4d.kernels.arrays import array
from rewild4d.kernels.columns import BLOCK, four_rows, read_columns, write_columns
from rewild4d.kernels.compiling import inlined, kernel
from rewild4d.kernels.harmonics import set_band
from rewild4d.kernels.simd import LANES, divide, fma, load, maximum, select_gt, splat, square_root, store, take_ticket
from rewild4d.kernels.switch import Kernel
from rewild4d.kernels.threads import run_tickets
from rewild4d.ours.fused.quaternions import dot, times_back

COLORS = Kernel(
    "colours from harmonics",
    "59c7434dcec6",
    "rewild4d.ours.canonical:Gaussians.seen_rgb",
    "rewild4d.ours.canonical:Gaussians.rotations_to",
)

CHUNK = 8 * BLOCK


@inlined
def _cross(a: tuple, b: tuple) -> tuple:
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


@inlined
def _direction(means: np.ndarray, quats: np.ndarray, rest: np.ndarray, lane: int, eye: np.ndarray) -> tuple:
    """Return unit directions from the eye to sixteen Gaussians in the canonical frame."""
    one, two, least = splat(np.float32(1)), splat(np.float32(2)), splat(np.float32(1e-24))
    x, y = load(means, lane) - splat(eye[0]), load(means, BLOCK + lane) - splat(eye[1])
    z = load(means, 2 * BLOCK + lane) - splat(eye[2])
    # In this order of the limits a NaN stays one.
    inverse = divide(one, square_root(maximum(least, x * x + y * y + z * z)))
    p, s = four_rows(quats, 0, lane), four_rows(rest, 0, lane)
    # The quaternion rest conj(posed) rotations back; it may have any length.
    back = times_back(s, p)
    w, axis = back[0], (back[1], back[2], back[3])
    scale = divide(two, maximum(least, dot(back, back)))
    once = _cross(axis, (x, y, z))
    twice = _cross(axis, once)
    return (
        (x + scale * (w * once[0] + twice[0])) * inverse,
        (y + scale * (w * once[1] + twice[1])) * inverse,
        (z + scale * (w * once[2] + twice[2])) * inverse,
    )


@kernel
def _set_block(
    begin: int, end: int, means: np.ndarray, quats: np.ndarray, rest: np.ndarray, eye: np.ndarray, degree: int,
    rows: tuple, values: np.ndarray,
) -> None:  # fmt: skip
    """Set the basis functions above degree 0, [15, BLOCK]; ``rows`` is scratch."""
    positions, rotations, rests = rows
    read_columns(means, begin, end, positions, BLOCK)
    read_columns(quats, begin, end, rotations, BLOCK)
    read_columns(rest, begin, end, rests, BLOCK)
    for lane in range(0, BLOCK, LANES):
        x, y, z = _direction(positions, rotations, rests, lane, eye)
        for level in range(1, degree + 1):
            set_band(x, y, z, level, values[(level * level - 1) * BLOCK + lane :], BLOCK)


@kernel
def _scratch() -> tuple:
    size = LANES * BLOCK
    return np.empty(size, np.float32), np.empty(size, np.float32), np.empty(size, np.float32)


@kernel
def _forward(
    tickets: np.ndarray, colors: np.ndarray, means: np.ndarray, quats: np.ndarray, rest: np.ndarray, eye: np.ndarray,
    degree: int, gain: float, seen: np.ndarray,
) -> None:  # fmt: skip
    values, rows = np.empty(15 * BLOCK, np.float32), _scratch()
    columns, made = np.empty((colors.shape[1] + 15) // 16 * 16 * BLOCK, np.float32), np.zeros(LANES * BLOCK, np.float32)
    count, share, zero = (degree + 1) ** 2 - 1, splat(np.float32(1 / gain)), splat(np.float32(0))
    while True:
        chunk = take_ticket(tickets) * CHUNK
        if chunk >= len(means):
            return
        for begin in range(chunk, min(chunk + CHUNK, len(means)), BLOCK):
            end = min(begin + BLOCK, len(means))
            _set_block(begin, end, means, quats, rest, eye, degree, rows, values)
            read_columns(colors, begin, end, columns, BLOCK)
            for lane in range(0, BLOCK, LANES):
                for channel in range(3):
                    total = zero
                    for k in range(count):
                        coefficient = load(columns, (3 * k + 3 + channel) * BLOCK + lane)
                        total = fma(load(values, k * BLOCK + lane), coefficient, total)
                    color = fma(total, share, load(columns, channel * BLOCK + lane))
                    store(made, channel * BLOCK + lane, maximum(zero, color))  # in this order a NaN stays one
            write_columns(made, BLOCK, seen, begin, end)


@kernel
def _backward(
    tickets: np.ndarray, means: np.ndarray, quats: np.ndarray, rest: np.ndarray, eye: np.ndarray, degree: int,
    gain: float, seen: np.ndarray, grad: np.ndarray, on_colors: np.ndarray,
) -> None:  # fmt: skip
    values, rows = np.empty(15 * BLOCK, np.float32), _scratch()
    shown, grads = np.empty(LANES * BLOCK, np.float32), np.empty(LANES * BLOCK, np.float32)
    columns = np.zeros((on_colors.shape[1] + 15) // 16 * 16 * BLOCK, np.float32)
    count, share, zero = (degree + 1) ** 2 - 1, splat(np.float32(1 / gain)), splat(np.float32(0))
    while True:
        chunk = take_ticket(tickets) * CHUNK
        if chunk >= len(means):
            return
        for begin in range(chunk, min(chunk + CHUNK, len(means)), BLOCK):
            end = min(begin + BLOCK, len(means))
            _set_block(begin, end, means, quats, rest, eye, degree, rows, values)
            read_columns(seen, begin, end, shown, BLOCK)
            read_columns(grad, begin, end, grads, BLOCK)
            for lane in range(0, BLOCK, LANES):
                for channel in range(3):
                    index = channel * BLOCK + lane
                    own = select_gt(load(shown, index), zero, load(grads, index), zero)
                    store(columns, index, own)
                    own = own * share
                    for k in range(count):
                        store(columns, (3 * k + 3) * BLOCK + index, load(values, k * BLOCK + lane) * own)
            write_columns(columns, BLOCK, on_colors, begin, end)


def seen_rgb(
    colors: Tensor, means: Tensor, quats: Tensor, rest: Tensor, eye: Tensor, degree: int, gain: float
) -> Tensor:
    """Compute `Gaussians.seen_rgb`; float32 on the CPU, gradients for the colours only.

    ``quats`` (posed) and ``rest`` (canonical) may have any length; ``gain`` multiplies the coefficients above degree 0.
    """
    if not 1 <= degree <= 3:
        raise ValueError(f"expected a degree from 1 to 3, got {degree}")
    if colors.shape[1] < (degree + 1) ** 2:
        raise ValueError(f"expected {(degree + 1) ** 2} coefficients for degree {degree}, got {colors.shape[1]}")
    return _Seen.apply(colors, means, quats, rest, eye, degree, gain)


class _Seen(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any, colors: Tensor, means: Tensor, quats: Tensor, rest: Tensor, eye: Tensor, degree: int, gain: float
    ) -> Tensor:
        seen = torch.empty(means.shape, dtype=torch.float32)
        given = *map(array, (means, quats, rest, eye.float())), degree, gain
        flat = array(colors).reshape(len(colors), 3 * colors.shape[1])
        run_tickets(_forward, flat, *given, seen.numpy())
        ctx.given, ctx.seen, ctx.shape = given, seen.numpy(), colors.shape
        return seen

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor | None, ...]:
        on_colors = torch.empty(ctx.shape, dtype=torch.float32)
        flat = on_colors.numpy().reshape(len(grad), 3 * ctx.shape[1])
        run_tickets(_backward, *ctx.given, ctx.seen, array(grad), flat)
        return on_colors, None, None, None, None, None, None
