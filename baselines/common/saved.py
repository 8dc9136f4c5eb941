"""What a reconstruction by a Gaussian competitor knows beside its model, and how both are written and read."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

import msgspec
import torch
from torch import Tensor, nn

from rewild4d.errors import UserError
from rewild4d.files import atomic, load_tensors, save_tensors
from rewild4d.ours.canonical import NAMES, Gaussians
from rewild4d.ours.motion import camera_between, frame_position, interpolate_similarity
from rewild4d.ours.symmetry import match_times
from rewild4d.texts import read_json
from rewild4d.transforms import transform_splats
from rewild4d.types import Camera, Clip, Prior, Splats

STATE, CONFIG = "state.pt", "config.json"
C = TypeVar("C", bound=msgspec.Struct)


@dataclass(frozen=True)
class Root:
    """Where the method's own frame of reference stands in the world at each frame.

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
        """Return where a time lies among the frames: 1.5 is half-way between the second and the third."""
        return frame_position(self.times, time)

    def in_world(self, splats: Splats, position: float) -> Splats:
        """Return Gaussians moved from the method's frame into the world."""
        matrix = interpolate_similarity(self.object_to_world, position)
        return transform_splats(splats, matrix.to(splats.means.device))

    def camera(self, time: float) -> Camera | None:
        """Return the input camera at a time, in the world; between frames it interpolates."""
        return camera_between(self.cameras, self.position(time))

    def with_frame(self, row: int, time: float) -> "Root":
        """Return the same motion with one frame more, which is row ``row`` then."""
        between = interpolate_similarity(self.object_to_world, self.position(time))
        return Root(
            torch.cat((self.times[:row], self.times.new_tensor((time,)), self.times[row:])),
            torch.cat((self.object_to_world[:row], between[None], self.object_to_world[row:])),
            (*self.cameras[:row], self.camera(time), *self.cameras[row:]),
        )

    def state(self) -> dict[str, Any]:
        """As plain tensors and numbers."""
        cameras = [
            None if camera is None else (camera.world_to_camera, camera.intrinsics, camera.width, camera.height)
            for camera in self.cameras
        ]
        return {"times": self.times, "object_to_world": self.object_to_world, "cameras": cameras}

    @classmethod
    def from_state(cls, state: dict[str, Any]) -> "Root":
        """From what `state` gave."""
        cameras = tuple(None if values is None else Camera(*values) for values in state["cameras"])
        return cls(state["times"], state["object_to_world"], cameras)


def splats_of(own: Gaussians, means: Tensor, quats: Tensor, scales: Tensor) -> Splats:
    """Return Gaussians of one moment with the canonical opacities and colours."""
    quats = nn.functional.normalize(quats, dim=-1)
    return Splats(means, quats, scales, own.opacities(), own.splat_colors(quats))


def gaussians_from_state(state: dict[str, Tensor], max_scale: float) -> Gaussians:
    """Return Gaussians of the shapes in a model's state; their blur is loaded with the model."""
    return Gaussians({name: state[f"gaussians.{name}"] for name in NAMES}, max_scale)


def save_state(folder: Path, state: dict[str, Any], config: msgspec.Struct) -> None:
    """Write a state and its settings into an existing folder."""
    save_tensors(state, folder / STATE)
    with atomic(folder / CONFIG) as path:
        path.write_bytes(msgspec.json.format(msgspec.json.encode(config), indent=2))


def load_state(folder: Path, method: str, config_type: type[C]) -> tuple[dict[str, Any], C]:
    """Read back what `save_state` wrote.

    Raises:
        UserError: a file is missing, or is not what `save_state` writes for this method.
    """
    for name in (STATE, CONFIG):
        if not (folder / name).is_file():
            raise UserError(f"{folder}: expected a reconstruction by '{method}', but it has no {name}.")
    config = read_json(folder / CONFIG, f"a reconstruction by '{method}'", config_type)
    return load_tensors(folder / STATE), config
