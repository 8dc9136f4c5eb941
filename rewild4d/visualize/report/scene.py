"""Collect what the page's player shows: Gaussians, the film's frames and cameras, where the animal is."""

import base64
import io
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from PIL import Image
from torch import Tensor

from rewild4d.cameras.input_view import input_camera
from rewild4d.contracts import Reconstruction
from rewild4d.rasterizer.conventions import EPS2D
from rewild4d.types import Camera, Clip, Frame
from rewild4d.visualize.report.clouds import Collected, collect
from rewild4d.visualize.report.layout import Cloud, pack
from rewild4d.visualize.turntable import find_framing

FILM_SIDE = 256
"""Longest side of the film's frames in the page, pixels."""
FILM_QUALITY = 75
"""Of their JPEG."""


@dataclass(frozen=True)
class Scene:
    """What the player needs, as the page holds it.

    Attributes:
        facts: times, cameras, framing and film, for JSON.
        splats: the Gaussians, packed (`layout`).
        collected: what was packed.
    """

    facts: dict[str, Any]
    splats: bytes
    collected: Collected


def make_scene(reconstruction: Reconstruction, clip: Clip, up: Tensor | None, most: int) -> Scene | None:
    """Collect a clip's moments; None where the reconstruction has no Gaussians that are visible.

    Args:
        reconstruction: of the clip.
        clip: the film.
        up: of the world, where the data set knows it, [3].
        most: moments, evenly spaced over the film; a shorter film has all of its own.

    Raises:
        UserError: the reconstruction answers with values that are not finite.
    """
    count = len(clip.frames)
    rows = sorted({round(row) for row in np.linspace(0, count - 1, min(most, count))})
    clip = clip.only(rows)
    cameras = [input_camera(reconstruction, frame) for frame in clip.frames]
    collected = collect(reconstruction, clip.times, cameras)
    if not any(map(len, collected.clouds)):
        return None
    height, width = clip.frames[0].mask.shape[1:]
    facts = {
        "times": list(clip.times), "duration": clip.times[-1] + _spacing(clip), "eps2d": EPS2D,
        "width": width, "height": height, "cameras": [_camera(camera) for camera in cameras],
        "film": [_jpeg(frame) for frame in clip.frames], **_framing(reconstruction, clip, up, collected.clouds),
    }  # fmt: skip
    return Scene(facts, pack(collected.clouds), collected)


def _spacing(clip: Clip) -> float:
    """Return for how long the last moment is shown, seconds."""
    return (clip.times[-1] - clip.times[0]) / (len(clip.times) - 1) if len(clip.times) > 1 else 1 / clip.fps


def _framing(reconstruction: Reconstruction, clip: Clip, up: Tensor | None, clouds: Sequence[Cloud]) -> dict[str, Any]:
    """Return centre at each moment, radius, up, and a direction to look from."""
    framing = find_framing(reconstruction, clip, up)
    if framing is not None:
        moment = len(clip.times) // 2
        center, eye = framing.middles[moment], framing.camera(moment, framing.azimuth).center
        return {
            "centers": framing.middles.tolist(), "radius": framing.radius, "up": framing.axes[0][1].tolist(),
            "from": torch.nn.functional.normalize(eye - center, dim=0).tolist(),
        }  # fmt: skip
    boxes = [(means.min(0), means.max(0)) for cloud in clouds if len(cloud) for means in cloud.tracks["means"]]
    low, high = np.min([low for low, _ in boxes], 0), np.max([high for _, high in boxes], 0)
    middle, radius = (low + high) / 2, float(np.linalg.norm(high - low)) / 2
    vertical = (0.0, 1.0, 0.0) if up is None else torch.nn.functional.normalize(up.double(), dim=0).tolist()
    side = np.cross(vertical, (1.0, 0.0, 0.0) if abs(vertical[0]) < 0.9 else (0.0, 0.0, 1.0))
    return {"centers": [middle.tolist()] * len(clip.times), "radius": max(radius, 1e-6), "up": list(vertical),
            "from": (side / np.linalg.norm(side)).tolist()}  # fmt: skip


def _camera(camera: Camera | None) -> dict[str, Any] | None:
    """Return a camera as JSON has it: OpenCV axes, rows of world_to_camera, pixels."""
    if camera is None:
        return None
    (fx, _, cx), (_, fy, cy), _ = camera.intrinsics.tolist()
    return {
        "world_to_camera": camera.world_to_camera.flatten().tolist(), "fx": fx, "fy": fy, "cx": cx, "cy": cy,
        "width": camera.width, "height": camera.height,
    }  # fmt: skip


def _jpeg(frame: Frame) -> str:
    """Return the frame on white as the base64 of a small JPEG."""
    pixels = (frame.over(1.0).clamp(0, 1) * 255).round().byte().permute(1, 2, 0).numpy()
    return jpeg(Image.fromarray(pixels), FILM_SIDE, FILM_QUALITY)


def jpeg(image: Image.Image, side: int, quality: int) -> str:
    """Return a picture as the base64 of a JPEG whose longer side is at most ``side`` pixels."""
    small = image.convert("RGB")
    small.thumbnail((side, side), Image.Resampling.LANCZOS)
    data = io.BytesIO()
    small.save(data, "JPEG", quality=quality, optimize=True)
    return base64.b64encode(data.getvalue()).decode()
