"""3D-Fauna's skeleton as a function of its rest vertices (design notes, FORMATS 4.4 to 4.6)."""

import torch
from torch import Tensor

from rewild4d.priors.kinematics import rotation_about
from rewild4d.transforms import rigid

TEMPERATURE = 0.05
BODY_PARENTS = (1, 2, 3, -1, 5, 6, 7, -1)
QUADRANTS = ((1, 1), (1, -1), (-1, -1), (-1, 1))
"""Sign of x and z of the legs: front left, rear left, rear right, front right."""


def estimate_bones(vertices: Tensor) -> tuple[Tensor, tuple[int, ...]]:
    """Return bones (start, end), [20, 2, 3], and the parent of each, -1 for a root, from rest vertices [n, 3]."""
    middle = vertices.mean(0)
    upper = vertices[vertices[:, 1] > middle[1] - 0.5]
    front, rear = vertices[vertices[:, 2].argmax()], upper[upper[:, 2].argmin()]
    flat = vertices.new_tensor((0.0, 1.0, 1.0))
    front, rear, back = front * flat, rear * flat, middle * flat + vertices.new_tensor((0.0, 0.5, 0.0))
    steps = torch.arange(5).to(vertices)[:, None] / 4
    spine = torch.cat((front + steps * (back - front), back + steps[1:] * (rear - back)))
    body = [(spine[k + 1], spine[k]) for k in range(4)] + [(spine[k - 1], spine[k]) for k in (8, 7, 6, 5)]
    feet = [_foot(vertices, *QUADRANTS[0]), _foot(vertices, *QUADRANTS[1])]
    ends = torch.stack([end for _, end in body])
    attached = [int((ends[:, 2] - foot[2]).abs().argmin()) for foot in feet]
    bones, parents = list(body), list(BODY_PARENTS)
    sign = vertices.new_tensor((-1.0, 1.0, 1.0))
    for quadrant, source in enumerate((0, 1, 1, 0)):
        foot = feet[source] if quadrant < 2 else feet[source] * sign
        joints = foot + torch.arange(4).to(vertices)[:, None] / 3 * (ends[attached[source]] - foot)
        first = 8 + 3 * quadrant
        bones += [(joints[1], joints[0]), (joints[2], joints[1]), (joints[3], joints[2])]
        parents += [first + 1, first + 2, attached[source]]
    return torch.stack([torch.stack(bone) for bone in bones]), tuple(parents)


def _foot(vertices: Tensor, side: int, end: int) -> Tensor:
    """Return the lowest vertex of a quadrant, [3]."""
    low = vertices[vertices[:, 1] < vertices[:, 1].quantile(0.4)]
    x0, z0 = low[:, 0].median(), low[:, 2].median()
    span = torch.quantile(low, 0.95, dim=0) - torch.quantile(low, 0.05, dim=0)
    beside = side * (low[:, 0] - x0) > 0.2 * span[0]
    along = low[:, 2] - z0 > 0.2 * span[2] if end > 0 else low[:, 2] < z0
    chosen = low[beside & along]
    chosen = chosen if len(chosen) else low
    return chosen[chosen[:, 1].argmin()]


def skinning_weights(vertices: Tensor, bones: Tensor) -> Tensor:
    """Compute the softmax over bones of minus the distance to the bone over the temperature, [n, 20]."""
    start, along = bones[:, 0], bones[:, 1] - bones[:, 0]
    offset = vertices[:, None] - start
    share = ((offset * along).sum(-1) / along.square().sum(-1).clamp_min(1e-12)).clamp(0, 1)
    distance = (offset - share[..., None] * along).norm(dim=-1)
    return torch.softmax(-distance / TEMPERATURE, dim=1)


def joint_transforms(bones: Tensor, parents: tuple[int, ...], angles: Tensor) -> Tensor:
    """Return each bone's transform from rest to pose, the product of M R M^-1 from root to leaf, [20, 4, 4].

    M is the bone's frame at rest.

    Args:
        bones: [20, 2, 3].
        parents: of each bone, -1 for a root.
        angles: Euler angles in radians, R = Rx Ry Rz, [20, 3].
    """
    forward = torch.nn.functional.normalize(bones[:, 1] - bones[:, 0], dim=-1)
    lateral = forward.new_tensor((1.0, 0, 0)).expand(20, 3)
    up = torch.nn.functional.normalize(torch.linalg.cross(forward, lateral), dim=-1)
    right = torch.nn.functional.normalize(torch.linalg.cross(up, forward), dim=-1)
    frame = rigid(torch.stack((right, up, forward), dim=-1), bones[:, 0])
    about_x, about_y, about_z = (rotation_about(axis, angles[:, axis]) for axis in range(3))
    local = frame @ rigid(about_x @ about_y @ about_z, torch.zeros_like(bones[:, 0])) @ torch.linalg.inv(frame)

    def chained(bone: int) -> Tensor:
        return local[bone] if parents[bone] < 0 else chained(parents[bone]) @ local[bone]

    return torch.stack([chained(bone) for bone in range(len(parents))])
