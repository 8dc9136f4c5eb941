"""How far a guess's points are from those that the network read."""

from dataclasses import dataclass

import torch
from torch import Tensor

from rewild4d.priors.landmarks import LANDMARKS
from rewild4d.priors.learned.points import NAMES, ROOT
from rewild4d.priors.learned.reading import Reading

LEAST = 0.03
"""Least spread that a point is trusted to, in halves of the crop: the template's joints are no animal's."""
BONES = tuple(LANDMARKS[name][0] for name in NAMES)
ALONG = tuple(LANDMARKS[name][1] for name in NAMES)


@dataclass(frozen=True)
class PointEvidence:
    """A reading in the axes of the fit's working frame; fields as in `Reading`."""

    timesteps: Tensor
    rotations: Tensor
    centers: Tensor
    openings: Tensor
    points: Tensor
    spreads: Tensor

    @classmethod
    def of(cls, reading: Reading, working: Tensor) -> "PointEvidence":
        """Move a reading's cameras into the working frame, whose similarity to the world is ``working``, [4, 4]."""
        size = working[:3, 0].norm()
        axes = working[:3, :3] / size
        centers = (reading.centers.double() - working[:3, 3]) @ axes / size
        rotations = reading.world_to_view.double() @ axes
        return cls(
            reading.timesteps, rotations.float(), centers.float(), reading.openings, reading.points,
            reading.spreads.clamp_min(LEAST),
        )  # fmt: skip

    def distance(self, points: Tensor) -> Tensor:
        """Return the robust mean distance of points in the working frame from the reading, in spreads.

        Args:
            points: of `NAMES` at each time, [B, T, L, 3].

        Returns:
            [B].
        """
        seen = (points[:, self.timesteps] - self.centers[:, None]) @ self.rotations.transpose(-1, -2)
        depth = seen[..., ROOT, 2].mean(-1).clamp_min(1e-3)[..., None]
        scale = (self.openings[:, None] * depth)[..., None]
        away = seen / scale - self.points
        along = (seen[..., 2] - depth) / scale[..., 0] - self.points[..., 2]
        across = away[..., :2] / self.spreads[..., :1]
        squares = across.square().sum(-1) + (along / self.spreads[..., 1]).square()
        return ((1 + squares).sqrt() - 1).mean((-1, -2))


def indices() -> tuple[Tensor, Tensor]:
    """Return bone and share of its length of each of `NAMES`, int64 and float32, [L]."""
    return torch.tensor(BONES), torch.tensor(ALONG)
