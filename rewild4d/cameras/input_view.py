"""Find the camera of an input frame, the world's up direction, and the Gaussians at a time."""

from collections.abc import Sequence

import torch
from torch import Tensor

from rewild4d.contracts import Reconstruction
from rewild4d.errors import UserError
from rewild4d.types import Camera, Clip, Frame, Splats


def finite_at(reconstruction: Reconstruction, time: float) -> Splats:
    """Return the Gaussians at a time; UserError where they hold a NaN or an infinite value."""
    splats = reconstruction.at(time)
    for name in ("means", "quats", "scales", "opacities", "colors"):
        if not bool(torch.isfinite(getattr(splats, name)).all()):
            raise UserError(f"the reconstruction's {name} at {time:.4f} s hold a NaN or an infinite value.")
    return splats


def input_camera(reconstruction: Reconstruction, frame: Frame) -> Camera | None:
    """Return the world camera of a frame, from the data set or else the reconstruction, at the frame's size."""
    camera = frame.camera or reconstruction.camera(frame.time)
    height, width = frame.mask.shape[1:]
    if camera is None or (camera.width, camera.height) == (width, height):
        return camera
    return camera.resized(width, height)


def world_up(clip: Clip, cameras: Sequence[Camera], known: Tensor | None) -> Tensor:
    """Return the direction that points up in the world, unit, float64, [3].

    Of footage the world is the prior's object frame, whose y points up. Where unknown, it is the mean of the cameras'
    own up: right for a ring of cameras, tilted by its elevation for a single one.

    Args:
        clip: input of the cameras.
        cameras: of its frames, at least one.
        known: by the data set, [3].
    """
    if known is None and all(frame.crop is not None for frame in clip.frames):
        known = torch.tensor((0.0, 1.0, 0.0))
    return mean_up(cameras) if known is None else torch.nn.functional.normalize(known.double(), dim=0)


def mean_up(cameras: Sequence[Camera]) -> Tensor:
    axes = torch.stack([-camera.world_to_camera[1, :3] for camera in cameras])
    return torch.nn.functional.normalize(axes.double().mean(0), dim=0)
