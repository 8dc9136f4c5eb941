"""Skinning field: trilinear samples at the Gaussians, and the total variation, with one gradient for both."""

from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from rewild4d.kernels.arrays import array
from rewild4d.kernels.compiling import inlined, kernel
from rewild4d.kernels.rows import add_scaled
from rewild4d.kernels.simd import LANES, fma, maximum, minimum, splat, take_ticket
from rewild4d.kernels.switch import Kernel
from rewild4d.kernels.tails import lanes_sum, load_first, store_first
from rewild4d.kernels.threads import run_tickets

FIELD = Kernel(
    "skinning field",
    "fae36abeba05",
    "rewild4d.ours.skinning:SkinningField.sample",
    "rewild4d.ours.skinning:SkinningField.sample_and_vary",
    "rewild4d.ours.skinning:trilinear",
    "rewild4d.ours.losses.regularizers:tv_loss",
)
RESIDUAL_FIELD = Kernel(
    "skinning field of GART",
    "0a3d84b08dde",
    "rewild4d.baselines.gart_skinning:ResidualField.forward",
    "rewild4d.baselines.gart_skinning:ResidualField._variation",
    "rewild4d.ours.losses.regularizers:tv_loss",
)

CHUNK = 1024


@inlined
def _held(step: Any, width: float) -> Any:
    """Clamp a difference to [-width, width]: the derivative of the Huber function."""
    return minimum(splat(width), maximum(splat(-width), step))


@inlined
def _huber(step: Any, held: Any) -> Any:
    return held * (step - splat(np.float32(0.5)) * held)


@kernel
def _variation(tickets: np.ndarray, grid: np.ndarray, delta: float, grad: np.ndarray, sums: np.ndarray) -> None:
    """Set grad [R, R, R J] and sums [R] of the Huber function of forward differences, by planes; the border is
    repeated."""
    size, line = grid.shape[0], grid.shape[2]
    joints, last = line // size, size - 1
    width, zero = np.float32(delta), splat(np.float32(0))
    wide = np.empty(line + 2 * joints, np.float32)
    while True:
        x = take_ticket(tickets)
        if x >= size:
            return
        plane_sum = 0.0
        for y in range(size):
            own, out, total = grid[x, y], grad[x, y], zero
            wide[:joints], wide[joints : joints + line], wide[joints + line :] = own[:joints], own, own[line - joints :]
            behind, ahead = grid[x, max(y - 1, 0)], grid[x, min(y + 1, last)]
            below, above = grid[max(x - 1, 0), y], grid[min(x + 1, last), y]
            for i in range(0, line, LANES):
                left = line - i
                here = load_first(own, i, left, zero)
                a, b = load_first(wide, i + 2 * joints, left, zero) - here, load_first(ahead, i, left, zero) - here
                c = load_first(above, i, left, zero) - here
                p, q, r = _held(a, width), _held(b, width), _held(c, width)
                total = total + (_huber(a, p) + _huber(b, q) + _huber(c, r))
                pull = _held(here - load_first(wide, i, left, zero), width)
                pull = pull + _held(here - load_first(behind, i, left, zero), width)
                pull = pull + _held(here - load_first(below, i, left, zero), width)
                store_first(out, i, left, pull - (p + q + r))
            plane_sum += lanes_sum(total)
        sums[x] = plane_sum


@inlined
def _corner(points: np.ndarray, n: int, axis: int, origin: np.ndarray, pitch: np.ndarray, last: int) -> tuple:
    """Return the voxel below a point along one axis and the weight of the next one; points are clamped to the cube."""
    position = min(max((points[n, axis] - origin[axis]) / pitch[axis], np.float32(0)), np.float32(last))
    base = min(int(position), last - 1)
    return base, position - np.float32(base)


@kernel
def _sample_forward(
    tickets: np.ndarray, table: np.ndarray, points: np.ndarray, origin: np.ndarray, pitch: np.ndarray, size: int,
    joints: int, weights: np.ndarray,
) -> None:  # fmt: skip
    """Set the rows of weights; weights and table are flat."""
    while True:
        begin = take_ticket(tickets) * CHUNK
        if begin >= len(points):
            return
        for n in range(begin, min(begin + CHUNK, len(points))):
            x, ahead_x = _corner(points, n, 0, origin, pitch, size - 1)
            y, ahead_y = _corner(points, n, 1, origin, pitch, size - 1)
            z, ahead_z = _corner(points, n, 2, origin, pitch, size - 1)
            first = ((x * size + y) * size + z) * joints
            for at in range(0, joints, LANES):
                total = splat(np.float32(0))
                for i in range(2):
                    for j in range(2):
                        along = (ahead_x if i else 1 - ahead_x) * (ahead_y if j else 1 - ahead_y)
                        row = first + (i * size + j) * size * joints + at
                        near = load_first(table, row, joints - at, total)
                        far = load_first(table, row + joints, joints - at, total)
                        total = fma(splat(np.float32(along * (1 - ahead_z))), near, total)
                        total = fma(splat(np.float32(along * ahead_z)), far, total)
                store_first(weights, n * joints + at, joints - at, total)


@kernel
def _sort_by_plane(
    points: np.ndarray, origin: np.ndarray, pitch: np.ndarray, size: int, order: np.ndarray, starts: np.ndarray
) -> None:
    """Sort points by the voxel plane below them along x; starts [size + 1]."""
    starts[:] = 0
    for n in range(len(points)):
        starts[_corner(points, n, 0, origin, pitch, size - 1)[0] + 1] += 1
    for plane in range(size):
        starts[plane + 1] += starts[plane]
    cursor = starts.copy()
    for n in range(len(points)):
        plane = _corner(points, n, 0, origin, pitch, size - 1)[0]
        order[cursor[plane]] = n
        cursor[plane] += 1


@kernel
def _sample_backward(
    tickets: np.ndarray, points: np.ndarray, origin: np.ndarray, pitch: np.ndarray, size: int, order: np.ndarray,
    starts: np.ndarray, joints: int, grad: np.ndarray, variation: np.ndarray, variation_share: float,
    on_table: np.ndarray,
) -> None:  # fmt: skip
    """Set on_table plane by plane: the scaled gradient of the variation, if any, then the points below a plane, then
    those above, each in order. All arrays are flat."""
    line = size * size * joints
    while True:
        plane = take_ticket(tickets)
        if plane >= size:
            return
        own = on_table[plane * line : (plane + 1) * line]
        own[:] = 0
        if len(variation) > 0:
            add_scaled(np.float32(variation_share), variation, plane * line, own, 0, line)
        for upper in (1, 0):
            if plane < upper:
                continue
            for at in range(starts[plane - upper], starts[plane - upper + 1]):
                n = order[at]
                ahead_x = _corner(points, n, 0, origin, pitch, size - 1)[1]
                y, ahead_y = _corner(points, n, 1, origin, pitch, size - 1)
                z, ahead_z = _corner(points, n, 2, origin, pitch, size - 1)
                along = ahead_x if upper else 1 - ahead_x
                for j in range(2):
                    for k in range(2):
                        share = along * (ahead_y if j else 1 - ahead_y)
                        share = np.float32(share * (ahead_z if k else 1 - ahead_z))
                        row = (plane * size + y + j) * size + z + k
                        add_scaled(share, grad, n * joints, on_table, row * joints, joints)


def sample_grid(
    table: Tensor, points: Tensor, origin: Tensor, pitch: Tensor, size: int, delta: float | None = None
) -> tuple[Tensor, Tensor]:
    """Sample a cubic grid of vectors [size^3, J], x slowest, at points [n, 3], and compute its `tv_loss`; float32 on
    the CPU.

    Only the table gets a gradient. ``origin`` is the centre of the first voxel; without ``delta`` the variation is
    skipped.
    """
    return _Sample.apply(table, points, origin, pitch, size, delta)


class _Sample(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any, table: Tensor, points: Tensor, origin: Tensor, pitch: Tensor, size: int, delta: float | None
    ) -> tuple[Tensor, Tensor]:
        grid, joints = array(table), table.shape[1]
        weights = table.new_empty(len(points), joints)
        given = *map(array, (points, origin, pitch)), size
        run_tickets(_sample_forward, grid.ravel(), *given, joints, weights.numpy().ravel())
        ctx.given, ctx.grad, total = given, np.empty(0, np.float32), 0.0
        # Each axis has as many differences as any other.
        ctx.share = 1 / (3 * (size - 1) * size * size * joints)
        if delta is not None:
            grad, sums = np.empty((size, size, size * joints), np.float32), np.empty(size)
            lines = grid.reshape(grad.shape)
            run_tickets(_variation, lines, delta, grad, sums)
            ctx.grad, total = grad.ravel(), float(sums.sum()) * ctx.share
        return weights, torch.tensor(total, dtype=torch.float32)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad: Tensor, by_variation: Tensor) -> tuple[Tensor | None, ...]:
        points, size = ctx.given[0], ctx.given[3]
        order, starts = np.empty(len(points), np.int32), np.empty(size + 1, np.int64)
        _sort_by_plane(*ctx.given, order, starts)
        joints = grad.shape[1]
        on_table = torch.empty(size**3, joints)
        rows, variation_share = (*ctx.given, order, starts, joints), float(by_variation) * ctx.share
        run_tickets(_sample_backward, *rows, array(grad).ravel(), ctx.grad, variation_share, on_table.numpy().ravel())
        return on_table, None, None, None, None, None
