"""Root motion and input cameras between the frames of a clip."""

from collections.abc import Sequence
from dataclasses import replace

import torch
from torch import Tensor

from rewild4d.priors.motion import blend_similarities
from rewild4d.transforms import between_intrinsics
from rewild4d.types import Camera


def frame_position(times: Tensor, time: float) -> float:
    """Return the position of a time in seconds among ``times`` [T], clamped: 1.5 is between frames 1 and 2."""
    if len(times) == 1 or time <= float(times[0]):
        return 0.0
    if time >= float(times[-1]):
        return float(len(times) - 1)
    after = int(torch.searchsorted(times, torch.tensor(time, dtype=times.dtype), right=True))
    before, low = after - 1, float(times[after - 1])
    return before + (time - low) / (float(times[after]) - low)


def interpolate_similarity(matrices: Tensor, position: float) -> Tensor:
    """Interpolate similarities [T, 4, 4] at a position from `frame_position`, [4, 4]; exact at a frame."""
    low = int(position)
    part = position - low
    if part == 0:
        return matrices[low]
    return blend_similarities(matrices[low], matrices[low + 1], part)


def camera_between(cameras: Sequence[Camera | None], position: float) -> Camera | None:
    """Interpolate the frames' cameras at a position from `frame_position`; None where a neighbour is unknown."""
    low = int(position)
    part = position - low
    first = cameras[low]
    if part == 0 or first is None:
        return first
    second = cameras[low + 1]
    if second is None:
        return None
    matrices = torch.stack((first.world_to_camera, second.world_to_camera))
    return replace(
        first,
        world_to_camera=interpolate_similarity(matrices, part),
        intrinsics=between_intrinsics(first.intrinsics, second.intrinsics, part),
    )
