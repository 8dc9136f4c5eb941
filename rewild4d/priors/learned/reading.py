"""Read a clip: pictures from its frames, the network's points in the axes of a camera that looks along each crop."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
import torch
from torch import Tensor

from rewild4d.priors.learned.network import PointNetwork, found
from rewild4d.priors.learned.pictures import LENGTH, LEVEL, MARGIN, SIZE, Examples, looking_at, normalised
from rewild4d.priors.learned.points import NAMES, OTHER_SIDE
from rewild4d.priors.silhouettes import known_camera, mask_box, require_mask
from rewild4d.types import Frame

FINEST = 4
"""Most samples per pixel of a picture along each axis."""


@dataclass(frozen=True)
class Reading:
    """Points of the body that the network found in a clip, one row for each frame whose mask is not empty.

    Attributes:
        timesteps: index of each frame's time, int64, [v].
        world_to_view: rotation from the world to a camera that looks along the crop's middle, [v, 3, 3].
        centers: of the cameras, in the world, [v, 3].
        openings: half the crop's width at unit depth, [v].
        points: about the middle of withers and hips, in units of half the crop's width at its depth, [v, L, 3].
        spreads: expected absolute error across the view and along it, [v, L, 2].
    """

    timesteps: Tensor
    world_to_view: Tensor
    centers: Tensor
    openings: Tensor
    points: Tensor
    spreads: Tensor


def read(
    frames: Sequence[Frame], timesteps: Sequence[int], up: Tensor, name: str, network: PointNetwork, *,
    known: bool = True,
) -> Reading:  # fmt: skip
    """Find the points in frames of one moving camera, in the order of their times.

    Args:
        frames: with cameras; those with an empty mask are left out.
        timesteps: indices of their times, increasing.
        up: of the world, unit, float64, [3].
        name: of the case, for errors.
        network: trained.
        known: whether the network may use the cameras' directions and openings; where they are made up, it may not.

    Raises:
        UserError: a frame has no camera, or no mask shows anything.
    """
    require_mask(frames, name)
    kept = [(time, frame) for time, frame in zip(timesteps, frames, strict=True) if mask_box(frame.mask[0] > 0.5)]
    views = [view_of(frame, name) for _, frame in kept]
    pictures, rotations, centers, openings = (np.stack(column) for column in zip(*views, strict=True))
    upright = rotations @ _upright(up.numpy(), rotations[0, 2]) if known else np.tile(LEVEL, (len(kept), 1, 1))
    shown = Examples(
        torch.from_numpy(pictures)[None], torch.from_numpy(upright).float()[None], torch.from_numpy(openings)[None],
        torch.tensor([known]), torch.zeros(1, len(kept), len(NAMES), 3),
    )  # fmt: skip
    points, spreads = _found(network, shown)
    times = torch.tensor([time for time, _ in kept])
    rest = (torch.from_numpy(rotations).float(), torch.from_numpy(centers).float(), torch.from_numpy(openings))
    return Reading(times, *rest, points, spreads)


@torch.no_grad()
def _found(network: PointNetwork, shown: Examples) -> tuple[Tensor, Tensor]:
    """Return points and spreads, the mean over windows of `LENGTH` frames and their mirror images."""
    count = shown.pictures.shape[1]
    points, spreads = torch.zeros(count, len(NAMES), 3), torch.zeros(count, len(NAMES), 2)
    seen = torch.zeros(count, 1, 1)
    for start in sorted({*range(0, max(count - LENGTH, 0) + 1, LENGTH // 2), max(count - LENGTH, 0)}):
        rows = slice(start, start + LENGTH)
        part = Examples(*(value if value.ndim == 1 else value[:, rows] for value in vars(shown).values()))
        direct, flipped = found(network, part), found(network, part.mirrored())
        back = Examples(part.pictures, part.rotations, part.openings, part.known, flipped.points).mirrored()
        swapped = flipped.spreads[..., OTHER_SIDE, :]
        points[rows] += 0.5 * (direct.points[0] + back.points[0])
        spreads[rows] += 0.5 * (direct.spreads[0] + swapped[0])
        seen[rows] += 1
    return points / seen, spreads / seen


def _upright(up: np.ndarray, ahead: np.ndarray) -> np.ndarray:
    """Return a rotation from axes whose y is up and whose -z is the first camera's view to the world, [3, 3]."""
    x = np.cross(ahead, up)
    if np.linalg.norm(x) < 1e-3:  # it looks straight down
        x = np.cross(np.eye(3)[np.abs(up).argmin()], up)
    x /= np.linalg.norm(x)
    return np.stack((x, up, np.cross(x, up)), axis=1)


def view_of(frame: Frame, name: str) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.float32]:
    """Return the network's picture of a frame, the rotation from the world, the camera's centre, and the opening."""
    camera, box = known_camera(frame, name), mask_box(frame.mask[0] > 0.5)
    assert box is not None
    left, top, right, bottom = box
    side = max(right - left, bottom - top) * (1 + 2 * MARGIN)
    intrinsics, extrinsics = camera.intrinsics.double().numpy(), camera.world_to_camera.double().numpy()
    middle = np.linalg.solve(intrinsics, ((left + right) / 2, (top + bottom) / 2, 1.0))
    turn = looking_at(middle[:2])
    opening = 0.5 * side / math.sqrt(intrinsics[0, 0] * intrinsics[1, 1]) / (1 + float(middle[:2] @ middle[:2]))
    samples = min(FINEST, max(1, math.ceil(side / SIZE)))
    fine = samples * SIZE
    # picture's pixel -> ray -> the frame's axes -> the frame's pixel; cv2 counts from the middle of the first pixel
    scale = 2 * opening / fine
    rays = np.array(((scale, 0, scale * 0.5 - opening), (0, scale, scale * 0.5 - opening), (0, 0, 1)))
    shift = np.array(((1, 0, -0.5), (0, 1, -0.5), (0, 0, 1)))
    matrix = shift @ intrinsics @ turn.T @ rays
    layers = np.stack((frame.mask[0].numpy(), frame.rgb.mean(0).numpy()), axis=-1).astype(np.float32)
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    warped = cv2.warpPerspective(layers, matrix, (fine, fine), flags=flags, borderMode=cv2.BORDER_CONSTANT)
    small = warped.reshape(SIZE, samples, SIZE, samples, 2).mean(axis=(1, 3)).transpose(2, 0, 1)
    center = -extrinsics[:3, :3].T @ extrinsics[:3, 3]
    return normalised(small), turn @ extrinsics[:3, :3], center, np.float32(opening)
