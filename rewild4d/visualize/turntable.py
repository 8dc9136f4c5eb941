"""Draw an orbit around the animal, upright and centred: a film over time, and a still from four sides.

Axes are the animal's own, x left, y up, z ahead, where they are known: from the reconstruction, if it is a skinned
shape, or from the prior, whose object frame is the world of a video without cameras. Else up is the data set's or the
input cameras', and "ahead" is unknown: the still then shows quarter rotations from the input camera.
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass

import torch
from scipy.signal import savgol_filter
from torch import Tensor
from torch.nn.functional import normalize

from rewild4d.cameras.input_view import input_camera, world_up
from rewild4d.cameras.orbit import first_across, orbit_cameras
from rewild4d.contracts import Articulated, Reconstruction
from rewild4d.types import Camera, Clip, Splats
from rewild4d.visualize.pictures import PANEL, header, over

STEPS = 72
"""Frames of one orbit."""
FIELD_OF_VIEW = math.radians(25)
ELEVATIONS = (0.0, math.radians(30))
"""Bounds of the camera's elevation: from below or straight above little is visible."""
INSIDE = 0.998
"""Share of the visible Gaussians inside the picture; the rest are stray."""
MARGIN = 1.03
"""Factor of the radius."""
STEADY = 0.8
"""Share of the times on one side from which on the input camera has a side of its own; less, and it moved around."""
WINDOW = 9
"""Times over which the centre is smoothed; odd."""


@dataclass(frozen=True)
class Framing:
    """Position and size of the animal, and direction of the input camera.

    Attributes:
        middles: centre at each of the clip's times, world, float64, [T, 3].
        axes: left, up and ahead at each time, unit rows, world, float64, [T, 3, 3].
        known: whether "ahead" is the animal's.
        radius: of a ball around it, world units.
        azimuth: of the input camera about up, from ahead towards left, radians.
        steady: share of the times at which the input camera was on its main side.
        elevation: of the input camera, within `ELEVATIONS`, radians.
    """

    middles: Tensor
    axes: Tensor
    known: bool
    radius: float
    azimuth: float
    steady: float
    elevation: float

    def camera(self, moment: int, azimuth: float) -> Camera:
        """Return a camera on the circle, looking at the centre."""
        left, up, ahead = self.axes[moment]
        focal = PANEL / 2 / math.tan(FIELD_OF_VIEW / 2)
        intrinsics = torch.tensor(((focal, 0, PANEL / 2), (0, focal, PANEL / 2), (0, 0, 1))).double()
        (camera,) = orbit_cameras(
            self.middles[moment], self.radius / math.sin(FIELD_OF_VIEW / 2), self.elevation, intrinsics=intrinsics,
            width=PANEL, height=PANEL, up=up, ahead=math.cos(azimuth) * ahead + math.sin(azimuth) * left, views=1,
        )  # fmt: skip
        return camera


def find_framing(reconstruction: Reconstruction, clip: Clip, up: Tensor | None) -> Framing | None:
    """Find position and size of the animal; None without Gaussians or without a camera.

    Args:
        reconstruction: of the clip.
        clip: its input.
        up: of the world, where the data set knows it, [3].
    """
    cameras = [camera for frame in clip.frames if (camera := input_camera(reconstruction, frame)) is not None]
    clouds = [solid(reconstruction.at(time)) for time in clip.times]
    if not cameras or not all(len(means) for means, _ in clouds):
        return None
    # The box's centre, not the median, which is in the trunk: legs and head are in the picture too.
    middles = _smooth(torch.stack([_box_middle(means) for means, _ in clouds]))
    axes, known = _axes(reconstruction, clip, cameras, middles, up)
    extents = [(means - middle).norm(dim=1) + size for (means, size), middle in zip(clouds, middles, strict=True)]
    radius = max(float(torch.quantile(extent, INSIDE)) for extent in extents)
    if len(cameras) < len(clip.times):  # some are unknown: the first represents them
        cameras = cameras[:1]
    offsets = torch.stack([axes[i] @ (camera.center - middles[i]) for i, camera in enumerate(cameras)])
    offset = normalize(offsets, dim=1).mean(0)
    elevation = math.atan2(float(offset[1]), float(offset[[0, 2]].norm()))
    azimuth = math.atan2(float(offset[0]), float(offset[2]))
    steady = float((offsets[:, 0] * offset[0] > 0).double().mean())
    elevation = min(max(elevation, ELEVATIONS[0]), ELEVATIONS[1])
    return Framing(middles, axes, known, max(MARGIN * radius, 1e-6), azimuth, steady, elevation)


def orbit_frames(reconstruction: Reconstruction, clip: Clip, framing: Framing | None) -> Iterator[Tensor]:
    """Render images [3, PANEL, PANEL] of one orbit over time from the input camera on; without framing, a white one."""
    for step in range(STEPS if framing else 1):
        moment = step % len(clip.times)
        if framing is None:
            yield torch.ones(3, PANEL, PANEL)
        else:
            camera = framing.camera(moment, framing.azimuth + 2 * math.pi * step / STEPS)
            yield over(reconstruction.at(clip.times[moment]), camera)


def four_views(reconstruction: Reconstruction, clip: Clip, framing: Framing | None) -> Tensor:
    """Draw the side that the camera saw, front, other side and behind, at the clip's middle time, [3, H, 4 PANEL]."""
    if framing is None:
        titles, images = ["no Gaussians, or no camera"], [torch.ones(3, PANEL, PANEL)] * 4
    else:
        moment = len(clip.times) // 2
        splats = reconstruction.at(clip.times[moment])
        sides = _sides(framing)
        titles = list(sides)
        images = [over(splats, framing.camera(moment, azimuth)) for azimuth in sides.values()]
    return torch.cat([header(titles, 4 * PANEL), torch.cat(images, dim=2)], dim=1)


def _sides(framing: Framing) -> dict[str, float]:
    """Return title -> azimuth of each still view."""
    quarter = math.pi / 2
    if not framing.known:
        return {
            "input camera": framing.azimuth, "a quarter turn on": framing.azimuth + quarter,
            "half a turn": framing.azimuth + 2 * quarter, "three quarters": framing.azimuth + 3 * quarter,
        }  # fmt: skip
    is_left = math.sin(framing.azimuth) > 0
    seen, other = ("left", "right") if is_left else ("right", "left")
    side = quarter if is_left else -quarter
    said = " (the camera's)" if framing.steady >= STEADY else ""
    return {f"{seen} side{said}": side, "front": 0.0, f"{other} side": -side, "behind": math.pi}


def _axes(
    reconstruction: Reconstruction, clip: Clip, cameras: list[Camera], middles: Tensor, up: Tensor | None
) -> tuple[Tensor, bool]:
    """Return left, up and ahead at each time, [T, 3, 3], and whether they are the animal's own."""
    if isinstance(reconstruction, Articulated):
        worlds = torch.stack([reconstruction.articulation(time)[1][:3, :3].double().cpu() for time in clip.times])
        return normalize(worlds, dim=1).transpose(1, 2), True
    count = len(clip.times)
    if all(frame.crop is not None for frame in clip.frames):  # footage: the prior's object frame is the world
        return torch.eye(3).double().expand(count, 3, 3), True
    up = world_up(clip, cameras, up)
    toward = first_across((cameras[0].center - middles[0])[None], up)
    ahead = normalize(toward - (toward @ up) * up, dim=0)
    return torch.stack((torch.linalg.cross(up, ahead), up, ahead)).expand(count, 3, 3), False


def solid(splats: Splats) -> tuple[Tensor, Tensor]:
    """Return centres and radii of the visible Gaussians, float64, [n, 3] and [n]; of all where none is visible."""
    shown = splats.opacities.detach().cpu() > 0.1
    means, radii = splats.means.detach().double().cpu(), 2 * splats.scales.detach().double().cpu().amax(-1)
    return (means[shown], radii[shown]) if bool(shown.any()) else (means, radii)


def _smooth(middles: Tensor) -> Tensor:
    """Fit a line through the neighbouring times of each centre, so that a stride does not shake the picture, [T, 3]."""
    window = min(WINDOW, len(middles) - 1 + len(middles) % 2)
    return middles if window < 3 else torch.from_numpy(savgol_filter(middles.numpy(), window, 1, axis=0))


def _box_middle(cloud: Tensor) -> Tensor:
    """Return the centre of the box that holds all but stray points, [3]."""
    ends = torch.tensor(((1 - INSIDE) / 2, (1 + INSIDE) / 2), dtype=torch.float64)
    return torch.quantile(cloud, ends, dim=0).mean(0)
