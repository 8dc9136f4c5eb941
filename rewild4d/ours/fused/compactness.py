"""Compactness of the parts.

The twin in plain torch is in ours/geometry_losses.py.
"""

from collections.abc import Sequence
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
    tickets: np.ndarray, clouds: tuple, weights: np.ndarray, opacities: np.ndarray, power: float, sums: np.ndarray
) -> None:
    """Add up, by chunks, each part's mass, first and second moments: 10 of 16 numbers, [clouds, chunks, J x 16]."""
    count, joints = weights.shape
    chunks = sums.shape[1]
    values = np.zeros(LANES, np.float32)
    while True:
        unit = take_ticket(tickets)
        if unit >= len(clouds) * chunks:
            return
        chunk = unit % chunks
        own, points = sums[unit // chunks, chunk], clouds[unit // chunks]
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
    tickets: np.ndarray, clouds: tuple, weights: np.ndarray, opacities: np.ndarray, power: float, rows: np.ndarray,
    slopes: tuple,
) -> None:  # fmt: skip
    """Set the gradients of the points: mass-weighted sums of linear functions, rows [clouds, J x 16] of 3 x 4."""
    count, joints = weights.shape
    chunks = (count + CHUNK - 1) // CHUNK
    row = np.empty(LANES, np.float32)
    while True:
        unit = take_ticket(tickets)
        if unit >= len(clouds) * chunks:
            return
        begin, cloud = unit % chunks * CHUNK, unit // chunks
        points, on_points = clouds[cloud], slopes[cloud]
        for n in range(begin, min(begin + CHUNK, count)):
            total = splat(np.float32(0))
            for joint in range(joints):
                mass = splat(np.float32(_mass(weights, opacities, n, joint, power)))
                total = fma(mass, load(rows[cloud], joint * LANES), total)
            store(row, 0, total)
            x, y, z = points[n, 0], points[n, 1], points[n, 2]
            for i in range(3):
                on_points[n, i] = row[4 * i] * x + row[4 * i + 1] * y + row[4 * i + 2] * z + row[4 * i + 3]


def compactness(clouds: Sequence[Tensor], weights: Tensor, opacities: Tensor, power: float) -> Tensor:
    """Mean over clouds and parts of the two smaller eigenvalues of a part's covariance; float32, CPU.

    Args:
        clouds: of the same Gaussians, [n, 3] each; the only inputs that get gradients.
        weights: skinning weights, [n, J].
        opacities: [n].
        power: exponent on the weights.
    """
    return _Compactness.apply(weights, opacities, power, *clouds)


class _Compactness(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, weights: Tensor, opacities: Tensor, power: float, *clouds: Tensor) -> Tensor:
        places, given = tuple(map(array, clouds)), (*map(array, (weights, opacities)), power)
        joints, chunks = weights.shape[1], max(1, -(-len(weights) // CHUNK))
        sums = np.zeros((len(clouds), chunks, joints * LANES), np.float32)
        run(_moments, [(np.zeros(1, np.int64), places, *given, sums)] * thread_count())
        total = sums.sum(axis=1, dtype=np.float64).reshape(len(clouds), joints, LANES)
        used = total[..., 0] >= 1
        mass, parts = np.where(used, total[..., 0], 1.0), np.maximum(1, used.sum(axis=-1, keepdims=True))
        center = total[..., 1:4] / mass[..., None]
        second = total[..., (4, 5, 6, 5, 7, 8, 6, 8, 9)].reshape(-1, joints, 3, 3) / mass[..., None, None]
        covariance = second - center[..., :, None] * center[..., None, :]
        top = np.linalg.eigh(covariance)[1][..., -1]
        across = np.eye(3) - top[..., :, None] * top[..., None, :]
        share = used / (mass * parts * len(clouds))
        rows = np.zeros((len(clouds), joints, LANES), np.float32)
        slopes = np.concatenate((across, -(across @ center[..., :, None])), axis=-1)
        rows[..., :12] = (2 * share[..., None, None] * slopes).reshape(-1, joints, 12)
        ctx.places, ctx.given, ctx.rows = places, given, rows.reshape(len(clouds), -1)
        value = (used / parts * (across * covariance).sum(axis=(-1, -2))).sum() / len(clouds)
        return torch.tensor(value, dtype=torch.float32)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, slope: Tensor) -> tuple[Tensor | None, ...]:
        made = [torch.empty(each.shape) for each in ctx.places]
        rows, slopes = ctx.rows * slope.item(), tuple(each.numpy() for each in made)
        run(_pull, [(np.zeros(1, np.int64), ctx.places, *ctx.given, rows, slopes)] * thread_count())
        return None, None, None, *made
