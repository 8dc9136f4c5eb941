"""Blended skinning for both branches at once: one forward pass, and one backward pass that keeps their gradients apart.

Sixty-four Gaussians at a time: each number of theirs is a row, each Gaussian a lane, and what the joints share out is
a small matrix product. The twin in plain torch is `transforms.skin_points` and `skin_quats`, called once a branch.
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
from rewild4d.kernels.threads import run, thread_count
from rewild4d.ours.fused.quaternions import back_times, times, times_back, unit_lanes, unit_slope

SKINNING = Kernel(
    "skinning",
    "6c5e2f94d72b",
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
"""Gaussians a unit of work holds; gradients of the joints are summed over these, whatever the number of threads."""
QUAT = 12
"""Of a joint's sixteen numbers the first twelve are its transform, by rows, the others its rotation."""


class Joints(NamedTuple):
    """What the kernels need of the joints.

    Attributes:
        rows: sixteen numbers a joint, zero up to a multiple of sixteen joints, flat.
        signs: +1 or -1, by which a joint's rotation suits that of the leader, the joint of the largest weight
            (rows), [J, J].
        opposed: whether any sign is -1.
    """

    rows: Any
    signs: Any
    opposed: Any


@kernel
def _sign_block(begin: int, end: int, weights: np.ndarray, signs: np.ndarray, signed: np.ndarray) -> None:
    """Set signed [J, BLOCK] to the signs that suit each Gaussian's leader, the first of equal weights."""
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
    """Set the weights by rows, shares [J, BLOCK], and the Gaussians' sums of the joints' numbers, [16, BLOCK].

    Where signs differ `signed` becomes those of each Gaussian.
    """
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
    blended, place, turn = (
        np.empty(LANES * BLOCK, np.float32), np.zeros(LANES * BLOCK, np.float32), np.zeros(LANES * BLOCK, np.float32)
    )  # fmt: skip
    while True:
        begin = take_ticket(tickets) * BLOCK
        if begin >= len(means):
            return
        end = min(begin + BLOCK, len(means))
        _blend_block(begin, end, weights, joints, shares, signed, scratch, blended)
        read_columns(means, begin, end, place, BLOCK)
        read_columns(quats, begin, end, turn, BLOCK)
        for lane in range(0, BLOCK, LANES):
            x, y, z = load(place, lane), load(place, BLOCK + lane), load(place, 2 * BLOCK + lane)
            for i in range(3):
                a, b, c, d = four_rows(blended, 4 * i, lane)
                store(place, i * BLOCK + lane, fma(a, x, fma(b, y, fma(c, z, d))))
            turned = times(unit_lanes(four_rows(blended, QUAT, lane)), unit_lanes(four_rows(turn, 0, lane)))
            _store_column(turn, 0, lane, turned)
        write_columns(place, BLOCK, new_means, begin, end)
        write_columns(turn, BLOCK, new_quats, begin, end)


@inlined
def _slopes(
    lane: int, blended: np.ndarray, place: np.ndarray, turn: np.ndarray, g_live: np.ndarray, g_live_quats: np.ndarray,
    g_still: np.ndarray, g_still_quats: np.ndarray, live: np.ndarray, slope: np.ndarray,
) -> None:  # fmt: skip
    """Gradients of the blended numbers, from the live branch alone and from both, [16, BLOCK]; and those of the rest
    positions and orientations in place of them."""
    unit, rest = unit_lanes(four_rows(blended, QUAT, lane)), unit_lanes(four_rows(turn, 0, lane))
    g, h = four_rows(g_live_quats, 0, lane), four_rows(g_still_quats, 0, lane)
    both = g[0] + h[0], g[1] + h[1], g[2] + h[2], g[3] + h[3]
    _store_column(live, QUAT, lane, unit_slope(unit, times_back(g, rest)))
    _store_column(slope, QUAT, lane, unit_slope(unit, times_back(both, rest)))
    _store_column(turn, 0, lane, unit_slope(rest, back_times(unit, both)))
    x, y, z = load(place, lane), load(place, BLOCK + lane), load(place, 2 * BLOCK + lane)
    on_x, on_y, on_z = x - x, x - x, x - x
    for i in range(3):
        one = load(g_live, i * BLOCK + lane)
        other = one + load(g_still, i * BLOCK + lane)
        a, b, c, _ = four_rows(blended, 4 * i, lane)
        on_x, on_y, on_z = fma(other, a, on_x), fma(other, b, on_y), fma(other, c, on_z)
        _store_column(live, 4 * i, lane, (one * x, one * y, one * z, one))
        _store_column(slope, 4 * i, lane, (other * x, other * y, other * z, other))
    store(place, lane, on_x)
    store(place, BLOCK + lane, on_y)
    store(place, 2 * BLOCK + lane, on_z)


@kernel
def _share_back(
    joints: Joints, count: int, shares: np.ndarray, signed: np.ndarray, live: np.ndarray, slope: np.ndarray,
    scratch: np.ndarray, turned: np.ndarray, on_rows: np.ndarray,
) -> None:  # fmt: skip
    """Add to the gradient of the joints' numbers, and put that of the weights in place of the weights, [J, BLOCK]."""
    rows = (count + 7) // 8 * 8
    transpose(live, LANES, BLOCK, turned)
    if not joints.opposed:
        add_product(shares, 0, BLOCK, 1, turned, 0, LANES, BLOCK, on_rows, 0, LANES, rows, LANES)
        shares[: rows * BLOCK] = 0
        add_product(joints.rows, 0, LANES, 1, slope, 0, BLOCK, LANES, shares, 0, BLOCK, rows, BLOCK)
        return
    quats = turned.copy()
    for lane in range(BLOCK):
        turned[lane * LANES + QUAT : (lane + 1) * LANES] = 0
        quats[lane * LANES : lane * LANES + QUAT] = 0
    for i in range(0, rows * BLOCK, LANES):
        store(scratch, i, load(shares, i) * load(signed, i))
    add_product(shares, 0, BLOCK, 1, turned, 0, LANES, BLOCK, on_rows, 0, LANES, rows, LANES)
    add_product(scratch, 0, BLOCK, 1, quats, 0, LANES, BLOCK, on_rows, 0, LANES, rows, LANES)
    shares[: rows * BLOCK], scratch[: rows * BLOCK] = 0, 0
    add_product(joints.rows, 0, LANES, 1, slope, 0, BLOCK, QUAT, shares, 0, BLOCK, rows, BLOCK)
    add_product(joints.rows, QUAT, LANES, 1, slope, QUAT * BLOCK, BLOCK, LANES - QUAT, scratch, 0, BLOCK, rows, BLOCK)
    for i in range(0, rows * BLOCK, LANES):
        store(shares, i, fma(load(scratch, i), load(signed, i), load(shares, i)))


@kernel
def _backward(
    tickets: np.ndarray, means: np.ndarray, quats: np.ndarray, weights: np.ndarray, joints: Joints,
    g_live: np.ndarray, g_live_quats: np.ndarray, g_still: np.ndarray, g_still_quats: np.ndarray,
    on_means: np.ndarray, on_quats: np.ndarray, on_weights: np.ndarray, on_rows: np.ndarray,
) -> None:  # fmt: skip
    """Set the gradients; on_rows [chunks, 16 joints...] gets the live branch's alone."""
    room, count = len(joints.rows) // LANES * BLOCK, weights.shape[1]
    shares, signed, scratch = np.zeros(room, np.float32), np.zeros(room, np.float32), np.zeros(room, np.float32)
    blended, live, slope, turned = (
        np.empty(LANES * BLOCK, np.float32), np.empty(LANES * BLOCK, np.float32),
        np.empty(LANES * BLOCK, np.float32), np.empty(LANES * BLOCK, np.float32),
    )  # fmt: skip
    place, turn = np.zeros(LANES * BLOCK, np.float32), np.zeros(LANES * BLOCK, np.float32)
    near, far = np.zeros(LANES * BLOCK, np.float32), np.zeros(LANES * BLOCK, np.float32)
    near_turn, far_turn = np.zeros(LANES * BLOCK, np.float32), np.zeros(LANES * BLOCK, np.float32)
    while True:
        chunk = take_ticket(tickets)
        if chunk * CHUNK >= len(means):
            return
        for begin in range(chunk * CHUNK, min((chunk + 1) * CHUNK, len(means)), BLOCK):
            end = min(begin + BLOCK, len(means))
            _blend_block(begin, end, weights, joints, shares, signed, scratch, blended)
            read_columns(means, begin, end, place, BLOCK)
            read_columns(quats, begin, end, turn, BLOCK)
            read_columns(g_live, begin, end, near, BLOCK)
            read_columns(g_still, begin, end, far, BLOCK)
            read_columns(g_live_quats, begin, end, near_turn, BLOCK)
            read_columns(g_still_quats, begin, end, far_turn, BLOCK)
            for lane in range(0, BLOCK, LANES):
                _slopes(lane, blended, place, turn, near, near_turn, far, far_turn, live, slope)
            write_columns(place, BLOCK, on_means, begin, end)
            write_columns(turn, BLOCK, on_quats, begin, end)
            _share_back(joints, count, shares, signed, live, slope, scratch, turned, on_rows[chunk])
            write_columns(shares, BLOCK, on_weights, begin, end)


def _tables(transforms: Tensor, quats: Tensor) -> Joints:
    """The joints' numbers, and which rotations are opposed."""
    count, turns = len(quats), array(quats)
    rows = np.zeros((-(-count // LANES) * LANES, LANES), np.float32)
    rows[:count, :QUAT] = array(transforms)[:, :3].reshape(count, QUAT)
    rows[:count, QUAT:] = turns
    opposed = turns @ turns.T < 0
    return Joints(rows.ravel(), np.where(opposed, np.float32(-1), np.float32(1)), bool(opposed.any()))


def skin_both(
    means: Tensor, quats: Tensor, weights: Tensor, transforms: Tensor, joint_quats: Tensor
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Skinned positions and orientations, twice the same values; float32, CPU.

    Args:
        means: rest positions, [n, 3].
        quats: rest orientations, any length, [n, 4].
        weights: [n, J].
        transforms: rest -> posed, [J, 4, 4].
        joint_quats: their rotations, [J, 4].

    Returns:
        Means [n, 3] and unit quats [n, 4] whose gradients reach the joints, then two whose gradients do not, in the
        same memory: none may be changed in place.
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
        call = np.zeros(1, np.int64), *given, ctx.joints, new_means.numpy(), new_quats.numpy()
        run(_forward, [call] * thread_count())
        ctx.save_for_backward(means, quats, weights)
        return new_means, new_quats, new_means.detach(), new_quats.detach()  # the same memory

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *slopes: Tensor) -> tuple[Tensor, ...]:
        given = tuple(map(array, ctx.saved_tensors))
        made = tuple(torch.empty(each.shape, dtype=torch.float32) for each in given)
        joints, chunks = given[2].shape[1], max(1, -(-len(given[0]) // CHUNK))
        on_rows = np.zeros((chunks, len(ctx.joints.rows)), np.float32)
        call = (
            np.zeros(1, np.int64), *given, ctx.joints, *map(array, slopes), *(each.numpy() for each in made), on_rows
        )  # fmt: skip
        run(_backward, [call] * thread_count())
        total = torch.from_numpy(on_rows.sum(axis=0)).view(-1, LANES)[:joints]
        on_transforms = torch.zeros(joints, 4, 4)
        on_transforms[:, :3] = total[:, :QUAT].view(joints, 3, 4)
        return *made, on_transforms, total[:, QUAT:].contiguous()
