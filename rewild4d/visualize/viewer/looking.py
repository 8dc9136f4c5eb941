"""Cameras of the browser: a position, a point to look at, a direction for up and a field of view around the middle."""

import math
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn.functional import normalize

from rewild4d.transforms import rigid
from rewild4d.types import Camera

FIELD_OF_VIEW = math.radians(40)
"""Vertical, of views that are not a camera's."""
ROOM = 1.1
"""Factor of the distance at which a ball just fits."""
NARROW = 0.75
"""Width over height below which a view is a phone's."""
RAISED = 0.4
"""Part of half the height of a phone's view by which the animal is above its middle."""
UP = torch.tensor((0.0, 1.0, 0.0), dtype=torch.float64)
ROLLED = 0.05
"""Least cosine between a camera's up and the stage's, seen along the line of sight, to orbit about the stage's."""


class Look(NamedTuple):
    """A browser's camera in the frame of the stage.

    Attributes:
        position: of its centre, float64, [3].
        target: what it looks at and turns around, float64, [3].
        up: about which it turns, float64, [3].
        fov: vertical field of view in radians.
    """

    position: NDArray[np.float64]
    target: NDArray[np.float64]
    up: NDArray[np.float64]
    fov: float


def centered(camera: Camera) -> Camera:
    """Turn a camera about its centre to the middle of its image, and widen it until it shows all of the image.

    A browser's camera has its principal point in the middle. Where a camera's is elsewhere (a crop of a film), this one
    sees the same points hide one another.
    """
    rotation, width, height = camera.world_to_camera[:3, :3].double(), camera.width, camera.height
    pixels = torch.tensor([(u, v, 1.0) for u in (0, width / 2, width) for v in (0, height / 2, height)]).double()
    rays = pixels @ torch.linalg.inv(camera.intrinsics.double()).T
    ahead = normalize(rotation.T @ rays[4], dim=0)  # of the middle of the image
    right = normalize(rotation[0] - (rotation[0] @ ahead) * ahead, dim=0)
    turned = torch.stack((right, torch.linalg.cross(ahead, right), ahead))
    seen = rays @ (turned @ rotation.T).T
    focal = torch.tensor((width, height)).double() / 2 / (seen[:, :2] / seen[:, 2:]).abs().amax(0)
    straight = torch.diag(torch.cat((focal, torch.ones(1).double())))
    straight[:2, 2] = torch.tensor((width, height)).double() / 2
    return Camera(rigid(turned, -turned @ camera.center.double()), straight, width, height)


def look_through(camera: Camera, aspect: float, center: Tensor) -> Look:
    """Return the look that shows the whole image of a camera.

    Args:
        camera: in the scene.
        aspect: width over height of the browser's view.
        center: of the animal, about which the look turns afterwards, float64, [3].
    """
    straight = centered(camera)
    (right, down, ahead), position = straight.world_to_camera[:3, :3], straight.center
    target = position + max(float((center - position) @ ahead), 1e-3) * ahead
    level = UP - (UP @ right) * right
    up = level if float(-down @ level) > ROLLED else -down
    half_width, half_height = (
        size / 2 / straight.intrinsics[i, i] for i, size in enumerate((camera.width, camera.height))
    )
    fov = 2 * math.atan(max(float(half_height), float(half_width) / aspect))
    return _raised(Look(position.numpy(), target.numpy(), up.numpy(), fov), aspect)


def look_from(azimuth: float, elevation: float, reach: float, aspect: float, center: Tensor) -> Look:
    """Return the look at a ball from a side, the whole of it in view.

    Args:
        azimuth: about up, from ahead towards the animal's left, radians.
        elevation: above the ground, radians, less than a right angle.
        reach: radius of the ball, in stage units.
        aspect: width over height of the browser's view.
        center: of the ball, float64, [3].
    """
    half = min(FIELD_OF_VIEW / 2, math.atan(math.tan(FIELD_OF_VIEW / 2) * aspect))
    flat = math.cos(elevation)
    toward = (flat * math.sin(azimuth), math.sin(elevation), flat * math.cos(azimuth))
    away = ROOM * reach / math.sin(half) * torch.tensor(toward, dtype=torch.float64)
    return _raised(Look((center + away).numpy(), center.numpy(), UP.numpy(), FIELD_OF_VIEW), aspect)


def _raised(look: Look, aspect: float) -> Look:
    """Show in the upper part of a phone's view what is in the middle: the panel covers the lower."""
    if aspect > NARROW:
        return look
    distance = float(np.linalg.norm(look.target - look.position))
    return look._replace(target=look.target - RAISED * math.tan(look.fov / 2) * distance * look.up)
