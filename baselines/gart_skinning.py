"""Skinning of GART: a voxel grid of the template's weights, a learned residual on it, and Gaussians posed by both."""

import torch
from torch import Tensor, nn

from rewild4d.baselines.common.splatting import Shape
from rewild4d.ours.canonical import Gaussians
from rewild4d.ours.config import Skinning
from rewild4d.ours.fused.field import RESIDUAL_FIELD, sample_grid
from rewild4d.ours.fused.skinning import GART_SKINNING, skin_both
from rewild4d.ours.losses.regularizers import tv_loss
from rewild4d.ours.skinning import build_field
from rewild4d.transforms import skin_points, skin_quats
from rewild4d.types import Prior

BEND = 1e-4
"""Huber threshold of the total variation."""


class ResidualField(nn.Module):
    """Sum of two voxel grids, the template's weights and a learned residual; not renormalised.

    Attributes:
        base: the template's weights in every voxel, x slowest, [R^3, J].
        residual: learned, [R^3, J].
    """

    base: Tensor

    def __init__(self, prior: Prior, config: Skinning) -> None:
        super().__init__()
        self.field = build_field(prior.vertices.float(), prior.weights.float(), prior.mirror.long(), config)
        self.field.requires_grad_(False)
        with torch.no_grad():
            self.register_buffer("base", self.field.probabilities())
        self.residual = nn.Parameter(torch.zeros_like(self.base))

    def forward(self, points: Tensor, variation: bool) -> tuple[Tensor, Tensor]:
        """Sample weights [n, J] at points [n, 3], without their gradient, and the residual's total variation.

        Args:
            points: in the object frame.
            variation: compute the mean over the axes of the mean absolute forward difference; else it is zero.
        """
        with torch.no_grad():
            base = self.field.sample(self.base, points)
        if not RESIDUAL_FIELD.takes(points, owner=self):
            return base + self.field.sample(self.residual, points), self._variation() if variation else points.sum() * 0
        cube = (points, self.field.origin, self.field.pitch, self.field.resolution)
        added, total = sample_grid(self.residual, *cube, BEND if variation else None)
        return base + added, total / BEND

    def still(self, points: Tensor) -> Tensor:
        """Sample weights without any gradient, [n, 3] -> [n, J]."""
        with torch.no_grad():
            return self.field.sample(self.base, points) + self.field.sample(self.residual, points)

    def norm(self) -> Tensor:
        """Return the mean norm of the residual over the voxels, scalar."""
        return (self.residual.square().sum(-1) + 1e-16).sqrt().mean()

    def _variation(self) -> Tensor:
        return tv_loss(self.residual, self.field.resolution, BEND) / BEND


def posed(own: Gaussians, weights: Tensor, quats: Tensor, transforms: Tensor) -> Shape:
    """Skin the canonical Gaussians.

    Args:
        own: canonical.
        weights: [n, J].
        quats: rotation of each joint, [J, 4].
        transforms: rest -> posed, [J, 4, 4].
    """
    scales = own.scales(own.scales_log())
    if GART_SKINNING.takes(own.means):
        return Shape(*skin_both(own.means, own.quats, weights, transforms, quats)[:2], scales)
    rest = nn.functional.normalize(own.quats, dim=-1)
    return Shape(skin_points(own.means, weights, transforms), skin_quats(rest, weights, quats), scales)
