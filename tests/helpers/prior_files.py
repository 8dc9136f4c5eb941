"""Priors of the template that stands still, with cameras on a ring around it."""

import math

import torch

from rewild4d.priors.bodies.quadruped import QUADRUPED
from rewild4d.transforms import look_at
from rewild4d.types import Camera, Clip, Frame, Prior


def ring(angles: list[float]) -> tuple[Camera, ...]:
    """Cameras for images of 64x64 pixels at these azimuths in radians."""
    up, origin = torch.tensor((0.0, 1.0, 0.0)).double(), torch.zeros(3).double()
    eyes = [torch.tensor((14 * math.sin(a), 2.0, 14 * math.cos(a))).double() for a in angles]
    intrinsics = torch.tensor(((100.0, 0, 32), (0, 100, 32), (0, 0, 1))).double()
    return tuple(Camera(look_at(eye, origin, up), intrinsics, 64, 64) for eye in eyes)


def a_prior(angles: list[float], flipped: list[float]) -> Prior:
    """A prior of 24 frames a second, whose cameras and those of the mirrored frames are at these azimuths."""
    template, count = QUADRUPED.build(), len(angles)
    still = torch.eye(4).repeat(count, 20, 1, 1)
    return Prior(
        "made", "", template.vertices, template.faces, template.weights, template.bones, torch.full((20,), -1),
        torch.arange(20), torch.arange(count).double() / 24, torch.eye(4).double().repeat(count, 1, 1), ring(angles),
        still, ring(flipped), still, {}, "",
    )  # fmt: skip


def two_frames() -> Clip:
    """Two frames of one camera; the mask is the left half of the image."""
    up = torch.tensor((0.0, 1.0, 0.0), dtype=torch.float64)
    view = look_at(torch.tensor((6.0, 1.0, 2.0), dtype=torch.float64), torch.zeros(3, dtype=torch.float64), up)
    intrinsics = torch.tensor(((60.0, 0.0, 30.0), (0.0, 60.0, 20.0), (0.0, 0.0, 1.0)), dtype=torch.float64)
    mask = torch.zeros(1, 40, 64)
    mask[:, :, :32] = 1.0
    frames = tuple(Frame(t / 24, Camera(view, intrinsics, 64, 40), mask.expand(3, -1, -1), mask) for t in range(2))
    return Clip("made/up", "none", frames, 24.0, "CC0", "")
