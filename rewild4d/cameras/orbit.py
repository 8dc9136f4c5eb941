"""Cameras on a circle around an animal: the views of KID-V and of the image matrix of FVD-F and FVD-Diag."""

import math

import torch
from torch import Tensor

from rewild4d.transforms import axis_angle_to_matrix, look_at
from rewild4d.types import Camera


def orbit_cameras(
    center: Tensor,
    radius: float,
    elevation: float,
    *,
    intrinsics: Tensor,
    width: int,
    height: int,
    up: Tensor,
    ahead: Tensor,
    views: int = 16,
) -> list[Camera]:
    """Return cameras at azimuths 2 pi i / views on one closed circle, all looking at its centre.

    View 0 is in the direction ``ahead``; azimuths rotate about ``up`` by the right-hand rule. The step from the last
    view to the first is as large as any other, which FVD-Diag needs.

    Args:
        center: world, [3].
        radius: distance of every camera from the centre, positive.
        elevation: radians above the plane through the centre, between -pi/2 and pi/2.
        intrinsics: pixels, pixel centres at +0.5, [3, 3].
        width: of the images in pixels.
        height: of the images in pixels.
        up: the world's up, [3].
        ahead: azimuth 0; only its part orthogonal to ``up`` counts, [3].
        views: number of cameras.
    """
    up = torch.nn.functional.normalize(up.double(), dim=0)
    level = ahead.double() - (ahead.double() @ up) * up
    if radius <= 0 or abs(elevation) >= math.pi / 2 or float(level.norm()) < 1e-9:
        raise ValueError(
            "expected a positive radius, an elevation between -pi/2 and pi/2 and an azimuth 0 that is not along up, "
            f"got {radius}, {elevation} and {ahead.tolist()}"
        )
    level = torch.nn.functional.normalize(level, dim=0)
    start = radius * (math.cos(elevation) * level + math.sin(elevation) * up)
    cameras = []
    for view in range(views):
        eye = center.double() + axis_angle_to_matrix(up * (2 * math.pi * view / views)) @ start
        cameras.append(Camera(look_at(eye, center.double(), up), intrinsics.double(), width, height))
    return cameras


def first_across(offsets: Tensor, up: Tensor) -> Tensor:
    """Return the first direction that is not along ``up``; where all are, any orthogonal to it, [3].

    Args:
        offsets: of any length, float64, [n, 3].
        up: of unit length, float64, [3].
    """
    for offset in offsets:
        if float(torch.linalg.cross(offset, up).norm()) > 1e-6 * float(offset.norm()):
            return offset
    return torch.linalg.cross(up, torch.eye(3).double()[int(up.abs().argmin())])
