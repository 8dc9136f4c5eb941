"""Compactness of the parts.

The twin in plain torch is in ours/geometry_losses.py.
"""

from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from rewild4d.kernels.arrays import array
from rewild4d.kernels.compiling import kernel
from rewild4d.kernels.simd import LANES, fma, load, splat, store, take_ticket
from rewild4d.kernels.threads import run, thread_count

CHUNK = 1024
"""Gaussians a unit of work holds; sums are added over these, whatever the number of threads."""


@kernel
def _mass(weights: np.ndarray, opacities: np.ndarray, n: int, joint: int, power: float) -> float:
    weight = weights[n, joint]
    return (weight * weight if power == 2 else weight**power) * opacities[n]


@kernel
def _moments(
    tickets: np.ndarray, points: np.ndarray, weights: np.ndarray, opacities: np.ndarray, power: float, sums: np.ndarray
) -> None:
    """Add up, chunk by chunk, each part's mass, first and second moments: 10 of 16 numbers, [chunks, J x 16]."""
    count, joints = weights.shape
    values = np.zeros(LANES, np.float32)
    while True:
        chunk = take_ticket(tickets)
        if chunk * CHUNK >= count:
            return
        own = sums[chunk]
        for n in range(chunk * CHUNK, min((chunk + 1) * CHUNK, count)):
            x, y, z = points[n, 0], points[n, 1], points[n, 2]
            values[0], values[1], values[2], values[3] = 1, x, y, z
            values[4], values[5], values[6] = x * x, x * y, x * z
            values[7], values[8], values[9] = y * y, y * z, z * z
            moment = load(values, 0)
            for joint in range(joints):
                mass = splat(np.float32(_mass(weights, opacities, n, joint, power)))
                store(own, joint * LANES, fma(mass, moment, load(own, joint * LANES)))


@kernel
def _pull(
    tickets: np.ndarray, points: np.ndarray, weights: np.ndarray, opacities: np.ndarray, power: float,
    rows: np.ndarray, on_points: np.ndarray,
) -> None:  # fmt: skip
    """Set each point's gradient: the mass-weighted sum of the parts' linear functions, rows [J x 16] of 3 x 4."""
    count, joints = weights.shape
    row = np.empty(LANES, np.float32)
    while True:
        begin = take_ticket(tickets) * CHUNK
        if begin >= count:
            return
        for n in range(begin, min(begin + CHUNK, count)):
            total = splat(np.float32(0))
            for joint in range(joints):
                mass = splat(np.float32(_mass(weights, opacities, n, joint, power)))
                total = fma(mass, load(rows, joint * LANES), total)
            store(row, 0, total)
            x, y, z = points[n, 0], points[n, 1], points[n, 2]
            for i in range(3):
                on_points[n, i] = row[4 * i] * x + row[4 * i + 1] * y + row[4 * i + 2] * z + row[4 * i + 3]


def compactness(points: Tensor, weights: Tensor, opacities: Tensor, power: float) -> Tensor:
    """Mean over parts of the two smaller eigenvalues of a part's covariance; float32, CPU.

    Args:
        points: [n, 3]; the only input that gets a gradient.
        weights: skinning weights, [n, J].
        opacities: [n].
        power: exponent on the weights.
    """
    return _Compactness.apply(points, weights, opacities, power)


class _Compactness(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, points: Tensor, weights: Tensor, opacities: Tensor, power: float) -> Tensor:
        given = tuple(map(array, (points, weights, opacities)))
        joints = weights.shape[1]
        sums = np.zeros((max(1, -(-len(points) // CHUNK)), joints * LANES), np.float32)
        run(_moments, [(np.zeros(1, np.int64), *given, power, sums)] * thread_count())
        total = sums.sum(axis=0, dtype=np.float64).reshape(joints, LANES)
        used = total[:, 0] >= 1
        mass = np.where(used, total[:, 0], 1.0)
        center = total[:, 1:4] / mass[:, None]
        second = total[:, (4, 5, 6, 5, 7, 8, 6, 8, 9)].reshape(joints, 3, 3) / mass[:, None, None]
        covariance = second - center[:, :, None] * center[:, None, :]
        top = np.linalg.eigh(covariance)[1][..., -1]
        across = np.eye(3) - top[:, :, None] * top[:, None, :]
        share = used / (mass * max(1, used.sum()))
        rows = np.zeros((joints, LANES), np.float32)
        rows[:, :12] = (
            2 * share[:, None, None] * np.concatenate((across, -(across @ center[:, :, None])), axis=2)
        ).reshape(joints, 12)
        ctx.given, ctx.power, ctx.rows = given, power, rows
        value = (used * (across * covariance).sum((1, 2))).sum() / max(1, used.sum())
        return torch.tensor(value, dtype=torch.float32)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, slope: Tensor) -> tuple[Tensor | None, ...]:
        on_points = torch.empty(ctx.given[0].shape)
        rows = (ctx.rows * slope.item()).ravel()
        run(_pull, [(np.zeros(1, np.int64), *ctx.given, ctx.power, rows, on_points.numpy())] * thread_count())
        return on_points, None, None, None
