"""A reconstruction of four coloured balls, whose colours tell which way it is seen."""

import math
from dataclasses import replace
from pathlib import Path

import torch

from rewild4d.cameras.orbit import orbit_cameras
from rewild4d.types import Camera, Clip, Crop, Frame, Splats


class Signpost:
    """A grey ball with a red one ahead (z), a green one above (y) and a blue one to the left (x), walking ahead."""

    def __init__(self, cameras: dict[float, Camera], step: float = 0.0) -> None:
        self.cameras, self.step = cameras, step

    def at(self, time: float) -> Splats:
        places = torch.tensor(((0, 0, 0), (0, 0, 1.5), (0, 1.0, 0), (0.7, 0, 0.0)))
        colors = torch.tensor(((0.5, 0.5, 0.5), (1, 0, 0), (0, 1, 0), (0, 0, 1.0)))
        moved = places + torch.tensor((0, 0, self.step * time))
        quats = torch.tensor((1.0, 0, 0, 0)).expand(4, 4)
        return Splats(moved, quats, torch.full((4, 3), 0.12), torch.full((4,), 0.95), colors[:, None])

    def camera(self, time: float) -> Camera:
        return self.cameras[time]

    def save(self, folder: Path) -> None: ...


class Posed(Signpost):
    """The same, as a skinned shape that stands turned in the world by a rotation."""

    weights, pivots, parents = torch.ones(4, 1), torch.zeros(1, 3), torch.tensor((-1,))

    def __init__(self, cameras: dict[float, Camera], world: torch.Tensor) -> None:
        super().__init__(cameras)
        self.world = world

    def at(self, time: float) -> Splats:
        splats = super().at(time)
        return replace(splats, means=splats.means @ self.world.float().T)

    def canonical(self) -> Splats:
        return super().at(0.0)

    def articulation(self, time: float) -> tuple[torch.Tensor, torch.Tensor]:
        whole = torch.eye(4).double()
        whole[:3, :3] = 2.0 * self.world
        return torch.eye(4)[None], whole


UP = torch.tensor((0.0, 1.0, 0.0)).double()
TURNED = torch.tensor(((1, 0, 0), (0, 0, -1), (0, 1, 0.0))).double()  # y -> z: the world's up is z
CROP = Crop(0, 0, 64, 100, 64)


def seen_from(toward: tuple[float, float, float], count: int = 3) -> dict[float, Camera]:
    """One camera 8 units away, looking down at the origin, for each moment."""
    intrinsics = torch.tensor(((64.0, 0, 32), (0, 64, 32), (0, 0, 1))).double()
    elevation = math.asin(toward[1] / math.hypot(*toward))
    (camera,) = orbit_cameras(
        torch.zeros(3), 8.0, elevation, intrinsics=intrinsics, width=64, height=64, up=UP,
        ahead=torch.tensor(toward), views=1,
    )  # fmt: skip
    return {float(time): camera for time in range(count)}


def clip_of(cameras: dict[float, Camera], crop: Crop | None) -> Clip:
    blank = torch.zeros(3, 64, 64)
    frames = tuple(Frame(time, None, blank, blank[:1], 0, crop) for time in cameras)
    return Clip("post", "", frames, 1.0, "", "")
