"""Check that the cameras, mattes and voxels of an Artemis animal are of one world.

A file of the right form may still hold world-to-camera matrices, OpenGL axes or the intrinsics of a larger image. Then
the lines of sight to the animal do not meet before the cameras.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch

from rewild4d.types import Camera

LEAST_SPREAD = 0.01
"""Mean squared sine between the lines of sight and their common direction, below which they meet anywhere."""
SOLID = 128
"""Matte values from here on are animal."""


@dataclass(frozen=True)
class Look:
    """What one matte shows.

    Attributes:
        highest: value of the matte, 0 to 255.
        center: (column, row) of the animal's middle in pixels, pixel centres at +0.5, [2].
        box: left, top, right and bottom of all that is not zero, in pixels.
        framed: share of the image's border that is animal, in [0, 1].
    """

    highest: int
    center: np.ndarray
    box: tuple[int, int, int, int]
    framed: float


def look(alpha: np.ndarray) -> Look | None:
    """Describe a matte, uint8 [h, w]; None where it is empty."""
    rows, columns = np.flatnonzero(alpha.any(axis=1)), np.flatnonzero(alpha.any(axis=0))
    if not len(rows):
        return None
    total = alpha.sum(dtype=np.float64)
    down, across = alpha.sum(axis=1, dtype=np.float64), alpha.sum(axis=0, dtype=np.float64)
    center = ((across @ np.arange(len(across)) / total) + 0.5, (down @ np.arange(len(down)) / total) + 0.5)
    border = np.concatenate((alpha[0], alpha[-1], alpha[:, 0], alpha[:, -1]))
    box = int(columns[0]), int(rows[0]), int(columns[-1]) + 1, int(rows[-1]) + 1
    return Look(int(alpha.max()), np.array(center), box, float((border >= SOLID).mean()))


def strayed(cameras: Sequence[Camera], looks: Sequence[Look | None]) -> list[int]:
    """Return views in which the animal is not where the views' lines of sight meet.

    Args:
        cameras: of the views of one moment.
        looks: what their mattes show; None: nothing.

    Returns:
        Numbers of the views that have the meeting point behind them, or further from the matte's box than half its
        longer side; none where fewer than two views show the animal, or all look along nearly the same line.
    """
    shown = [view for view, found in enumerate(looks) if found is not None]
    origins = np.array([cameras[view].center.numpy() for view in shown])
    directions = np.array([_direction(cameras[view], found.center) for view, found in enumerate(looks) if found])
    if len(shown) < 2:
        return []
    across = np.eye(3) - directions[:, :, None] * directions[:, None, :]
    total = across.sum(axis=0)
    if np.linalg.eigvalsh(total)[0] < LEAST_SPREAD * len(shown):
        return []
    point = torch.from_numpy(np.linalg.solve(total, np.einsum("nab,nb->a", across, origins)))
    return [view for view, found in enumerate(looks) if found and not _is_near(point, cameras[view], found.box)]


def strayed_sentence(animal: Path, motion: str, wrong: int, shown: int) -> str:
    """Return what to say where `strayed` finds ``wrong`` of ``shown`` views."""
    return (
        f"{animal / 'CamPose.inf'}: expected camera-to-world matrices with OpenCV axes that fit Intrinsic.inf and the "
        f"images, but where the lines of sight to the animal meet ('{motion}', first frame) is behind the camera or "
        f"far off the matte in {wrong} of {shown} views."
    )


def _direction(camera: Camera, pixel: np.ndarray) -> np.ndarray:
    """Return the unit vector through a pixel in the world, [3]."""
    ray = camera.world_to_camera[:3, :3].numpy().T @ np.linalg.solve(camera.intrinsics.numpy(), np.append(pixel, 1.0))
    return ray / np.linalg.norm(ray)


def _is_near(point: torch.Tensor, camera: Camera, box: tuple[int, int, int, int]) -> bool:
    pixel, depth = camera.project(point)
    corners = np.reshape(box, (2, 2))
    most = max(4.0, 0.5 * float(np.ptp(corners, axis=0).max()))
    inside = (pixel.numpy() >= corners[0] - most) & (pixel.numpy() <= corners[1] + most)
    return bool(depth > 0 and inside.all())


def covered(points: np.ndarray, camera: Camera, alpha: np.ndarray) -> float:
    """Return the share of the world points [n, 3] within a view's image that fall on its matte; 0 without any."""
    pixels, depth = camera.project(torch.from_numpy(points))
    column, row = np.floor(pixels.numpy()).T
    inside = (depth.numpy() > 0) & (column >= 0) & (row >= 0) & (column < camera.width) & (row < camera.height)
    if not inside.any():
        return 0.0
    return float((alpha[row[inside].astype(int), column[inside].astype(int)] >= SOLID).mean())
