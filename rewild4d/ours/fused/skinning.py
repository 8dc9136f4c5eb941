"""Linear blend skinning for both branches: one forward pass, and one backward pass that keeps their gradients apart.

64 Gaussians at a time: their numbers are rows, Gaussians are lanes, and blending is a small matrix product.
"""

from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from rewild4d.kernels.arrays import array
from rewild4d.kernels.columns import BLOCK, four_rows, read_columns, write_columns
from rewild4d.kernels.compiling import inlined, kernel
from rewild4d.kernels.matrix import add_product, transpose
from rewild4d.kernels.simd import LANES, fma, load, store, take_ticket
from rewild4d.kernels.switch import Kernel
from rewild4d.kernels.threads import run_tickets
from rewild4d.ours.fused.quaternions import back_times, times, times_back, unit_grad, unit_lanes

SKINNING = Kernel(
    "skinning",
    "f97e862003c8",
    "rewild4d.ours.model:Model.skin",
    "rewild4d.transforms:skin_points",
    "rewild4d.transforms:skin_quats",
)
GART_SKINNING = Kernel(
    "skinning of GART",
    "5a6cf6814df5",
    "rewild4d.baselines.gart_skinning:posed",
    "rewild4d.transforms:skin_points",
    "rewild4d.transforms:skin_quats",
)

CHUNK = 16 * BLOCK
"""Gaussians of a unit of work; joint gradients are summed by unit, so they do not depend on the number of threads."""
QUAT = 12
"""First index of the rotation in a joint's sixteen numbers; its transform, by rows, comes before."""


class Joints(NamedTuple):
    """Joints as the kernels read them."""

    rows: Any  # sixteen numbers a joint, padded to a multiple of sixteen joints, flat
    signs: Any  # sign [J, J] that aligns a joint's rotation with that of the joint of the largest weight (rows)
    opposed: Any  # whether any sign is -1


@kernel
def _sign_block(begin: int, end: int, weights: np.ndarray, signs: np.ndarray, signed: np.ndarray) -> None:
    """Set signed [J, BLOCK] to the signs for each Gaussian's joint of the largest weight, the first of equals."""
    for lane in range(end - begin):
        n, leader = begin + lane, 0
        for joint in range(1, len(signs)):
            if weights[n, joint] > weights[n, leader]:
                leader = joint
        for joint in range(len(signs)):
            signed[joint * BLOCK + lane] = signs[leader, joint]


@kernel
def _blend_block(
    begin: int, end: int, weights: np.ndarray, joints: Joints, shares: np.ndarray, signed: np.ndarray,
    scratch: np.ndarray, blended: np.ndarray,
) -> None:  # fmt: skip
    """Set the weights by rows, shares [J, BLOCK], the blended numbers, [16, BLOCK], and ``signed`` if signs differ."""
    count = weights.shape[1]
    read_columns(weights, begin, end, shares, BLOCK)
    blended[:] = 0
    add_product(joints.rows, 0, 1, LANES, shares, 0, BLOCK, count, blended, 0, BLOCK, LANES, BLOCK)
    if joints.opposed:
        _sign_block(begin, end, weights, joints.signs, signed)
        for i in range(0, count * BLOCK, LANES):
            store(scratch, i, load(shares, i) * load(signed, i))
        blended[QUAT * BLOCK :] = 0
        # A product has a multiple of eight rows: the four before are kept.
        kept = blended[(QUAT - 4) * BLOCK : QUAT * BLOCK].copy()
        first = QUAT - 4
        add_product(joints.rows, first, 1, LANES, scratch, 0, BLOCK, count, blended, first * BLOCK, BLOCK, 8, BLOCK)
        blended[(QUAT - 4) * BLOCK : QUAT * BLOCK] = kept


@inlined
def _store_column(rows: np.ndarray, first: int, lane: int, column: tuple) -> None:
    for i in range(4):
        store(rows, (first + i) * BLOCK + lane, column[i])


@kernel
def _forward(
    tickets: np.ndarray, means: np.ndarray, quats: np.ndarray, weights: np.ndarray, joints: Joints,
    new_means: np.ndarray, new_quats: np.ndarray,
) -> None:  # fmt: skip
    room = len(joints.rows) // LANES * BLOCK
    shares, signed, scratch = np.zeros(room, np.float32), np.zeros(room, np.float32), np.zeros(room, np.float32)
    blended, position, orientation = (
        np.empty(LANES * BLOCK, np.float32), np.zeros(LANES * BLOCK, np.float32), np.zeros(LANES * BLOCK, np.float32)
    )  # fmt: skip
    while True:
        begin = take_ticket(tickets) * BLOCK
        if begin >= len(means):
            return
        end = min(begin + BLOCK, len(means))
        _blend_block(begin, end, weights, joints, shares, signed, scratch, blended)
        read_columns(means, begin, end, position, BLOCK)
        read_columns(quats, begin, end, orientation, BLOCK)
        for lane in range(0, BLOCK, LANES):
            x, y, z = load(position, lane), load(position, BLOCK + lane), load(position, 2 * BLOCK + lane)
            for i in range(3):
                a, b, c, d = four_rows(blended, 4 * i, lane)
                store(position, i * BLOCK + lane, fma(a, x, fma(b, y, fma(c, z, d))))
            rotated = times(unit_lanes(four_rows(blended, QUAT, lane)), unit_lanes(four_rows(orientation, 0, lane)))
            _store_column(orientation, 0, lane, rotated)
        write_columns(position, BLOCK, new_means, begin, end)
        write_columns(orientation, BLOCK, new_quats, begin, end)


@inlined
def _grads(
    lane: int, blended: np.ndarray, position: np.ndarray, orientation: np.ndarray, g_live: np.ndarray,
    g_live_quats: np.ndarray, g_still: np.ndarray, g_still_quats: np.ndarray, live: np.ndarray, grad: np.ndarray,
) -> None:  # fmt: skip
    """Set gradients of the blended numbers, of the live branch and of both, [16, BLOCK]; overwrite the rest positions
    and orientations with theirs."""
    unit, rest = unit_lanes(four_rows(blended, QUAT, lane)), unit_lanes(four_rows(orientation, 0, lane))
    g, h = four_rows(g_live_quats, 0, lane), four_rows(g_still_quats, 0, lane)
    both = g[0] + h[0], g[1] + h[1], g[2] + h[2], g[3] + h[3]
    _store_column(live, QUAT, lane, unit_grad(unit, times_back(g, rest)))
    _store_column(grad, QUAT, lane, unit_grad(unit, times_back(both, rest)))
    _store_column(orientation, 0, lane, unit_grad(rest, back_times(unit, both)))
    x, y, z = load(position, lane), load(position, BLOCK + lane), load(position, 2 * BLOCK + lane)
    on_x, on_y, on_z = x - x, x - x, x - x
    for i in range(3):
        one = load(g_live, i * BLOCK + lane)
        other = one + load(g_still, i * BLOCK + lane)
        a, b, c, _ = four_rows(blended, 4 * i, lane)
        on_x, on_y, on_z = fma(other, a, on_x), fma(other, b, on_y), fma(other, c, on_z)
        _store_column(live, 4 * i, lane, (one * x, one * y, one * z, one))
        _store_column(grad, 4 * i, lane, (other * x, other * y, other * z, other))
    store(position, lane, on_x)
    store(position, BLOCK + lane, on_y)
    store(position, 2 * BLOCK + lane, on_z)


@kernel
def _share_back(
    joints: Joints, count: int, shares: np.ndarray, signed: np.ndarray, live: np.ndarray, grad: np.ndarray,
    scratch: np.ndarray, transposed: np.ndarray, on_rows: np.ndarray,
) -> None:  # fmt: skip
    """Add the gradient of the joints' numbers, and overwrite the weights with theirs, [J, BLOCK]."""
    rows = (count + 7) // 8 * 8
    transpose(live, LANES, BLOCK, transposed)
    if not joints.opposed:
        add_product(shares, 0, BLOCK, 1, transposed, 0, LANES, BLOCK, on_rows, 0, LANES, rows, LANES)
        shares[: rows * BLOCK] = 0
        add_product(joints.rows, 0, LANES, 1, grad, 0, BLOCK, LANES, shares, 0, BLOCK, rows, BLOCK)
        return
    quats = transposed.copy()
    for lane in range(BLOCK):
        transposed[lane * LANES + QUAT : (lane + 1) * LANES] = 0
        quats[lane * LANES : lane * LANES + QUAT] = 0
    for i in range(0, rows * BLOCK, LANES):
        store(scratch, i, load(shares, i) * load(signed, i))
    add_product(shares, 0, BLOCK, 1, transposed, 0, LANES, BLOCK, on_rows, 0, LANES, rows, LANES)
    add_product(scratch, 0, BLOCK, 1, quats, 0, LANES, BLOCK, on_rows, 0, LANES, rows, LANES)
    shares[: rows * BLOCK], scratch[: rows * BLOCK] = 0, 0
    add_product(joints.rows, 0, LANES, 1, grad, 0, BLOCK, QUAT, shares, 0, BLOCK, rows, BLOCK)
    add_product(joints.rows, QUAT, LANES, 1, grad, QUAT * BLOCK, BLOCK, LANES - QUAT, scratch, 0, BLOCK, rows, BLOCK)
    for i in range(0, rows * BLOCK, LANES):
        store(shares, i, fma(load(scratch, i), load(signed, i), load(shares, i)))


@kernel
def _backward(
    tickets: np.ndarray, means: np.ndarray, quats: np.ndarray, weights: np.ndarray, joints: Joints,
    g_live: np.ndarray, g_live_quats: np.ndarray, g_still: np.ndarray, g_still_quats: np.ndarray,
    on_means: np.ndarray, on_quats: np.ndarray, on_weights: np.ndarray, on_rows: np.ndarray,
) -> None:  # fmt: skip
    """Set the gradients; on_rows [chunks, 16 joints...] gets that of the live branch only."""
    room, count = len(joints.rows) // LANES * BLOCK, weights.shape[1]
    shares, signed, scratch = np.zeros(room, np.float32), np.zeros(room, np.float32), np.zeros(room, np.float32)
    blended, live, grad, transposed = (
        np.empty(LANES * BLOCK, np.float32), np.empty(LANES * BLOCK, np.float32),
        np.empty(LANES * BLOCK, np.float32), np.empty(LANES * BLOCK, np.float32),
    )  # fmt: skip
    position, orientation = np.zeros(LANES * BLOCK, np.float32), np.zeros(LANES * BLOCK, np.float32)
    near, far = np.zeros(LANES * BLOCK, np.float32), np.zeros(LANES * BLOCK, np.float32)
    near_orientation, far_orientation = np.zeros(LANES * BLOCK, np.float32), np.zeros(LANES * BLOCK, np.float32)
    while True:
        chunk = take_ticket(tickets)
        if chunk * CHUNK >= len(means):
            return
        for begin in range(chunk * CHUNK, min((chunk + 1) * CHUNK, len(means)), BLOCK):
            end = min(begin + BLOCK, len(means))
            _blend_block(begin, end, weights, joints, shares, signed, scratch, blended)
            read_columns(means, begin, end, position, BLOCK)
            read_columns(quats, begin, end, orientation, BLOCK)
            read_columns(g_live, begin, end, near, BLOCK)
            read_columns(g_still, begin, end, far, BLOCK)
            read_columns(g_live_quats, begin, end, near_orientation, BLOCK)
            read_columns(g_still_quats, begin, end, far_orientation, BLOCK)
            for lane in range(0, BLOCK, LANES):
                _grads(lane, blended, position, orientation, near, near_orientation, far, far_orientation, live, grad)
            write_columns(position, BLOCK, on_means, begin, end)
            write_columns(orientation, BLOCK, on_quats, begin, end)
            _share_back(joints, count, shares, signed, live, grad, scratch, transposed, on_rows[chunk])
            write_columns(shares, BLOCK, on_weights, begin, end)


def _tables(transforms: Tensor, quats: Tensor) -> Joints:
    """Collect the joints' numbers and signs."""
    count, joint_quats = len(quats), array(quats)
    rows = np.zeros((-(-count // LANES) * LANES, LANES), np.float32)
    rows[:count, :QUAT] = array(transforms)[:, :3].reshape(count, QUAT)
    rows[:count, QUAT:] = joint_quats
    opposed = joint_quats @ joint_quats.T < 0
    return Joints(rows.ravel(), np.where(opposed, np.float32(-1), np.float32(1)), bool(opposed.any()))


def skin_both(
    means: Tensor, quats: Tensor, weights: Tensor, transforms: Tensor, joint_quats: Tensor
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Skin rest positions [n, 3] and orientations [n, 4] of any length by joints; float32 on the CPU.

    Returns means and unit quats whose gradients reach the joints, then the same without gradients to the joints; they
    share memory, so none may be changed in place.
    """
    return _Skin.apply(means, quats, weights, transforms, joint_quats)


class _Skin(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any, means: Tensor, quats: Tensor, weights: Tensor, transforms: Tensor, joint_quats: Tensor
    ) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        ctx.joints = _tables(transforms, joint_quats)
        new_means, new_quats = (torch.empty(each.shape, dtype=torch.float32) for each in (means, quats))
        given = tuple(map(array, (means, quats, weights)))
        run_tickets(_forward, *given, ctx.joints, new_means.numpy(), new_quats.numpy())
        ctx.save_for_backward(means, quats, weights)
        return new_means, new_quats, new_means.detach(), new_quats.detach()  # the same memory

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor, ...]:
        given = tuple(map(array, ctx.saved_tensors))
        made = tuple(torch.empty(each.shape, dtype=torch.float32) for each in given)
        joints, chunks = given[2].shape[1], max(1, -(-len(given[0]) // CHUNK))
        on_rows = np.zeros((chunks, len(ctx.joints.rows)), np.float32)
        run_tickets(_backward, *given, ctx.joints, *map(array, grads), *(each.numpy() for each in made), on_rows)
        total = torch.from_numpy(on_rows.sum(axis=0)).view(-1, LANES)[:joints]
        on_transforms = torch.zeros(joints, 4, 4)
        on_transforms[:, :3] = total[:, :QUAT].view(joints, 3, 4)
        return *made, on_transforms, total[:, QUAT:].contiguous()
