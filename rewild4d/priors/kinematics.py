"""Forward kinematics: joint angles to rest -> posed transforms in object space."""

from collections.abc import Sequence

import torch
from torch import Tensor

from rewild4d.transforms import axis_angle_to_matrix, rigid


def depth_levels(parents: Sequence[int]) -> list[list[int]]:
    """Return bones grouped by their distance from a root, roots first; a `ValueError` where parents form no forest."""
    remaining, done, levels = set(range(len(parents))), {-1}, []
    while remaining:
        level = sorted(bone for bone in remaining if parents[bone] in done)
        if not level:
            raise ValueError(f"parents {list(parents)} do not form a forest")
        levels.append(level)
        remaining -= set(level)
        done |= set(level)
    return levels


def rotation_about(axis: int, angle: Tensor) -> Tensor:
    """Return rotations about a coordinate axis (0 is x) by angles in radians, [...] -> [..., 3, 3]."""
    zero, one = torch.zeros_like(angle), torch.ones_like(angle)
    if axis == 0:
        elements = (one, zero, zero, zero, angle.cos(), -angle.sin(), zero, angle.sin(), angle.cos())
    elif axis == 1:
        elements = (angle.cos(), zero, angle.sin(), zero, one, zero, -angle.sin(), zero, angle.cos())
    else:
        elements = (angle.cos(), -angle.sin(), zero, angle.sin(), angle.cos(), zero, zero, zero, one)
    return torch.stack(elements, -1).unflatten(-1, (3, 3))


def moved(points: Tensor, transforms: Tensor) -> Tensor:
    """Apply one affine transform to each point, [..., 3] and [..., 4, 4] -> [..., 3]."""
    return (transforms[..., :3, :3] @ points[..., None])[..., 0] + transforms[..., :3, 3]


def pose(angles: Tensor, pivots: Tensor, parents: Sequence[int]) -> Tensor:
    """Compute the rigid transforms P_j = P_parent(j) T(c_j) R_j T(-c_j) from rest to pose, [..., J, 4, 4].

    The axes of every joint are the object's (x pitches, y yaws, z rolls), so a mirrored pose has angles (x, -y, -z) on
    the bone of the other side.

    Args:
        angles: axis-angle vectors in radians, [..., J, 3].
        pivots: start of each bone at rest, broadcastable to [..., J, 3].
        parents: parent of each bone, -1 for a root.
    """
    rotations = axis_angle_to_matrix(angles)
    pivots = pivots.expand(angles.shape)
    local = rigid(rotations, pivots - (rotations @ pivots[..., None])[..., 0])
    posed: dict[int, Tensor] = {}
    for level in depth_levels(parents):
        own = local[..., level, :, :]
        if parents[level[0]] >= 0:
            own = torch.stack([posed[parents[bone]] for bone in level], dim=-3) @ own
        posed.update(zip(level, own.unbind(-3), strict=True))
    return torch.stack([posed[bone] for bone in range(len(parents))], dim=-3)
