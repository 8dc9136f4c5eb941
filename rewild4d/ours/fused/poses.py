"""Distance and blend of two batches of poses, a few hundred numbers on one thread.

The twins in plain torch are in ours/pose.py.
"""

from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from rewild4d.kernels.arrays import array
from rewild4d.kernels.compiling import inlined, kernel
from rewild4d.ours.fused.quaternions import side, unit, unit_slope


@kernel
def _distance(
    quats: np.ndarray, shifts: np.ndarray, others: np.ndarray, other_shifts: np.ndarray, unit: float,
    on_quats: np.ndarray, on_shifts: np.ndarray,
) -> float:  # fmt: skip
    """The distance of two batches of joints, [n, 4] and [n, 3]; sets its gradient."""
    total, share = 0.0, 1 / len(quats)
    by_length = share / (unit * unit)
    for n in range(len(quats)):
        sign = side(others[n], quats[n])
        for i in range(4):
            apart = quats[n, i] - sign * others[n, i]
            total += share * apart * apart
            on_quats[n, i] = 2 * share * apart
        for i in range(3):
            apart = np.float64(shifts[n, i]) - other_shifts[n, i]
            total += by_length * apart * apart
            on_shifts[n, i] = 2 * by_length * apart
    return total


def distance(quats: Tensor, shifts: Tensor, others: Tensor, other_shifts: Tensor, unit: float) -> Tensor:
    """Mean over joints of the squared differences of quaternions and of shifts over ``unit``; float32 on the CPU.

    Args:
        quats: [B, J, 4]; this and the next are the only inputs that get gradients.
        shifts: [B, J, 3].
        others: compared with, either sign, [B, J, 4].
        other_shifts: [B, J, 3].
        unit: of length.
    """
    return _Distance.apply(quats, shifts, others, other_shifts, unit)


class _Distance(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, quats: Tensor, shifts: Tensor, others: Tensor, other_shifts: Tensor, unit: float) -> Tensor:
        given = (array(each).reshape(-1, each.shape[-1]) for each in (quats, shifts, others, other_shifts))
        ctx.slopes = np.empty(quats.shape, np.float32), np.empty(shifts.shape, np.float32)
        flat = (slope.reshape(-1, slope.shape[-1]) for slope in ctx.slopes)
        return torch.from_numpy(np.array(_distance(*given, unit, *flat), np.float32))

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, slope: Tensor) -> tuple[Tensor | None, ...]:
        scale = np.float32(slope.item())
        return *(torch.from_numpy(each * scale) for each in ctx.slopes), None, None, None


@inlined
def _mixed(quats: np.ndarray, others: np.ndarray, n: int, weight: float) -> tuple:
    """The unit quaternion of a blend, and one over its length before."""
    sign = weight * side(others[n], quats[n])
    w, x = (1 - weight) * quats[n, 0] + sign * others[n, 0], (1 - weight) * quats[n, 1] + sign * others[n, 1]
    y, z = (1 - weight) * quats[n, 2] + sign * others[n, 2], (1 - weight) * quats[n, 3] + sign * others[n, 3]
    return unit((w, x, y, z))


@kernel
def _blend(quats: np.ndarray, others: np.ndarray, weight: float, made: np.ndarray) -> None:
    for n in range(len(quats)):
        turn = _mixed(quats, others, n, weight)
        for i in range(4):
            made[n, i] = turn[i]


@kernel
def _blend_back(quats: np.ndarray, others: np.ndarray, weight: float, slope: np.ndarray, on_quats: np.ndarray) -> None:
    for n in range(len(quats)):
        on_mixed = unit_slope(_mixed(quats, others, n, weight), slope[n])
        for i in range(4):
            on_quats[n, i] = (1 - weight) * on_mixed[i]


def blend(quats: Tensor, shifts: Tensor, others: Tensor, other_shifts: Tensor, weight: float) -> tuple[Tensor, Tensor]:
    """(1 - weight) of poses and weight of others, of either sign; float32 on the CPU.

    Args:
        quats: [B, J, 4]; this and the next are the only inputs that get gradients.
        shifts: [B, J, 3].
        others: [B, J, 4].
        other_shifts: [B, J, 3].
        weight: of the others, in [0, 1].

    Returns:
        Unit quats [B, J, 4] and shifts [B, J, 3].
    """
    return _Blend.apply(quats, shifts, others, other_shifts, weight)


class _Blend(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any, quats: Tensor, shifts: Tensor, others: Tensor, other_shifts: Tensor, weight: float
    ) -> tuple[Tensor, Tensor]:
        ctx.given = *(array(each).reshape(-1, 4) for each in (quats, others)), weight
        made = np.empty(quats.shape, np.float32)
        _blend(*ctx.given, made.reshape(-1, 4))
        moved = (1 - np.float32(weight)) * array(shifts) + np.float32(weight) * array(other_shifts)
        return torch.from_numpy(made), torch.from_numpy(moved)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, g_quats: Tensor, g_shifts: Tensor) -> tuple[Tensor | None, ...]:
        on_quats = np.empty(g_quats.shape, np.float32)
        _blend_back(*ctx.given, array(g_quats).reshape(-1, 4), on_quats.reshape(-1, 4))
        on_shifts = (1 - np.float32(ctx.given[2])) * array(g_shifts)
        return torch.from_numpy(on_quats), torch.from_numpy(on_shifts), None, None, None
