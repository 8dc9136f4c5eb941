"""Blended skinning for both branches at once: one forward pass, and one backward pass that keeps their gradients apart.

The twin in plain torch is `transforms.skin_points` and `skin_quats`, called once for each branch.
"""

from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from rewild4d.kernels.arrays import array
from rewild4d.kernels.compiling import inlined, kernel
from rewild4d.kernels.rows import sum_rows
from rewild4d.kernels.simd import LANES, fma, load, splat, store, take_ticket
from rewild4d.kernels.threads import run, thread_count
from rewild4d.ours.fused.quaternions import conjugate, times, unit_row, unit_slope

CHUNK = 1024
"""Gaussians a unit of work holds; gradients of the joints are summed over these, whatever the number of threads."""


@inlined
def _leader(weights: np.ndarray, n: int) -> int:
    """The joint of the largest weight, the first of equals."""
    best = 0
    for joint in range(1, weights.shape[1]):
        if weights[n, joint] > weights[n, best]:
            best = joint
    return best


@inlined
def _blend(weights: np.ndarray, n: int, leader: int, rows: np.ndarray, blended: np.ndarray) -> None:
    """The weighted sum of the joints' rows, with the signs that suit the leader."""
    joints = weights.shape[1]
    total = splat(np.float32(0))
    for joint in range(joints):
        total = fma(splat(weights[n, joint]), load(rows, (leader * joints + joint) * LANES), total)
    store(blended, 0, total)


@kernel
def _forward(
    tickets: np.ndarray, means: np.ndarray, quats: np.ndarray, weights: np.ndarray, rows: np.ndarray,
    new_means: np.ndarray, new_quats: np.ndarray,
) -> None:  # fmt: skip
    blended = np.empty(LANES, np.float32)
    while True:
        begin = take_ticket(tickets) * CHUNK
        if begin >= len(means):
            return
        for n in range(begin, min(begin + CHUNK, len(means))):
            _blend(weights, n, _leader(weights, n), rows, blended)
            x, y, z = means[n, 0], means[n, 1], means[n, 2]
            for i in range(3):
                new_means[n, i] = (
                    blended[4 * i] * x + blended[4 * i + 1] * y + blended[4 * i + 2] * z + blended[4 * i + 3]
                )
            turned = times(unit_row(blended[12:].reshape(1, 4), 0), unit_row(quats, n))
            for i in range(4):
                new_quats[n, i] = turned[i]


@kernel
def _backward(
    tickets: np.ndarray, means: np.ndarray, quats: np.ndarray, weights: np.ndarray, rows: np.ndarray,
    signs: np.ndarray, g_live: np.ndarray, g_live_quats: np.ndarray, g_still: np.ndarray, g_still_quats: np.ndarray,
    on_means: np.ndarray, on_quats: np.ndarray, on_weights: np.ndarray, on_rows: np.ndarray,
) -> None:  # fmt: skip
    """Set the gradients; on_rows [chunks, J x 16] gets the live branch's alone."""
    joints = weights.shape[1]
    blended, slope, live = np.empty(LANES, np.float32), np.empty(LANES, np.float32), np.empty(LANES, np.float32)
    products, sums = np.empty(joints * LANES, np.float32), np.empty(joints + LANES, np.float32)
    while True:
        chunk = take_ticket(tickets)
        if chunk * CHUNK >= len(means):
            return
        mine = on_rows[chunk]
        for n in range(chunk * CHUNK, min((chunk + 1) * CHUNK, len(means))):
            leader = _leader(weights, n)
            _blend(weights, n, leader, rows, blended)
            turn, rest = unit_row(blended[12:].reshape(1, 4), 0), unit_row(quats, n)
            g = g_live_quats[n, 0], g_live_quats[n, 1], g_live_quats[n, 2], g_live_quats[n, 3]
            on_live = unit_slope(turn, times(g, conjugate(rest)))
            both = (
                g[0] + g_still_quats[n, 0], g[1] + g_still_quats[n, 1],
                g[2] + g_still_quats[n, 2], g[3] + g_still_quats[n, 3],
            )  # fmt: skip
            on_turn = unit_slope(turn, times(both, conjugate(rest)))
            on_rest = unit_slope(rest, times(conjugate(turn), both))
            for i in range(4):
                live[12 + i], slope[12 + i], on_quats[n, i] = on_live[i], on_turn[i], on_rest[i]
            for i in range(3):
                on_means[n, i] = 0
            for i in range(3):
                one, other = g_live[n, i], g_live[n, i] + g_still[n, i]
                for j in range(3):
                    live[4 * i + j], slope[4 * i + j] = one * means[n, j], other * means[n, j]
                    on_means[n, j] += other * blended[4 * i + j]
                live[4 * i + 3], slope[4 * i + 3] = one, other
            by_weight, by_row = load(slope, 0), load(live, 0)
            for joint in range(joints):
                pair = (leader * joints + joint) * LANES
                store(products, joint * LANES, by_weight * load(rows, pair))
                share = splat(weights[n, joint]) * load(signs, pair)
                store(mine, joint * LANES, fma(by_row, share, load(mine, joint * LANES)))
            sum_rows(products, joints, sums, 0)
            for joint in range(joints):
                on_weights[n, joint] = sums[joint]


def _tables(transforms: Tensor, quats: Tensor) -> tuple[np.ndarray, np.ndarray]:
    """Rows (twelve of the matrix, four of the rotation) and their signs, for each leader and joint, [J, J, 16]."""
    joints = len(quats)
    rows = torch.cat((transforms.detach()[:, :3].reshape(joints, 12), quats.detach()), dim=1)
    signs = torch.ones(joints, joints, LANES)
    opposite = quats.detach() @ quats.detach().T < 0
    signs[..., 12:] = torch.where(opposite, -1.0, 1.0)[..., None]
    return (signs * rows).numpy().ravel(), signs.numpy().ravel()


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
        Means [n, 3] and unit quats [n, 4] whose gradients reach the joints, then two whose gradients do not.
    """
    return _Skin.apply(means, quats, weights, transforms, joint_quats)


class _Skin(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any, means: Tensor, quats: Tensor, weights: Tensor, transforms: Tensor, joint_quats: Tensor
    ) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        rows, signs = _tables(transforms, joint_quats)
        new_means, new_quats = torch.empty_like(means), torch.empty_like(quats)
        given = tuple(map(array, (means, quats, weights)))
        call = np.zeros(1, np.int64), *given, rows, new_means.numpy(), new_quats.numpy()
        run(_forward, [call] * thread_count())
        ctx.save_for_backward(means, quats, weights)
        ctx.tables = rows, signs
        return new_means, new_quats, new_means.detach(), new_quats.detach()  # the same memory

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *slopes: Tensor) -> tuple[Tensor, ...]:
        given = tuple(map(array, ctx.saved_tensors))
        made = tuple(torch.empty(each.shape) for each in given)
        joints, chunks = given[2].shape[1], max(1, -(-len(given[0]) // CHUNK))
        on_rows = np.zeros((chunks, joints * LANES), np.float32)
        call = (
            np.zeros(1, np.int64), *given, *ctx.tables, *map(array, slopes), *(each.numpy() for each in made),
            on_rows,
        )  # fmt: skip
        run(_backward, [call] * thread_count())
        total = torch.from_numpy(on_rows.sum(axis=0)).view(joints, LANES)
        on_transforms = torch.zeros(joints, 4, 4)
        on_transforms[:, :3] = total[:, :12].view(joints, 3, 4)
        return *made, on_transforms, total[:, 12:].contiguous()
