"""Regularizers: total variation of the skinning field, compact parts, smooth normals, and a skeleton's."""

import math
from collections.abc import Sequence

import numpy as np
import torch
from scipy.spatial import cKDTree
from torch import Tensor
from torch.nn.functional import huber_loss

from rewild4d.kernels import gpu
from rewild4d.ours.canonical import Posed
from rewild4d.ours.fused.compactness import COMPACTNESS, LEAST_MASS, compactness
from rewild4d.ours.fused.normals import LEAST_COVER, NORMALS, disagreement, smallest_axes
from rewild4d.ours.pose import Pose, aligned
from rewild4d.rasterizer import rasterize
from rewild4d.transforms import constant, look_at, quat_multiply, quat_to_matrix
from rewild4d.types import OBJECT_DIAGONAL


def tv_loss(probabilities: Tensor, resolution: int, delta: float) -> Tensor:
    """Compute L_tv (paper, "Geometric Regularization") of a field [R^3, J]: the mean over the axes of the mean Huber
    function of forward differences.

    The Huber function is x^2 / 2 inside delta, delta (|x| - delta / 2) outside.
    """
    grid = probabilities.view(resolution, resolution, resolution, -1)
    terms = [
        huber_loss(grid.narrow(axis, 1, resolution - 1), grid.narrow(axis, 0, resolution - 1), delta=delta)
        for axis in range(3)
    ]
    return torch.stack(terms).mean()


def compact_loss(clouds: Sequence[Tensor], weights: Tensor, alpha: float) -> Tensor:
    """Compute L_compact (paper, "Geometric Regularization"), the mean over clouds of the mean over parts of gamma_j
    times the two smaller eigenvalues of the part's covariance.

    gamma_j = exp(-alpha Omega_j / max Omega) of the masses Omega_j = sum_i w_ij. The eigenvalues are
    tr C - v^T C v with v the top eigenvector of the detached C: exactly their gradient, and defined where the two
    coincide. The weights get no gradient: it would move them away from a part instead of drawing the part together.

    Args:
        clouds: centres, canonical and posed, [n, 3] each.
        weights: skinning weights w, [n, J].
        alpha: how much a large part, such as the torso, counts less.
    """
    if COMPACTNESS.takes(*clouds):
        return compactness(clouds, weights, alpha)
    mass = weights.detach().sum(0).clamp_min(LEAST_MASS)
    gamma = (-alpha * mass / mass.max()).exp()
    share = weights.detach() / mass
    losses = []
    for points in clouds:
        center = share.T @ points
        outer = (points[:, :, None] * points[:, None, :]).flatten(1)
        covariance = (share.T @ outer).view(-1, 3, 3) - center[:, :, None] * center[:, None, :]
        top = top_axes(covariance.detach())
        trace = covariance.diagonal(dim1=1, dim2=2).sum(-1)
        losses.append((gamma * (trace - torch.einsum("ja,jab,jb->j", top, covariance, top))).mean())
    return torch.stack(losses).mean()


def top_axes(matrices: Tensor) -> Tensor:
    """Return the unit eigenvectors of the largest eigenvalues of positive matrices, without gradients, [J, 3, 3] -> [J,
    3].

    On a GPU by squaring them again and again, since `eigh` waits for it: where two eigenvalues are closer than one in
    ten thousand, the direction is between theirs.
    """
    if matrices.is_cpu:
        return torch.linalg.eigh(matrices)[1][..., -1]
    if gpu.on_gpu(matrices):
        return gpu.top_axes(matrices)
    power = matrices.double()
    for _ in range(gpu.SQUARINGS):
        power = power / power.diagonal(dim1=1, dim2=2).sum(-1)[:, None, None].clamp_min(1e-300)
        power = power @ power
    best = power.diagonal(dim1=1, dim2=2).argmax(-1)[:, None, None].expand(-1, 3, 1)
    return torch.nn.functional.normalize(power.gather(-1, best)[..., 0], dim=-1, eps=1e-300).to(matrices)


def random_direction(generator: torch.Generator) -> Tensor:
    """Draw the direction of L_smooth's viewpoint: azimuth in [0, 360), elevation in [-10, 60) degrees, [3]."""
    azimuth, elevation = torch.rand(2, generator=generator).tolist()
    azimuth, elevation = 2 * math.pi * azimuth, math.radians(-10 + 70 * elevation)
    return torch.tensor(
        (math.cos(elevation) * math.sin(azimuth), math.sin(elevation), math.cos(elevation) * math.cos(azimuth))
    )


def smooth_loss(posed: Posed, opacities: Tensor, size: int, direction: Tensor) -> Tensor:
    """Compute L_smooth (paper, "Geometric Regularization"): how far neighbouring pixels of a rendered normal map,
    ``size`` pixels wide, disagree, summed over the two axes.

    A Gaussian's normal is the axis of its smallest scale, pointing to the camera. Only the normals get gradients.

    Args:
        posed: Gaussians.
        opacities: [n].
        size: side of the normal map in pixels.
        direction: from the animal to the viewpoint, unit, [3].
    """
    means, log_scales = posed.means.detach(), posed.log_scales.detach()
    center = means.mean(0)
    # Focal length 2 sides and a distance of 2.4 diagonals show the whole animal from every side.
    eye = center + 2.4 * OBJECT_DIAGONAL * direction.to(means)
    world_to_camera = look_at(eye, center, constant((0.0, 1.0, 0.0), means))
    focal = constant((2.0 * size, 0.0, size / 2, 0.0, 2.0 * size, size / 2, 0.0, 0.0, 1.0), means).view(3, 3)
    image, alpha, _ = rasterize(
        means, posed.quats.detach(), log_scales.exp(), opacities.detach(),
        _normals(posed.quats, log_scales, means, eye), world_to_camera[None], focal[None], size, size,
    )  # fmt: skip
    return _disagreement(image[0], alpha[0, 0].detach())


def _normals(quats: Tensor, log_scales: Tensor, means: Tensor, eye: Tensor) -> Tensor:
    """Return the axis of each Gaussian's smallest scale, pointing to ``eye`` [3], [n, 3]."""
    if NORMALS.takes(quats):
        return smallest_axes(quats, log_scales, means, eye)
    if gpu.on_gpu(quats):
        return gpu.smallest_axes(quats, log_scales, means, eye)
    axis = log_scales.argmin(-1)[:, None, None].expand(-1, 3, 1)
    normals = quat_to_matrix(quats).gather(-1, axis)[..., 0]
    towards = ((eye - means) * normals.detach()).sum(-1, keepdim=True)
    return torch.where(towards < 0, -normals, normals)


def _disagreement(image: Tensor, matte: Tensor) -> Tensor:
    """Sum over both axes the mean of 1 - |cos| between neighbouring pixels' vectors [3, h, w], weighted by both mattes
    [h, w]."""
    if NORMALS.takes(image):
        return disagreement(image, matte)
    # torch's own norm over the channels takes longer than the rest of this function.
    field = image / (image.square().sum(0) + 1e-24).sqrt()
    lacking = image.new_zeros(())
    for axis, length in ((0, matte.shape[0] - 1), (1, matte.shape[1] - 1)):
        agree = (field.narrow(axis + 1, 1, length) * field.narrow(axis + 1, 0, length)).sum(0).abs()
        both = matte.narrow(axis, 1, length) * matte.narrow(axis, 0, length)
        lacking = lacking + (both * (1 - agree)).sum() / (both.sum() + LEAST_COVER)
    return lacking


def limit_loss(pose: Pose, parents: Tensor, degrees: float) -> Tensor:
    """Compute the mean squared excess of cos(half the angle of a bone to its parent) below that of ``degrees``."""
    relative = (pose.quats * pose.quats[:, parents.clamp_min(0)]).sum(-1).abs()
    return _mean_below(parents, (math.cos(math.radians(degrees) / 2) - relative).clamp_min(0).square())


def attach_loss(transforms: Tensor, pivots: Tensor, parents: Tensor) -> Tensor:
    """Compute the mean squared gap between a joint and its parent's copy of it, over the squared diagonal."""
    gaps = joint_gaps(transforms, pivots, parents).square().sum(-1)
    return _mean_below(parents, gaps) / OBJECT_DIAGONAL**2


def _mean_below(parents: Tensor, values: Tensor) -> Tensor:
    """Return the mean of values [B, J] of joints that have a parent, 0 where none has; nothing looks at a number."""
    below = (parents >= 0).to(values)
    return (values @ below).mean() / below.sum().clamp_min(1)


def joint_gaps(transforms: Tensor, pivots: Tensor, parents: Tensor) -> Tensor:
    """Return each joint's position relative to its parent's copy, zero for a root, [B, J, 3]."""
    carrier = torch.where(parents >= 0, parents, torch.arange(len(parents), device=parents.device))
    pivot = torch.nn.functional.pad(pivots, (0, 1), value=1.0)[..., None]
    return ((transforms - transforms[:, carrier]) @ pivot)[..., :3, 0]


def sagittal_losses(
    pose: Pose, transforms: Tensor, pivots: Tensor, parents: Tensor, mirror: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """Compute mean rotations of bones out of the planes along the body, and mean gaps of limbs across it.

    Rotations within such a plane are about x. Limbs are the bones that have a counterpart on the other side.

    Returns:
        Squared y and z of the quaternion against the parent, of limbs and of other bones; squared x of the limbs' gaps
            (`joint_gaps`) over the squared diagonal.
    """
    limbs = (mirror != torch.arange(len(mirror), device=mirror.device)).to(pose.quats)
    rest = constant((1.0, 0.0, 0.0, 0.0), pose.quats)
    above = torch.where((parents >= 0)[:, None], pose.quats[:, parents.clamp_min(0)], rest)
    local = quat_multiply(above * constant((1.0, -1.0, -1.0, -1.0), above), pose.quats)
    out = local[..., 2:].square().sum(-1)
    sideways = (joint_gaps(transforms, pivots, parents)[..., 0] / OBJECT_DIAGONAL).square()
    of_limbs, others = limbs / limbs.sum().clamp_min(1), (1 - limbs) / (1 - limbs).sum().clamp_min(1)
    return (out @ of_limbs).mean(), (out @ others).mean(), (sideways @ of_limbs).mean()


def temporal_loss(pose: Pose, gaps: Tensor) -> Tensor:
    """Compute the mean squared second difference, a frame squared, of rotations and shifts over triples of frames,
    B = 3 k, ``gaps`` [k, 2] frames apart."""
    quats, shifts = pose.quats.unflatten(0, (-1, 3)), pose.shifts.unflatten(0, (-1, 3))
    first, second = gaps.to(quats).unbind(-1)
    a, b, c = 2 / (first * (first + second)), -2 / (first * second), 2 / (second * (first + second))
    a, b, c = (each[:, None, None] for each in (a, b, c))
    middle = quats[:, 1]
    bend = a * aligned(quats[:, 0], middle) + b * middle + c * aligned(quats[:, 2], middle)
    swerve = (a * shifts[:, 0] + b * shifts[:, 1] + c * shifts[:, 2]) / OBJECT_DIAGONAL
    return bend.square().sum(-1).mean() + swerve.square().sum(-1).mean()


def still_loss(pose: Pose, step: float, gaps: Tensor) -> Tensor:
    """Compute the mean of s v^2 / (v^2 + s^2) over steps v, a frame, of rotations within triples of frames, B = 3 k,
    ``gaps`` [k, 2] frames apart, plus that of shifts.

    Steps much longer than s cost s and get no gradient; slow drift is held still (Geman and McClure's function).
    """
    quats, shifts = pose.quats.unflatten(0, (-1, 3)), pose.shifts.unflatten(0, (-1, 3))
    apart = gaps.to(quats)[..., None, None]
    rotated = (quats[:, 1:] - aligned(quats[:, :-1], quats[:, 1:])) / apart
    moved = (shifts[:, 1:] - shifts[:, :-1]) / (OBJECT_DIAGONAL * apart)
    squares = torch.stack([each.square().sum(-1) for each in (rotated, moved)])
    return 2 * step * (squares / (squares + step**2)).mean()


def neighbours(points: Tensor, count: int) -> Tensor:
    """Return indices of the nearest other points, [n, 3] -> [n, min(count, n - 1)]."""
    positions = points.detach().cpu().double().numpy()
    _, index = cKDTree(positions).query(positions, k=list(range(1, min(count, len(positions) - 1) + 2)))
    return torch.from_numpy(np.ascontiguousarray(index[:, 1:])).to(points.device)


def nearest_rows(points: Tensor, queries: Tensor) -> Tensor:
    """Return the index of the nearest of points [m, 3] for each query, [n, 3] -> [n]."""
    tree = cKDTree(points.detach().cpu().double().numpy())
    return torch.from_numpy(tree.query(queries.detach().cpu().double().numpy())[1]).to(queries.device)


def rigid_loss(canonical: Tensor, deformed: Tensor, near: Tensor) -> Tensor:
    """Compute the mean change of distance to canonical neighbours ``near`` [n, k] (as isometric as possible)."""
    rest, moved = (squared_lengths(points, near) for points in (canonical.detach(), deformed))
    return ((moved + 1e-12).sqrt() - rest.sqrt()).abs().mean()


def squared_lengths(points: Tensor, near: Tensor) -> Tensor:
    """Return squared distances from points [n, 3] to those of rows ``near`` [n, k], [k, n]."""
    columns = points.t().contiguous()  # gathers and sums along rows of n are twice as fast as along rows of 3
    ends = columns.index_select(1, near.t().flatten()).view(3, near.shape[1], len(points))
    return (ends - columns[:, None]).square().sum(0)


def relative_angles(quats: Tensor, parents: Tensor) -> Tensor:
    """Compute each bone's rotation against its parent (rest for a root) in degrees, [..., J, 4] -> [..., J]."""
    conjugate = quats * quats.new_tensor((1.0, -1.0, -1.0, -1.0))
    above = torch.where(
        (parents >= 0)[:, None], conjugate[..., parents.clamp_min(0), :], quats.new_tensor((1.0, 0, 0, 0))
    )
    relative = quat_multiply(above, quats)
    return torch.rad2deg(2 * torch.atan2(relative[..., 1:].norm(dim=-1), relative[..., 0].abs()))
