"""Guesses of an animal that is seen by a camera nobody knows: 3D-Fauna's camera model in place of a world.

The camera stands still ten units from the origin, upright, with a field of view of 25 degrees over a square window
around the animal; the animal turns and shifts before it (design notes, METHOD sections 1 and 2). Azimuth and elevation
are the only turns, so there is no roll. The working frame is the camera's with y up and z towards the camera.
"""

import math
from dataclasses import dataclass, fields

import numpy as np
import torch
from scipy.ndimage import gaussian_filter1d
from torch import Tensor

from rewild4d.priors.hypotheses import ANGLE_SPREADS, Hypotheses, cosine_series
from rewild4d.priors.kinematics import pose
from rewild4d.priors.landmarks import Marks
from rewild4d.priors.proportions import PROPORTIONS, SECTIONS, Proportions
from rewild4d.priors.template import MIRROR, PARENTS, quadruped
from rewild4d.transforms import rigid
from rewild4d.types import Camera, Frame

FIELD_OF_VIEW = math.radians(25.0)
DISTANCE = 10.0
"""From the camera to the working frame's origin, as Fauna's camera offset."""
WINDOW = 1.3
"""Side of the window over the longer side of the mask's box: Fauna's crops are padded by 15 % on each side."""
BOX_SMOOTHING = 2.0
"""Standard deviation over time, in frames, of the window's centre and side: a swinging tail moves no camera."""
AZIMUTH_SPREAD, ELEVATION_SPREAD, ELEVATION = 0.35, math.radians(8.0), math.radians(8.0)
"""Radians: natural spread of the turn over time, of the camera's elevation, and its mean."""
SHIFT_SPREADS = (0.10, 0.10, 0.6)
"""Natural spread of the animal's position in its window in x, y and depth, working units."""
HEAD_FORWARD, NOSE_FORWARD, POLL_FORWARD = 0.4, 0.35, 0.1
"""How far heads reach forwards at least: the nose from the poll, in head lengths; nose and poll from the withers, in
body lengths."""
CARRIAGE_MOMENTS = 16
"""Moments of a clip at which the carriage is looked at."""
STEADY = 24
"""Frames of a clip whose motion is penalised as `Hypotheses` does; longer ones by the same periods in frames."""


def windows(frames: tuple[Frame, ...]) -> Tensor:
    """Square windows around the masks, smooth over time: centre x, centre y and side in pixels, float64, [T, 3].

    Frames with an empty mask get a window between their neighbours'; at least one mask must hold something.
    """
    known, rows = [], []
    for index, frame in enumerate(frames):
        high, wide = np.nonzero(frame.mask[0].numpy() > 0.5)
        if len(high):
            known.append(index)
            x0, x1, y0, y1 = wide.min(), wide.max() + 1, high.min(), high.max() + 1
            rows.append(((x0 + x1) / 2, (y0 + y1) / 2, WINDOW * max(x1 - x0, y1 - y0)))
    boxes = np.array(rows, dtype=np.float64)
    filled = np.stack([np.interp(np.arange(len(frames)), known, column) for column in boxes.T], axis=1)
    return torch.from_numpy(gaussian_filter1d(filled, BOX_SMOOTHING, axis=0, mode="nearest"))


def fauna_camera(window: Tensor, width: int, height: int) -> Camera:
    """Return the standing camera over one window ([3]: centre and side) of an image, in the working frame."""
    x, y, side = window.tolist()
    focal = side / 2 / math.tan(FIELD_OF_VIEW / 2)
    intrinsics = torch.tensor(((focal, 0.0, x), (0.0, focal, y), (0.0, 0.0, 1.0)), dtype=torch.float64)
    world_to_camera = torch.diag(torch.tensor((1.0, -1.0, -1.0, 1.0), dtype=torch.float64))
    world_to_camera[2, 3] = DISTANCE
    return Camera(world_to_camera, intrinsics, width, height)


@dataclass
class Views(Hypotheses):
    """A batch of guesses under the standing camera.

    Unlike under known cameras, `turn` is a series of (azimuth, elevation), [B, K, 2], and `shift` holds every moment on
    its own, [B, T, 3]: a window follows the outline, so positions may change as fast as boxes do.
    """

    @staticmethod
    def start(facing: Tensor, path: Tensor) -> "Views":
        """Average animals at rest at the window's centre, [B, 3, 3] and [T, 3]."""
        batch, moments = len(facing), len(path)
        return Views(
            facing,
            path,
            scale=torch.zeros(batch),
            turn=torch.zeros(batch, 1 + (moments - 1) // 4, 2),
            shift=torch.zeros(batch, moments, 3),
            shape=torch.zeros(batch, len(PROPORTIONS)),
            relief=torch.zeros(batch, sum(SECTIONS), 4),
            angles=torch.zeros(batch, 1 + (moments - 1) // 2, len(PARENTS), 3),
        )

    def select(self, rows: Tensor) -> "Views":
        rest = {f.name: getattr(self, f.name).detach()[rows] for f in fields(self) if f.name != "path"}
        return Views(path=self.path, **rest)

    def with_depth_mirrored(self) -> "Views":
        """These guesses and their reflections in the image plane: animals with left and right exchanged that head away
        instead of towards the camera. From afar and at eye level the two have the same outline, [2 B].
        """
        # the reflection of a turn by a about y is one by pi - a, shared by the facing and the series
        half_turn = torch.diag(torch.tensor((-1.0, 1.0, -1.0)))
        swapped = self.angles[..., list(MIRROR), :] * torch.tensor((1.0, -1.0, -1.0))
        parts = {
            "facing": half_turn @ self.facing.transpose(-1, -2),
            "turn": self.turn * torch.tensor((-1.0, 1.0)),
            "angles": swapped,
        }
        both = {
            f.name: torch.cat((getattr(self, f.name), parts.get(f.name, getattr(self, f.name)))).detach()
            for f in fields(self)
            if f.name != "path"
        }
        return Views(path=self.path, **both)

    def roots(self) -> Tensor:
        """Return the rigid root motion without the scale: azimuth, then the camera's elevation, [B, T, 4, 4]."""
        series = cosine_series(len(self.path), self.turn.shape[1])
        azimuth, elevation = (series @ self.turn).unbind(-1)
        turn = _about_x(ELEVATION + ELEVATION_SPREAD * elevation) @ _about_y(AZIMUTH_SPREAD * azimuth)
        # facing is a turn about y, which commutes with azimuth and must come before the elevation
        return rigid(turn @ self.facing[:, None], self.path + self.shift * torch.tensor(SHIFT_SPREADS))

    def projected(self, found: Marks) -> Tensor:
        """Return where each guess puts the marks: x and y over depth in the camera's axes, [B, m, 2]."""
        bones = quadruped(Proportions(self.shape, self.relief), unit=False).bones
        moments, rows = found.moments.unique(return_inverse=True)
        transforms = pose(self.joint_angles()[:, moments], bones[:, None, :, 0], PARENTS)[:, rows, found.bones]
        start, end = bones[:, found.bones].unbind(2)
        rest = start + found.along[:, None] * (end - start)
        posed = (transforms[..., :3, :3] @ rest[..., None])[..., 0] + transforms[..., :3, 3]
        roots = self.roots()[:, found.moments]
        seen = (roots[..., :3, :3] @ (self.scales()[:, None, None] * posed)[..., None])[..., 0] + roots[..., :3, 3]
        return torch.stack((seen[..., 0], -seen[..., 1]), -1) / (DISTANCE - seen[..., 2:]).clamp_min(1.0)

    def penalties(self) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """How unusual proportions, relief, joint angles and root motion are, each [B]; see `Hypotheses.penalties`."""
        per_frame = min(1.0, STEADY / len(self.path))
        pace = per_frame * torch.arange(self.angles.shape[1])
        swing = self.angles.square() * (ANGLE_SPREADS > 0) * (0.3 + (pace / 4).square())[:, None, None]
        haste = (per_frame * torch.arange(self.turn.shape[1])).square()
        azimuth, elevation = self.turn.square().unbind(-1)
        root = 0.01 * (azimuth * haste).sum(1) + 0.1 * elevation[:, 0] + (elevation * (1 + haste))[:, 1:].sum(1)
        root = root + 0.1 * self.shift.square().mean((1, 2))
        if len(self.path) > 2:
            root = root + self.shift.diff(n=2, dim=1).square().mean((1, 2))
        return (
            self.shape.square().mean(1),
            self.relief.square().mean((1, 2)),
            swing.sum(1).mean((1, 2)),
            root,
        )

    def carriage(self) -> Tensor:
        """Return how unlike an animal head and tail are carried, squared shares of the body's length, [B].

        A head points forwards and reaches beyond the withers, a tail hangs behind the hips. Outlines alone would fold
        the head into the body and take a raised tail for a neck.
        """
        bones = quadruped(Proportions(self.shape, self.relief), unit=False).bones
        every = max(1, len(self.path) // CARRIAGE_MOMENTS)
        chain = pose(self.joint_angles()[:, ::every, :8], bones[:, None, :8, 0], PARENTS[:8])
        ends = torch.einsum("btjac,bjkc->btjka", chain[..., :3, :3], bones[:, :8]) + chain[..., None, :3, 3]
        nose, poll, withers, tip, hips = (
            ends[:, :, bone, end] for bone, end in ((0, 1), (0, 0), (3, 1), (4, 1), (6, 0))
        )
        length = (bones[:, 3, 1, 2] - bones[:, 6, 0, 2])[:, None]
        head = (bones[:, 0, 1] - bones[:, 0, 0]).norm(dim=-1)[:, None]
        faults = (
            HEAD_FORWARD * head - (nose - poll)[..., 2],
            NOSE_FORWARD * length - (nose - withers)[..., 2],
            POLL_FORWARD * length - (poll - withers)[..., 2],
            (tip - hips)[..., 1],
            (tip - hips)[..., 2],
        )
        return (torch.stack(faults).clamp_min(0) / length).square().mean(2).sum(0)


def _about_x(angle: Tensor) -> Tensor:
    zero, one = torch.zeros_like(angle), torch.ones_like(angle)
    rows = (one, zero, zero, zero, angle.cos(), -angle.sin(), zero, angle.sin(), angle.cos())
    return torch.stack(rows, -1).unflatten(-1, (3, 3))


def _about_y(angle: Tensor) -> Tensor:
    zero, one = torch.zeros_like(angle), torch.ones_like(angle)
    rows = (angle.cos(), zero, angle.sin(), zero, one, zero, -angle.sin(), zero, angle.cos())
    return torch.stack(rows, -1).unflatten(-1, (3, 3))
