"""Poses of GART: one rotation per joint and frame along a chain, one shift per frame, and what lies between frames."""

import torch
from torch import Tensor, nn

from rewild4d.priors.kinematics import depth_levels
from rewild4d.transforms import matrix_to_quat, quat_multiply, quat_to_matrix, rigid
from rewild4d.types import Prior


class PoseTable(nn.Module):
    """Learned corrections of given poses; all zero, they are the given poses.

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
        """Return the pose at a position between frames (1.5: half-way from the second to the third): joints slerp."""
        return self._chained(*self._at(position))

    @torch.no_grad()
    def with_frame(self, row: int, position: float) -> "PoseTable":
        """The table with one frame more, which is row ``row`` then and starts as the pose at a place between frames."""
        local, offsets, shift = self._at(position)

        def put(rows: Tensor, added: Tensor) -> Tensor:
            return torch.cat((rows[:row], added[None], rows[row:]))

        table = PoseTable(put(self.quats, local), put(self.offsets, offsets), self.pivots, self.parents)
        table.turns.copy_(put(self.turns, torch.zeros_like(offsets)))
        table.shifts.copy_(put(self.shifts, shift))
        return table.to(local.device)

    def _at(self, position: float) -> tuple[Tensor, Tensor, Tensor]:
        """Return what `_chained` takes, at a position between frames."""
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
        moves = self.pivots + offsets - (rotation @ self.pivots[..., None])[..., 0]
        quats, turns, places = local, rotation, moves
        for level, above in zip(self.levels[1:], self.above[1:], strict=True):
            level, above = level.to(local.device), above.to(local.device)
            quats = quats.index_copy(0, level, quat_multiply(quats[above], local[level]))
            turned = turns[above]
            places = places.index_copy(0, level, (turned @ moves[level][..., None])[..., 0] + places[above])
            turns = turns.index_copy(0, level, turned @ rotation[level])
        return quats, rigid(turns, places + shift)


def pose_table(transforms: Tensor, pivots: Tensor, parents: Tensor) -> PoseTable:
    """Make the table that starts at given poses.

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


def prior_poses(prior: Prior, rows: list[int]) -> PoseTable:
    """Return the prior's poses at some of its frames."""
    return pose_table(prior.transforms[rows], prior.bones[:, 0], prior.parents)


def exponential_quats(turns: Tensor) -> Tensor:
    """Return the unit quaternions of axis-angle vectors, smooth at zero, [..., 3] -> [..., 4]."""
    angle = (turns.square().sum(-1, keepdim=True) + 1e-16).sqrt()
    return torch.cat(((angle / 2).cos(), turns / angle * (angle / 2).sin()), dim=-1)


def slerp(first: Tensor, last: Tensor, part: float) -> Tensor:
    """Along the shorter arc between unit quaternions, [..., 4]; a straight blend where they nearly coincide."""
    cosine = (first * last).sum(-1, keepdim=True)
    last = torch.where(cosine < 0, -last, last)
    angle = cosine.abs().clamp(max=1.0).acos()
    near = angle < 1e-3
    sine = torch.where(near, torch.ones_like(angle), angle.sin())
    low = torch.where(near, torch.full_like(angle, 1 - part), ((1 - part) * angle).sin() / sine)
    high = torch.where(near, torch.full_like(angle, part), (part * angle).sin() / sine)
    return nn.functional.normalize(low * first + high * last, dim=-1)
