"""Poses of GART: a rotation per joint and frame along a chain, a translation per frame, and their interpolation."""

import torch
from torch import Tensor, nn

from rewild4d.priors.kinematics import depth_levels
from rewild4d.transforms import matrix_to_quat, quat_multiply, quat_to_matrix, rigid
from rewild4d.types import Prior


class PoseTable(nn.Module):
    """Given poses with learned corrections, which start at zero.

    Attributes:
        turns: axis-angle corrections of each joint's rotation against its parent, radians, [T, J, 3].
        shifts: translation of the whole animal, object units, [T, 3].
        quats: given rotation of each joint against its parent, [T, J, 4].
        offsets: given translation of each joint against its parent, zero along a true chain, [T, J, 3].
        pivots: inner end of each bone at rest, [J, 3].
    """

    quats: Tensor
    offsets: Tensor
    pivots: Tensor

    def __init__(self, quats: Tensor, offsets: Tensor, pivots: Tensor, parents: list[int]) -> None:
        super().__init__()
        self.parents = parents
        self.levels = [torch.tensor(level) for level in depth_levels(parents)]
        self.above = [torch.tensor([max(parents[joint], 0) for joint in level.tolist()]) for level in self.levels]
        self.register_buffer("quats", quats)
        self.register_buffer("offsets", offsets)
        self.register_buffer("pivots", pivots)
        self.turns = nn.Parameter(torch.zeros_like(offsets))
        self.shifts = nn.Parameter(torch.zeros_like(offsets[:, 0]))

    def forward(self, frame: int) -> tuple[Tensor, Tensor]:
        """Return the pose of a frame: rotation of each joint [J, 4] and rest -> posed transforms [J, 4, 4]."""
        return self._chained(self._local(frame), self.offsets[frame], self.shifts[frame])

    def between(self, position: float) -> tuple[Tensor, Tensor]:
        """Return the pose at a position between frames, as from `frame_position`; rotations slerp."""
        return self._chained(*self._at(position))

    @torch.no_grad()
    def with_frame(self, row: int, position: float) -> "PoseTable":
        """Return a table with one more frame at index ``row``, which starts at the pose between frames."""
        local, offsets, shift = self._at(position)

        def inserted(rows: Tensor, added: Tensor) -> Tensor:
            return torch.cat((rows[:row], added[None], rows[row:]))

        table = PoseTable(inserted(self.quats, local), inserted(self.offsets, offsets), self.pivots, self.parents)
        table.turns.copy_(inserted(self.turns, torch.zeros_like(offsets)))
        table.shifts.copy_(inserted(self.shifts, shift))
        return table.to(local.device)

    def _at(self, position: float) -> tuple[Tensor, Tensor, Tensor]:
        """Return the arguments of `_chained` at a position between frames."""
        low = int(position)
        part = position - low
        if part == 0:
            return self._local(low), self.offsets[low], self.shifts[low]
        return (
            slerp(self._local(low), self._local(low + 1), part),
            torch.lerp(self.offsets[low], self.offsets[low + 1], part),
            torch.lerp(self.shifts[low], self.shifts[low + 1], part),
        )

    def _local(self, frame: int) -> Tensor:
        return quat_multiply(self.quats[frame], exponential_quats(self.turns[frame]))

    def _chained(self, local: Tensor, offsets: Tensor, shift: Tensor) -> tuple[Tensor, Tensor]:
        """Chain P_j = P_parent T(c + d) R T(-c) from root to leaf, level by level."""
        rotation = quat_to_matrix(local)
        translation = self.pivots + offsets - (rotation @ self.pivots[..., None])[..., 0]
        quats, rotations, translations = local, rotation, translation
        for level, above in zip(self.levels[1:], self.above[1:], strict=True):
            level, above = level.to(local.device), above.to(local.device)
            quats = quats.index_copy(0, level, quat_multiply(quats[above], local[level]))
            outer = rotations[above]
            moved = (outer @ translation[level][..., None])[..., 0] + translations[above]
            translations = translations.index_copy(0, level, moved)
            rotations = rotations.index_copy(0, level, outer @ rotation[level])
        return quats, rigid(rotations, translations + shift)


def pose_table(transforms: Tensor, pivots: Tensor, parents: Tensor) -> PoseTable:
    """Make the table of given poses.

    Args:
        transforms: rest -> posed, rigid, [T, J, 4, 4].
        pivots: [J, 3].
        parents: -1 for a root, [J].
    """
    above = parents.clamp_min(0)
    outer = torch.linalg.inv(transforms.double())[:, above]
    outer[:, parents < 0] = torch.eye(4, dtype=torch.float64)
    local = outer @ transforms.double()
    centers = pivots.double()
    moved = (local[..., :3, :3] @ centers[..., None])[..., 0] + local[..., :3, 3]
    quats = matrix_to_quat(local[..., :3, :3]).float()
    return PoseTable(quats, (moved - centers).float(), pivots.float(), parents.tolist())


def prior_poses(prior: Prior, rows: list[int], mirrored: bool = False) -> PoseTable:
    """Return the table of the prior's poses at some of its frames, or at their mirror images."""
    transforms = prior.transforms_flip if mirrored else prior.transforms
    return pose_table(transforms[rows], prior.bones[:, 0], prior.parents)


def exponential_quats(rotations: Tensor) -> Tensor:
    """Return the unit quaternions of axis-angle vectors, differentiable at zero, [..., 3] -> [..., 4]."""
    angle = (rotations.square().sum(-1, keepdim=True) + 1e-16).sqrt()
    return torch.cat(((angle / 2).cos(), rotations / angle * (angle / 2).sin()), dim=-1)


def slerp(first: Tensor, last: Tensor, part: float) -> Tensor:
    """Interpolate along the shorter arc between unit quaternions, [..., 4]; linearly where they nearly coincide."""
    cosine = (first * last).sum(-1, keepdim=True)
    last = torch.where(cosine < 0, -last, last)
    angle = cosine.abs().clamp(max=1.0).acos()
    near = angle < 1e-3
    sine = torch.where(near, torch.ones_like(angle), angle.sin())
    low = torch.where(near, torch.full_like(angle, 1 - part), ((1 - part) * angle).sin() / sine)
    high = torch.where(near, torch.full_like(angle, part), (part * angle).sin() / sine)
    return nn.functional.normalize(low * first + high * last, dim=-1)
