"""Poses as transforms, with the skeleton's regularizers: a few hundred numbers, one thread.

Each loss is computed with its gradient; the backward pass scales it.
"""

from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from rewild4d.kernels.arrays import array
from rewild4d.kernels.compiling import inlined, kernel
from rewild4d.kernels.switch import Kernel
from rewild4d.ours.fused.quaternions import dot, rotation, rotation_grad, side, unit, unit_grad

POSTURE = Kernel(
    "posture", "193d46c018c5", "rewild4d.ours.losses.skeleton:posture", "rewild4d.ours.losses.skeleton:skeleton_losses"
)


class Weights(NamedTuple):
    """Weights and constants of the pose regularizers."""

    limit: float  # of the joint limits
    limb_plane: float  # of limb rotations out of the planes along the body
    body_plane: float  # of the same of other bones
    sideways: float  # of the gaps of limbs across the body
    cosine: float  # of half the limit angle
    attach: float  # of the gaps between a joint and its parent
    temporal: float  # of second differences over triples; 0 without triples
    still: float  # of the steps between neighbours in triples; 0 without triples
    step: float  # rotation or shift that separates drift from motion
    unit: float  # length that distances are divided by


@inlined
def _quat(quats: np.ndarray, item: int, joint: int) -> tuple:
    q = quats[item, joint]
    return np.float64(q[0]), np.float64(q[1]), np.float64(q[2]), np.float64(q[3])


@inlined
def _add(grad: tuple, target: np.ndarray) -> None:
    for i in range(4):
        target[i] += grad[i]


@kernel
def _limits(quats: np.ndarray, parents: np.ndarray, weight: float, cosine: float, on_quats: np.ndarray) -> float:
    """Compute the mean squared excess of a cosine over that of half the angle to the parent; add gradients."""
    count = len(quats) * max(1, (parents >= 0).sum())
    total = 0.0
    for item in range(len(quats)):
        for joint in range(len(parents)):
            above = parents[joint]
            if above < 0:
                continue
            one, other = _quat(quats, item, joint), _quat(quats, item, above)
            alike = dot(one, other)
            excess = cosine - abs(alike)
            if excess > 0:
                total += excess * excess
                grad = -2 * weight / count * excess * np.sign(alike)
                for i in range(4):
                    on_quats[item, joint, i] += grad * other[i]
                    on_quats[item, above, i] += grad * one[i]
    return weight * total / count


@kernel
def _gaps(
    quats: np.ndarray, shifts: np.ndarray, pivots: np.ndarray, parents: np.ndarray, mirror: np.ndarray,
    weights: Weights, on_quats: np.ndarray, on_shifts: np.ndarray,
) -> float:  # fmt: skip
    """Compute the weighted mean squared gaps between joints and their parents' copies, and x of limbs' gaps; add
    gradients."""
    limbs, square = (mirror != np.arange(len(mirror))).sum(), weights.unit * weights.unit
    share = weights.attach / (len(quats) * max(1, (parents >= 0).sum()) * square)
    sideways = weights.sideways / (len(quats) * max(1, limbs) * square)
    total, on_matrix = 0.0, np.empty((3, 3))
    for item in range(len(quats)):
        for joint in range(len(parents)):
            above = parents[joint]
            if above < 0:
                continue
            quat = unit(_quat(quats, item, above))
            rows = rotation(quat)
            arm = (
                np.float64(pivots[joint, 0]) - pivots[above, 0], np.float64(pivots[joint, 1]) - pivots[above, 1],
                np.float64(pivots[joint, 2]) - pivots[above, 2],
            )  # fmt: skip
            for i in range(3):
                row = rows[i]
                moved = row[0] * arm[0] + row[1] * arm[1] + row[2] * arm[2]
                gap = arm[i] + np.float64(shifts[item, joint, i]) - shifts[item, above, i] - moved
                weight = share + (sideways if i == 0 and mirror[joint] != joint else 0.0)
                total += weight * gap * gap
                grad = 2 * weight * gap
                on_shifts[item, joint, i] += grad
                on_shifts[item, above, i] -= grad
                for j in range(3):
                    on_matrix[i, j] = -grad * arm[j]
            _add(unit_grad(quat, rotation_grad(quat, on_matrix)), on_quats[item, above])
    return total


@kernel
def _out_of_plane(
    quats: np.ndarray, parents: np.ndarray, mirror: np.ndarray, weights: Weights, on_quats: np.ndarray
) -> float:
    """Compute the weighted mean squared y and z of rotations against the parent, of limbs and others; add gradients."""
    limbs = (mirror != np.arange(len(mirror))).sum()
    of_limb = weights.limb_plane / (len(quats) * max(1, limbs))
    of_body = weights.body_plane / (len(quats) * max(1, len(mirror) - limbs))
    total = 0.0
    for item in range(len(quats)):
        for joint in range(len(parents)):
            above, share = parents[joint], of_limb if mirror[joint] != joint else of_body
            a, b, c, d = _quat(quats, item, joint)
            w, x, y, z = _quat(quats, item, above) if above >= 0 else (1.0, 0.0, 0.0, 0.0)
            # y and z of conj(above) times own
            p, q = w * c - y * a - z * b + x * d, w * d - z * a - x * c + y * b
            total += share * (p * p + q * q)
            _add(_combined(2 * share * p, (-y, -z, w, x), 2 * share * q, (-z, y, -x, w)), on_quats[item, joint])
            if above >= 0:
                _add(_combined(2 * share * p, (c, d, -a, -b), 2 * share * q, (d, -c, b, -a)), on_quats[item, above])
    return total


@inlined
def _combined(p: float, a: tuple, q: float, b: tuple) -> tuple:
    return p * a[0] + q * b[0], p * a[1] + q * b[1], p * a[2] + q * b[2], p * a[3] + q * b[3]


@kernel
def _second_differences(
    quats: np.ndarray, shifts: np.ndarray, gaps: np.ndarray, weight: float, unit: float, on_quats: np.ndarray,
    on_shifts: np.ndarray,
) -> float:  # fmt: skip
    """Compute the mean squared second difference, a frame squared, of rotations and shifts over triples; add
    gradients."""
    joints, total = quats.shape[1], 0.0
    share = 3 * weight / (len(quats) * joints)
    by_length = share / (unit * unit)
    for item in range(1, len(quats), 3):
        first, second = gaps[item // 3, 0], gaps[item // 3, 1]
        a, b, c = 2 / (first * (first + second)), -2 / (first * second), 2 / (second * (first + second))
        for joint in range(joints):
            middle = _quat(quats, item, joint)
            before, after = _quat(quats, item - 1, joint), _quat(quats, item + 1, joint)
            one, other = side(before, middle), side(after, middle)
            for i in range(4):
                bend = a * one * before[i] + c * other * after[i] + b * middle[i]
                total += share * bend * bend
                on_quats[item - 1, joint, i] += 2 * share * a * one * bend
                on_quats[item + 1, joint, i] += 2 * share * c * other * bend
                on_quats[item, joint, i] += 2 * share * b * bend
            for i in range(3):
                swerve = a * shifts[item - 1, joint, i] + c * shifts[item + 1, joint, i] + b * shifts[item, joint, i]
                total += by_length * swerve * swerve
                on_shifts[item - 1, joint, i] += 2 * by_length * a * swerve
                on_shifts[item + 1, joint, i] += 2 * by_length * c * swerve
                on_shifts[item, joint, i] += 2 * by_length * b * swerve
    return total


@kernel
def _steps(
    quats: np.ndarray, shifts: np.ndarray, gaps: np.ndarray, weight: float, step: float, unit: float,
    on_quats: np.ndarray, on_shifts: np.ndarray,
) -> float:  # fmt: skip
    """Compute the mean of s v^2 / (v^2 + s^2) over steps v, a frame, of rotations and of shifts in triples; add
    gradients."""
    joints, square, total = quats.shape[1], step * step, 0.0
    share = 3 * weight * step / (2 * len(quats) * joints)
    for item in range(len(quats)):
        if item % 3 == 2:
            continue
        gap = gaps[item // 3, item % 3]
        length = unit * gap
        for joint in range(joints):
            one, other = _quat(quats, item, joint), _quat(quats, item + 1, joint)
            same = side(one, other)
            rotated, moved = 0.0, 0.0
            for i in range(4):
                rotated += ((other[i] - same * one[i]) / gap) ** 2
            for i in range(3):
                moved += ((np.float64(shifts[item + 1, joint, i]) - shifts[item, joint, i]) / length) ** 2
            total += share * (rotated / (rotated + square) + moved / (moved + square))
            by_rotation = 2 * share * square / ((rotated + square) * gap) ** 2
            by_shift = 2 * share * square / ((moved + square) * length) ** 2
            for i in range(4):
                grad = by_rotation * (other[i] - same * one[i])
                on_quats[item + 1, joint, i] += grad
                on_quats[item, joint, i] -= same * grad
            for i in range(3):
                grad = by_shift * (np.float64(shifts[item + 1, joint, i]) - shifts[item, joint, i])
                on_shifts[item + 1, joint, i] += grad
                on_shifts[item, joint, i] -= grad
    return total


@kernel
def _regularise(
    quats: np.ndarray, shifts: np.ndarray, pivots: np.ndarray, parents: np.ndarray, mirror: np.ndarray,
    weights: Weights, gaps: np.ndarray, on_quats: np.ndarray, on_shifts: np.ndarray,
) -> float:  # fmt: skip
    """Return the weighted sum of all regularizers; add their gradients."""
    total = 0.0
    if weights.limit:
        total += _limits(quats, parents, weights.limit, weights.cosine, on_quats)
    if weights.attach or weights.sideways:
        total += _gaps(quats, shifts, pivots, parents, mirror, weights, on_quats, on_shifts)
    if weights.limb_plane or weights.body_plane:
        total += _out_of_plane(quats, parents, mirror, weights, on_quats)
    if weights.temporal:
        total += _second_differences(quats, shifts, gaps, weights.temporal, weights.unit, on_quats, on_shifts)
    if weights.still:
        total += _steps(quats, shifts, gaps, weights.still, weights.step, weights.unit, on_quats, on_shifts)
    return total


@kernel
def _select(
    quats: np.ndarray, shifts: np.ndarray, features: np.ndarray, rows: np.ndarray, pivots: np.ndarray,
    own_quats: np.ndarray, own_shifts: np.ndarray, own_features: np.ndarray, transforms: np.ndarray,
) -> None:  # fmt: skip
    """Select rows of the poses, and set their transforms."""
    for k in range(len(rows)):
        item = rows[k]
        own_quats[k], own_shifts[k], own_features[k] = quats[item], shifts[item], features[item]
        for joint in range(len(pivots)):
            matrix, matrix_rows = transforms[k, joint], rotation(unit(_quat(quats, item, joint)))
            for i in range(3):
                row, position = matrix_rows[i], np.float64(pivots[joint, i]) + shifts[item, joint, i]
                for j in range(3):
                    position -= row[j] * pivots[joint, j]
                matrix[i, 0], matrix[i, 1], matrix[i, 2], matrix[i, 3] = row[0], row[1], row[2], position
            matrix[3, 0], matrix[3, 1], matrix[3, 2], matrix[3, 3] = 0, 0, 0, 1


@kernel
def _select_back(
    quats: np.ndarray, rows: np.ndarray, pivots: np.ndarray, g_quats: np.ndarray, g_shifts: np.ndarray,
    g_features: np.ndarray, g_transforms: np.ndarray, on_quats: np.ndarray, on_shifts: np.ndarray,
    on_features: np.ndarray,
) -> None:  # fmt: skip
    """Add the gradients of `_select`."""
    on_matrix = np.empty((3, 3))
    for k in range(len(rows)):
        item = rows[k]
        on_quats[item] += g_quats[k]
        on_shifts[item] += g_shifts[k]
        on_features[item] += g_features[k]
        for joint in range(len(pivots)):
            quat, g = unit(_quat(quats, item, joint)), g_transforms[k, joint]
            for i in range(3):
                on_shifts[item, joint, i] += g[i, 3]
                for j in range(3):
                    on_matrix[i, j] = g[i, j] - np.float64(g[i, 3]) * pivots[joint, j]
            _add(unit_grad(quat, rotation_grad(quat, on_matrix)), on_quats[item, joint])


def posture_and_losses(
    quats: Tensor,
    shifts: Tensor,
    features: Tensor,
    rows: list[int],
    pivots: Tensor,
    parents: Tensor,
    mirror: Tensor,
    weights: Weights,
    gaps: Tensor | None,
) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    """Select rows of poses with their transforms [k, J, 4, 4], and sum the regularizers of all; float32 on the CPU."""
    between = np.ones((0, 2)) if gaps is None else gaps.numpy()
    return _Posture.apply(quats, shifts, features, rows, pivots, parents, mirror, weights, between)


class _Posture(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any, quats: Tensor, shifts: Tensor, features: Tensor, rows: list[int], pivots: Tensor, parents: Tensor,
        mirror: Tensor, weights: Weights, gaps: np.ndarray,
    ) -> tuple[Tensor, ...]:  # fmt: skip
        joints, chosen = len(pivots), np.array(rows, np.int64)
        all_quats, all_shifts, centers = array(quats), array(shifts), pivots.numpy()
        sizes = ((4,), (3,), (features.shape[2],), (4, 4))
        made = tuple(np.empty((len(rows), joints, *size), np.float32) for size in sizes)
        _select(all_quats, all_shifts, array(features), chosen, centers, *made)
        grads = np.zeros(all_quats.shape), np.zeros(all_shifts.shape)
        total = _regularise(all_quats, all_shifts, centers, parents.numpy(), mirror.numpy(), weights, gaps, *grads)
        ctx.given, ctx.grads, ctx.size = (all_quats, chosen, centers), grads, features.shape
        return tuple(map(torch.from_numpy, (*made, np.array(total, np.float32))))

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor | None, ...]:
        scale, on_features = grads[4].item(), np.zeros(ctx.size, np.float32)
        on_quats, on_shifts = (grad * scale for grad in ctx.grads)
        _select_back(*ctx.given, *map(array, grads[:4]), on_quats, on_shifts, on_features)
        made = (on_quats.astype(np.float32), on_shifts.astype(np.float32), on_features)
        return *map(torch.from_numpy, made), *[None] * 6
