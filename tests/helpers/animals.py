"""Points on an animal that no reflection maps to itself: the template with its head turned and a leg forward."""

import torch
from torch import Tensor

from rewild4d.io.sampling import sample_mesh
from rewild4d.priors.bodies.quadruped import QUADRUPED

UP = torch.tensor((0.0, 1.0, 0.0))
LEGS = {"front left": (8, 9, 10), "front right": (17, 18, 19)}


def animal(count: int, seed: int, *, without: str | None = None, swing: float = 0.4) -> Tensor:
    """Area-uniform points in the object frame (y up, z towards the head), float64, [count, 3]."""
    template = QUADRUPED.build()
    vertices, faces = template.vertices.double(), template.faces
    x, y, z = vertices.unbind(1)
    bend = 0.25 * (z - 0.3).clamp_min(0) ** 2 + 0.15 * (-0.5 - z).clamp_min(0) ** 2
    stride = swing * template.weights[:, LEGS["front right"]].sum(1).double() * (-y).clamp_min(0)
    if without:
        faces = faces[(template.weights[:, LEGS[without]].sum(1) <= 0.5)[faces].all(1)]
    return sample_mesh(torch.stack((x + bend, y, z + stride), dim=1), faces, count, seed)


def yaw(degrees: float) -> Tensor:
    """Turn about y, float64, [3, 3]."""
    angle = torch.deg2rad(torch.tensor(degrees, dtype=torch.float64))
    c, s = angle.cos().item(), angle.sin().item()
    return torch.tensor(((c, 0, s), (0, 1, 0), (-s, 0, c)), dtype=torch.float64)


def floaters(count: int, side: float, seed: int) -> Tensor:
    """Points anywhere in a cube around the origin, float64, [count, 3]."""
    generator = torch.Generator().manual_seed(seed)
    return (torch.rand(count, 3, dtype=torch.float64, generator=generator) - 0.5) * side
