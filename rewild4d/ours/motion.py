"""Root motion and input cameras between the frames of a clip."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from rewild4d.ours.symmetry import match_times
from rewild4d.priors.motion import blend_similarities
from rewild4d.transforms import between_intrinsics, transform_splats
from rewild4d.types import Camera, Clip, Prior, Splats


@dataclass(frozen=True)
class Root:
    """Transform from a method's frame of reference to the world at each frame of a clip, and the input cameras.

    Attributes:
        times: of the clip's frames in seconds, float64, [T].
        object_to_world: similarity at each frame, float64, [T, 4, 4].
        cameras: the input cameras in the world, or None where the clip has none.
    """

    times: Tensor
    object_to_world: Tensor
    cameras: tuple[Camera | None, ...]

    @classmethod
    def of(cls, clip: Clip, prior: Prior) -> "Root":
        """Return the prior's root at the clip's frames."""
        rows = match_times(clip, prior)
        times = torch.tensor(clip.times, dtype=torch.float64)
        return cls(times, prior.object_to_world[rows].double(), tuple(frame.camera for frame in clip.frames))

    def position(self, time: float) -> float:
        """Return `frame_position` of a time in seconds."""
        return frame_position(self.times, time)

    def code_time(self, time: float) -> float:
        """Return a time in seconds, no earlier than the first frame and no later than the last, for the time code, as
        `Supervision.code_times` has it at the frames."""
        first, last = float(self.times[0]), float(self.times[-1])
        step = float(self.times.diff().median())
        return (min(max(time, first), last) - first + step) / (last - first + step)

    def in_world(self, splats: Splats, position: float) -> Splats:
        """Transform Gaussians at a position from the method's frame to the world."""
        matrix = interpolate_similarity(self.object_to_world, position)
        return transform_splats(splats, matrix.to(splats.means.device))

    def camera(self, time: float) -> Camera | None:
        """Return the input camera at a time, in the world; between frames it interpolates."""
        return camera_between(self.cameras, self.position(time))

    def with_frame(self, row: int, time: float) -> "Root":
        """Insert an interpolated frame at index ``row``."""
        between = interpolate_similarity(self.object_to_world, self.position(time))
        return Root(
            torch.cat((self.times[:row], self.times.new_tensor((time,)), self.times[row:])),
            torch.cat((self.object_to_world[:row], between[None], self.object_to_world[row:])),
            (*self.cameras[:row], self.camera(time), *self.cameras[row:]),
        )

    def state(self) -> dict[str, Any]:
        """Return what `from_state` takes: tensors and numbers."""
        cameras = [
            None if camera is None else (camera.world_to_camera, camera.intrinsics, camera.width, camera.height)
            for camera in self.cameras
        ]
        return {"times": self.times, "object_to_world": self.object_to_world, "cameras": cameras}

    @classmethod
    def from_state(cls, state: dict[str, Any]) -> "Root":
        """Restore from `state`."""
        cameras = tuple(None if values is None else Camera(*values) for values in state["cameras"])
        return cls(state["times"], state["object_to_world"], cameras)


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
