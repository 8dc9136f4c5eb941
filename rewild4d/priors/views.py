"""Guesses of an animal under unknown cameras: 3D-Fauna's camera model in place of a world.

The camera is fixed ten units from the origin, upright, with a field of view of 25 degrees over a square window around
the animal, which rotates by azimuth and elevation (no roll) and shifts (design notes, METHOD sections 1 and 2). The
working frame is the camera's with y up and z towards the camera.
"""

import math
from dataclasses import dataclass, replace
from typing import Any, Self

import numpy as np
import torch
from scipy.ndimage import gaussian_filter1d
from torch import Tensor

from rewild4d.priors.bodies.body import Body
from rewild4d.priors.hypotheses import Hypotheses, cosine_series
from rewild4d.priors.kinematics import moved, pose, rotation_about
from rewild4d.priors.landmarks import Marks
from rewild4d.priors.silhouettes import mask_box
from rewild4d.transforms import rigid
from rewild4d.types import Camera, Frame

FIELD_OF_VIEW = math.radians(25.0)
DISTANCE = 10.0
"""From the camera to the working frame's origin (Fauna's camera offset)."""
WINDOW = 1.3
"""Side of the window over the longer side of the mask's box: Fauna's crops are padded by 15 % on each side."""
BOX_SMOOTHING = 2.0
"""Standard deviation, in frames, of the smoothing of windows: a swinging tail moves no camera."""
AZIMUTH_SPREAD, ELEVATION_SPREAD, ELEVATION = 0.35, math.radians(8.0), math.radians(8.0)
"""Standard deviations of azimuth and elevation, and the mean elevation, radians."""
SHIFT_SPREADS = (0.10, 0.10, 0.6)
"""Standard deviations of the animal's position in its window in x, y and depth, working units."""
CARRIAGE_FRAMES = 16
"""About as many frames of a clip are looked at for the carriage of head and tail."""
LONG = 24
"""Frames of a clip up to which motion is penalised as in `Hypotheses`; of longer ones by the same periods in frames."""


def windows(frames: tuple[Frame, ...]) -> Tensor:
    """Return square windows around the masks, smooth over time: centre x, y and side in pixels, float64, [T, 3].

    Windows of frames with an empty mask are interpolated; at least one mask must show something.
    """
    known, rows = [], []
    for index, frame in enumerate(frames):
        if box := mask_box(frame.mask[0] > 0.5):
            left, top, right, bottom = box
            known.append(index)
            rows.append(((left + right) / 2, (top + bottom) / 2, WINDOW * max(right - left, bottom - top)))
    boxes = np.array(rows, dtype=np.float64)
    filled = np.stack([np.interp(np.arange(len(frames)), known, column) for column in boxes.T], axis=1)
    return torch.from_numpy(gaussian_filter1d(filled, BOX_SMOOTHING, axis=0, mode="nearest"))


def fauna_camera(window: Tensor, width: int, height: int) -> Camera:
    """Return the fixed camera over one window ([3]: centre and side) of an image, in the working frame."""
    x, y, side = window.tolist()
    focal = side / 2 / math.tan(FIELD_OF_VIEW / 2)
    intrinsics = torch.tensor(((focal, 0.0, x), (0.0, focal, y), (0.0, 0.0, 1.0)), dtype=torch.float64)
    world_to_camera = torch.diag(torch.tensor((1.0, -1.0, -1.0, 1.0), dtype=torch.float64))
    world_to_camera[2, 3] = DISTANCE
    return Camera(world_to_camera, intrinsics, width, height)


@dataclass
class Views(Hypotheses):
    """A batch of guesses under the fixed camera.

    Unlike under known cameras, `rotation` is a series of (azimuth, elevation), [B, K, 2], and `shift` has a row for
    each frame, [B, T, 3], since the windows may move fast. `turn` counts for nothing: the azimuth is free to change.
    """

    @classmethod
    def start(cls, body: Body, facing: Tensor, path: Tensor, root_period: int = 4) -> Self:
        """Return average animals of a kind at rest at the window's centre, from facings [B, 3, 3] and a path [T, 3]."""
        still = super().start(body, facing, path, root_period)
        rotation, shift = torch.zeros(*still.rotation.shape[:2], 2), torch.zeros(len(facing), len(path), 3)
        return replace(still, rotation=rotation, shift=shift)

    def turned(self, turn: Tensor) -> Self:
        """Return these guesses as they turn besides, by angles about y, radians, [T]; none is fixed."""
        series = cosine_series(len(turn), self.rotation.shape[1])
        rotation = self.rotation.clone()
        rotation[..., 0] += torch.linalg.lstsq(series, turn[:, None] / AZIMUTH_SPREAD).solution[:, 0]
        return replace(self, rotation=rotation)

    def with_depth_mirrored(self) -> Self:
        """Return these guesses and their reflections in the image plane, [2 B].

        A reflection has left and right exchanged and heads away from the camera instead of towards it. From afar and
        at eye level both have the same outline.
        """
        # the reflection of a rotation by a about y is one by pi - a, shared by the facing and the series
        half_circle = torch.diag(torch.tensor((-1.0, 1.0, -1.0)))
        mirrored = self.by_guess()
        mirrored["facing"] = half_circle @ self.facing.transpose(-1, -2)
        mirrored["rotation"] = self.rotation.detach() * torch.tensor((-1.0, 1.0))
        mirrored["angles"] = self.angles.detach()[..., list(self.body.mirror), :] * torch.tensor((1.0, -1.0, -1.0))
        both: dict[str, Any] = {name: torch.cat((value, mirrored[name])) for name, value in self.by_guess().items()}
        return replace(self, **both)

    def roots(self) -> Tensor:
        """Return the rigid root motion without the scale: azimuth, then the camera's elevation, [B, T, 4, 4]."""
        series = cosine_series(len(self.path), self.rotation.shape[1])
        azimuth, elevation = (series @ self.rotation).unbind(-1)
        pitch = rotation_about(0, ELEVATION + ELEVATION_SPREAD * elevation)
        # facing is a rotation about y, which commutes with azimuth and must come before the elevation
        rotation = pitch @ rotation_about(1, AZIMUTH_SPREAD * azimuth) @ self.facing[:, None]
        return rigid(rotation, self.path + self.shift * torch.tensor(SHIFT_SPREADS))

    def projected(self, found: Marks) -> Tensor:
        """Project the marks of each guess: x and y over depth in the camera's axes, [B, m, 2]."""
        bones = self.template().bones
        frames, rows = found.frames.unique(return_inverse=True)
        transforms = pose(self.joint_angles()[:, frames], bones[:, None, :, 0], self.body.parents)[:, rows, found.bones]
        start, end = bones[:, found.bones].unbind(2)
        posed = moved(start + found.along[:, None] * (end - start), transforms)
        seen = moved(self.scales()[:, None, None] * posed, self.roots()[:, found.frames])
        return torch.stack((seen[..., 0], -seen[..., 1]), -1) / (DISTANCE - seen[..., 2:]).clamp_min(1.0)

    def penalties(self) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Return penalties of proportions, relief, joint angles and root motion, each [B], as `Hypotheses` does."""
        frequency = min(1.0, LONG / len(self.path))
        speed = (frequency * torch.arange(self.rotation.shape[1])).square()
        azimuth, elevation = self.rotation.square().unbind(-1)
        root = 0.01 * (azimuth * speed).sum(1) + 0.1 * elevation[:, 0] + (elevation * (1 + speed))[:, 1:].sum(1)
        root = root + 0.1 * self.shift.square().mean((1, 2))
        if len(self.path) > 2:
            root = root + self.shift.diff(n=2, dim=1).square().mean((1, 2))
        return *self._body_penalties(frequency), root

    def carriage(self) -> Tensor:
        """Return a penalty on heads folded into the body and on raised tails, squared body lengths, [B].

        Outlines alone do not tell.
        """
        bones, every = self.template().bones, max(1, len(self.path) // CARRIAGE_FRAMES)
        transforms = pose(self.joint_angles()[:, ::every], bones[:, None, :, 0], self.body.parents)
        return self.body.carriage(bones, transforms)
