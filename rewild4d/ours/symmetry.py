"""The two mirrored supervision groups: image, camera and prior pose of (m, v, t) (METHOD section 6)."""

import math
from dataclasses import dataclass
from functools import cached_property
from typing import Literal, NamedTuple

import torch
from torch import Tensor
from torch.nn.functional import interpolate

from rewild4d.errors import UserError
from rewild4d.rasterizer.conventions import EPS2D
from rewild4d.transforms import matrix_to_quat, mirror_camera
from rewild4d.types import Camera, Clip, Prior

SIGNS = ((1, 1), (1, -1), (-1, 1), (-1, -1))
"""(m, v): group of the sequence or of its flip, image or mirror image."""


class Key(NamedTuple):
    """One supervised view: group m, image sign v, index of the frame."""

    group: int
    view: int
    frame: int


@dataclass(frozen=True)
class Target:
    """Image and camera of one view.

    Attributes:
        rgb: premultiplied, [3, h, w].
        mask: [1, h, w].
        camera: in the object frame.
        side: square root of the area that image losses are divided by, pixels: side of a padded square box around the
            animal, so that the frame's margins do not change a weight, or of a square as large as the image.
    """

    rgb: Tensor
    mask: Tensor
    camera: Camera
    side: float

    @cached_property
    def eye(self) -> Tensor:
        """Camera centre, [3]."""
        return self.camera.center


class Supervision:
    """All mirrored views of a clip, images on one device, with the prior's poses, on the CPU.

    Attributes:
        frames: number of frames T.
        usable: frames that may be trained from the plain and from the flipped sequence (`Prior.steady`).
        positions: of the frames in the video, held-out ones counted (`frame_positions`), float64, [T].
        reduction: side of a training pixel in pixels of the clip.
        prior_quats: rotation of each joint, for v = +1 and v = -1, [2, T, J, 4].
        prior_shifts: translation about the rest pivot, [2, T, J, 3].
    """

    def __init__(
        self, clip: Clip, prior: Prior, size: int, device: torch.device, mean_over: Literal["box", "image"] = "box"
    ) -> None:
        rows = match_times(clip, prior)
        self.frames = len(clip.frames)
        steady = torch.ones(2, self.frames) if prior.steady is None else prior.steady[:, rows]
        self.usable = tuple(torch.nonzero(marks)[:, 0].tolist() for marks in steady)
        self.positions = frame_positions(torch.tensor(clip.times, dtype=torch.float64))
        longest = max(clip.frames[0].mask.shape[-2:])
        self.reduction = max(1.0, longest / size)
        self._targets: dict[Key, Target] = {}
        for index, (frame, row) in enumerate(zip(clip.frames, rows, strict=True)):
            rgb, mask = (_reduced(image, size).to(device) for image in (frame.rgb, frame.mask))
            plain, flip = (
                _check_camera(cameras[row], frame.mask).resized(mask.shape[2], mask.shape[1])
                for cameras in (prior.cameras, prior.cameras_flip)
            )
            box = animal_side(mask, clip.name, index)
            side = box if mean_over == "box" else math.sqrt(mask.shape[1] * mask.shape[2])
            image, mirrored = (rgb, mask), (rgb.flip(-1), mask.flip(-1))
            choices = {
                (1, 1): (image, plain),
                (1, -1): (mirrored, mirror_camera(plain)),
                (-1, 1): (image, mirror_camera(flip)),
                (-1, -1): (mirrored, flip),
            }
            for (group, view), ((colour, matte), camera) in choices.items():
                self._targets[Key(group, view, index)] = Target(colour.contiguous(), matte.contiguous(), camera, side)
        chosen = torch.stack((prior.transforms[rows], prior.transforms_flip[rows])).float()
        pivots = prior.bones[:, 0].float()
        self.prior_quats = matrix_to_quat(chosen[..., :3, :3])
        moved = (chosen[..., :3, :3] @ pivots[..., None])[..., 0] + chosen[..., :3, 3]
        self.prior_shifts = moved - pivots

    def target(self, key: Key) -> Target:
        """Return image, matte and camera of one view."""
        return self._targets[key]

    def prior_pose(self, keys: list[Key]) -> tuple[Tensor, Tensor]:
        """Return the prior's poses of views, P for v = +1 and P_flip for v = -1 whatever m: [B, J, 4] and [B, J, 3]."""
        side = torch.tensor([int(key.view < 0) for key in keys])
        frame = torch.tensor([key.frame for key in keys])
        return self.prior_quats[side, frame], self.prior_shifts[side, frame]

    def code_times(self, keys: list[Key], noise: float = 0.0) -> Tensor:
        """Return the times of views for the time code, all later by a share ``noise`` of a frame, in (0, 1], [B]."""
        last = float(self.positions[-1])
        return torch.tensor([(float(self.positions[key.frame]) + 1 + noise) / (last + 1) for key in keys])

    def frame_times(self) -> Tensor:
        """Return the times of the clip's frames for the time code, in (0, 1], [T]."""
        return self.code_times([Key(1, 1, index) for index in range(self.frames)])

    def pixel(self) -> float:
        """Return the side of a pixel at the object frame's origin, median over the frames, in object units."""
        cameras = [self._targets[Key(1, 1, index)].camera for index in range(self.frames)]
        return float(torch.stack([each.world_to_camera[2, 3] / each.intrinsics[0, 0] for each in cameras]).median())

    def missing_blur(self) -> float:
        """Return the standard deviation by which the clip's own images blur less than those of the training, object
        units.

        The rasterizer widens every Gaussian by a share of a pixel. Trained on reduced images, an animal would be thin
        and full of holes in finer ones, whose pixels are smaller. 0 where nothing was reduced.
        """
        return self.pixel() * math.sqrt(EPS2D * (1 - 1 / self.reduction**2))

    def draw(self, generator: torch.Generator, mirrored: float = 0.5, cameras: str = "both") -> Key:
        """Draw a view: a group, one of its usable frames, and its image or, in a share of the draws, its mirror image.

        With "own" cameras the image decides the group: m = v.
        """
        half, frame = (int(torch.randint(count, (), generator=generator)) for count in (2, self.frames))
        view = -1 if float(torch.rand((), generator=generator)) < mirrored else 1
        group = view if cameras == "own" else 1 - 2 * half
        group = group if self.frames_of(group) else -group
        frames = self.frames_of(group)
        if len(frames) < self.frames:
            frame = frames[int(torch.randint(len(frames), (), generator=generator))]
        return Key(group, view, frame)

    def frames_of(self, group: int) -> list[int]:
        """Return the frames that group m = 1 or -1 is trained from."""
        return self.usable[0 if group > 0 else 1]


def frame_positions(times: Tensor) -> Tensor:
    """Return seconds since the first frame over the usual (median) step: where each frame is in the video, from 0, with
    frames between that the clip lacks, [T] -> [T]."""
    return (times - times[0]) / times.diff().median()


def match_times(clip: Clip, prior: Prior) -> list[int]:
    """Return the prior's row for each frame of the clip.

    Raises:
        UserError: fewer than two frames, or a frame outside the prior.
    """
    if len(clip.frames) < 2:
        raise UserError(f"{clip.name}: expected a clip of at least 2 frames, got {len(clip.frames)}.")
    rows = []
    for index, time in enumerate(clip.times):
        distance = (prior.times - time).abs()
        row = int(distance.argmin())
        if float(distance[row]) > 0.25 / clip.fps:
            raise UserError(
                f"{clip.name}: expected a prior that knows frame {index} at {time:.3f} s, "
                f"but prior '{prior.name}' covers {float(prior.times.min()):.3f} to {float(prior.times.max()):.3f} s "
                f"and comes no closer than {float(distance[row]):.3f} s."
            )
        rows.append(row)
    return rows


def animal_side(mask: Tensor, name: str, index: int) -> float:
    """Return the side of the square box around the animal, padded by 15 % each way, pixels.

    Raises:
        UserError: the mask is empty.
    """
    rows, columns = (mask[0] > 0.5).nonzero().unbind(1)
    if len(rows) == 0:
        raise UserError(f"{name}: expected an animal in every frame, but the mask of frame {index} is empty.")
    extent = max(int(rows.max() - rows.min()), int(columns.max() - columns.min())) + 1
    return 1.3 * extent


def _reduced(image: Tensor, size: int) -> Tensor:
    """Reduce the image to a longest side of at most ``size``, area-averaged, [c, h, w]."""
    height, width = image.shape[1:]
    if max(height, width) <= size:
        return image.float()
    scale = size / max(height, width)
    shape = (max(1, round(height * scale)), max(1, round(width * scale)))
    return interpolate(image[None].float(), shape, mode="area")[0]


def _check_camera(camera: Camera, mask: Tensor) -> Camera:
    if (camera.height, camera.width) != tuple(mask.shape[1:]):
        raise UserError(
            f"the prior's cameras are for images of {camera.width}x{camera.height} pixels, "
            f"but the clip's are {mask.shape[2]}x{mask.shape[1]}."
        )
    return camera
