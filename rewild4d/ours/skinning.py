"""Learnable skinning field: a voxel grid of logits, sampled trilinearly as probabilities."""

import numpy as np
import torch
from scipy.spatial import cKDTree
from torch import Tensor, nn

from rewild4d.ours.config import Skinning
from rewild4d.ours.fused.field import FIELD, sample_grid
from rewild4d.ours.losses.regularizers import tv_loss


class SkinningField(nn.Module):
    """Skinning weights everywhere in a cube around the rest shape (METHOD section 3).

    Trilinear mixtures of points of the simplex stay on the simplex, so sampled weights always sum to one.

    Attributes:
        logits: one row per voxel, x slowest, [R^3, J].
    """

    logits: nn.Parameter
    origin: Tensor
    pitch: Tensor
    mirror: Tensor
    flipped: Tensor

    def __init__(self, logits: Tensor, origin: Tensor, pitch: Tensor, mirror: Tensor, tied: bool) -> None:
        super().__init__()
        self.resolution = round(logits.shape[0] ** (1 / 3))
        self.tied = tied
        self.logits = nn.Parameter(logits.float().contiguous())
        self.register_buffer("origin", origin.float())
        self.register_buffer("pitch", pitch.float())
        self.register_buffer("mirror", mirror)
        rows = torch.arange(self.resolution**3).view(self.resolution, -1).flip(0).reshape(-1)
        self.register_buffer("flipped", rows, persistent=False)

    def probabilities(self) -> Tensor:
        """Return the weights of every voxel, [R^3, J]."""
        logits: Tensor = self.logits
        if self.tied:
            logits = 0.5 * (logits + logits[self.flipped][:, self.mirror])
        return logits.softmax(dim=-1)

    def sample_and_vary(self, probabilities: Tensor, points: Tensor, delta: float | None) -> tuple[Tensor, Tensor]:
        """Return weights of points as `sample`, and L_tv of the field (zero where ``delta`` is None)."""
        if FIELD.takes(probabilities, owner=self):
            return sample_grid(probabilities, points, self.origin, self.pitch, self.resolution, delta)
        weights = self.sample(probabilities, points)
        if delta is None:
            return weights, weights.new_zeros(())
        return weights, tv_loss(probabilities, self.resolution, delta)

    def sample(self, probabilities: Tensor, points: Tensor) -> Tensor:
        """Sample `probabilities` [R^3, J] at points [n, 3] clamped to the cube, without their gradient: weights [n,
        J]."""
        if FIELD.takes(probabilities, owner=self):
            return sample_grid(probabilities, points, self.origin, self.pitch, self.resolution)[0]
        rows, factors = trilinear(points.detach(), self.origin, self.pitch, self.resolution)
        chosen = probabilities.index_select(0, rows.flatten()).unflatten(0, rows.shape)
        return torch.einsum("nk,nkj->nj", factors, chosen)


def trilinear(points: Tensor, origin: Tensor, pitch: Tensor, resolution: int) -> tuple[Tensor, Tensor]:
    """Return rows (x slowest) and shares of the eight voxels around points [n, 3] clamped to a cube, both [n, 8]."""
    last = resolution - 1
    position = ((points - origin) / pitch).clamp(0, last)
    base = position.floor().clamp(max=last - 1)
    part = position - base
    x, y, z = (torch.stack((1 - part[:, axis], part[:, axis]), dim=-1) for axis in range(3))
    factors = torch.einsum("na,nb,nc->nabc", x, y, z).flatten(1)
    corners = torch.cartesian_prod(*[torch.arange(2, device=points.device)] * 3)
    x, y, z = (base.long()[:, None] + corners).unbind(-1)
    return (x * resolution + y) * resolution + z, factors


def cube_around(points: Tensor, margin: float, resolution: int) -> tuple[Tensor, Tensor]:
    """Return the first corner [3] and the pitch (scalar) of a cube of voxels around points [n, 3].

    Its half-size is ``margin`` times half their longest side.
    """
    low, high = points.amin(0), points.amax(0)
    half = margin * 0.5 * (high - low).max()
    center = 0.5 * (low + high)
    # The cube is centred on the symmetry plane, so that flipping rows is exactly the mirror.
    center = center * center.new_tensor((0.0, 1.0, 1.0))
    half = torch.maximum(half, points[:, 0].abs().max())
    return center - half, 2 * half / (resolution - 1)


def build_field(vertices: Tensor, weights: Tensor, mirror: Tensor, config: Skinning) -> SkinningField:
    """Spread the prior's skinning weights [n, J] over a cube around its rest shape [n, 3].

    Per voxel the inverse-distance mean of the nearest vertices' weights, then sweeps of neighbour averaging.
    """
    size = config.resolution
    origin, pitch = cube_around(vertices, config.margin, size)
    ticks = torch.arange(size, dtype=torch.float64) * pitch.double()
    grid = torch.cartesian_prod(ticks, ticks, ticks) + origin.double()
    count = min(config.neighbours, len(vertices))
    distance, nearest = cKDTree(vertices.double().numpy()).query(grid.numpy(), k=count)
    influence = 1.0 / np.clip(distance.reshape(-1, count), 1e-4, 1.0)
    influence /= influence.sum(-1, keepdims=True)
    start = np.einsum("vk,vkj->vj", influence, weights.double().numpy()[nearest.reshape(-1, count)])
    spread = _sweep(torch.from_numpy(start).view(size, size, size, -1), config)
    logits = (spread.reshape(size**3, -1) + config.floor).log()
    return SkinningField(logits, origin, pitch.repeat(3), mirror, config.tied)


def _sweep(field: Tensor, config: Skinning) -> Tensor:
    """Average each voxel with its six neighbours (itself beyond the border), rows kept on the simplex, [R, R, R, J]."""
    for _ in range(config.sweeps):
        total = torch.zeros_like(field)
        for axis in range(3):
            ahead = torch.cat((field.narrow(axis, 1, field.shape[axis] - 1), field.narrow(axis, -1, 1)), dim=axis)
            behind = torch.cat((field.narrow(axis, 0, 1), field.narrow(axis, 0, field.shape[axis] - 1)), dim=axis)
            total = total + ahead + behind
        field = config.keep * field + (1 - config.keep) / 6 * total
        field = field / field.sum(-1, keepdim=True)
    return field
