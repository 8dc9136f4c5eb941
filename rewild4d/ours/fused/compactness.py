"""Compactness of the parts: matrix products of the Gaussians' masses, 64 Gaussians side by side."""

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from rewild4d.kernels.arrays import array
from rewild4d.kernels.columns import BLOCK, four_rows, read_columns, write_columns
from rewild4d.kernels.compiling import kernel
from rewild4d.kernels.matrix import add_product, transpose
from rewild4d.kernels.simd import LANES, fma, load, splat, store, take_ticket
from rewild4d.kernels.switch import Kernel
from rewild4d.kernels.threads import run_tickets

COMPACTNESS = Kernel("compactness", "9bdac47df8b9", "rewild4d.ours.losses.regularizers:compact_loss")

CHUNK = 16 * BLOCK
"""Gaussians of a unit of work; sums run over units, so they do not depend on the number of threads."""
LEAST_MASS = 1e-12
"""Keeps the centre of a part without any mass finite."""


@kernel
def _scratch(joints: int) -> tuple:
    """Allocate masses, points and moments, by columns and by rows."""
    room, size = (joints + LANES - 1) // LANES * LANES * BLOCK, LANES * BLOCK
    mass, points, moments = np.zeros(room, np.float32), np.zeros(size, np.float32), np.zeros(size, np.float32)
    return mass, points, moments, np.empty(size, np.float32)


@kernel
def _moments(tickets: np.ndarray, clouds: tuple, weights: np.ndarray, sums: np.ndarray) -> None:
    """Sum each part's mass, first and second moments by chunk: 10 of 16 numbers, [clouds, chunks, J.. x 16]."""
    count, joints = weights.shape
    mass, points, moments, transposed = _scratch(joints)
    while True:
        chunk = take_ticket(tickets)
        if chunk >= sums.shape[1]:
            return
        for begin in range(chunk * CHUNK, min((chunk + 1) * CHUNK, count), BLOCK):
            end = min(begin + BLOCK, count)
            read_columns(weights, begin, end, mass, BLOCK)
            for cloud in range(len(clouds)):
                read_columns(clouds[cloud], begin, end, points, BLOCK)
                for lane in range(0, BLOCK, LANES):
                    x, y, z = load(points, lane), load(points, BLOCK + lane), load(points, 2 * BLOCK + lane)
                    own = splat(np.float32(1)), x, y, z, x * x, x * y, x * z, y * y, y * z, z * z
                    for i in range(len(own)):
                        store(moments, i * BLOCK + lane, own[i])
                transpose(moments, LANES, BLOCK, transposed)
                rows = (joints + 7) // 8 * 8
                add_product(mass, 0, BLOCK, 1, transposed, 0, LANES, BLOCK, sums[cloud, chunk], 0, LANES, rows, LANES)


@kernel
def _pull(tickets: np.ndarray, clouds: tuple, weights: np.ndarray, rows: np.ndarray, grads: tuple) -> None:
    """Set the gradients of the points: mass-weighted sums of linear functions, rows [clouds, J x 16] of 3 x 4."""
    count, joints = weights.shape
    mass, points, made, own = _scratch(joints)
    while True:
        begin = take_ticket(tickets) * BLOCK
        if begin >= count:
            return
        end = min(begin + BLOCK, count)
        read_columns(weights, begin, end, mass, BLOCK)
        for cloud in range(len(clouds)):
            read_columns(clouds[cloud], begin, end, points, BLOCK)
            own[:] = 0
            add_product(rows[cloud], 0, 1, LANES, mass, 0, BLOCK, joints, own, 0, BLOCK, LANES, BLOCK)
            for lane in range(0, BLOCK, LANES):
                x, y, z = load(points, lane), load(points, BLOCK + lane), load(points, 2 * BLOCK + lane)
                for i in range(3):
                    a, b, c, d = four_rows(own, 4 * i, lane)
                    store(made, i * BLOCK + lane, fma(a, x, fma(b, y, fma(c, z, d))))
            write_columns(made, BLOCK, grads[cloud], begin, end)


def compactness(clouds: Sequence[Tensor], weights: Tensor, alpha: float) -> Tensor:
    """Compute `compact_loss`; float32 on the CPU, gradients for the clouds only."""
    return _Compactness.apply(weights, alpha, *clouds)


class _Compactness(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, weights: Tensor, alpha: float, *clouds: Tensor) -> Tensor:
        points, given = tuple(map(array, clouds)), array(weights)
        joints, chunks = weights.shape[1], max(1, -(-len(weights) // CHUNK))
        room = -(-joints // LANES) * LANES
        sums = np.zeros((len(clouds), chunks, room * LANES), np.float32)
        run_tickets(_moments, points, given, sums)
        total = sums.sum(axis=1, dtype=np.float64).reshape(len(clouds), room, LANES)[:, :joints]
        mass = np.maximum(total[..., 0], LEAST_MASS)
        gamma = np.exp(-alpha * mass / mass.max(axis=-1, keepdims=True))
        center = total[..., 1:4] / mass[..., None]
        second = total[..., (4, 5, 6, 5, 7, 8, 6, 8, 9)].reshape(-1, joints, 3, 3) / mass[..., None, None]
        covariance = second - center[..., :, None] * center[..., None, :]
        top = np.linalg.eigh(covariance)[1][..., -1]
        across = np.eye(3) - top[..., :, None] * top[..., None, :]
        share = gamma / (mass * joints * len(clouds))
        rows = np.zeros((len(clouds), joints, LANES), np.float32)
        grads = np.concatenate((across, -(across @ center[..., :, None])), axis=-1)
        rows[..., :12] = (2 * share[..., None, None] * grads).reshape(-1, joints, 12)
        ctx.points, ctx.given, ctx.rows = points, given, rows.reshape(len(clouds), -1)
        value = (gamma * (across * covariance).sum(axis=(-1, -2))).mean()
        return torch.tensor(value, dtype=torch.float32)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor | None, ...]:
        made = [torch.empty(each.shape, dtype=torch.float32) for each in ctx.points]
        rows, grads = ctx.rows * grad.item(), tuple(each.numpy() for each in made)
        run_tickets(_pull, ctx.points, ctx.given, rows, grads)
        return None, None, *made
