"""Pictures of a run: what went in, what came out, what the method never saw."""

import math
from pathlib import Path
from typing import Any

import cv2
import imageio.v2 as imageio
import numpy as np
import torch
from torch import Tensor

from rewild4d.contracts import Reconstruction
from rewild4d.files import atomic
from rewild4d.novel_views import input_camera
from rewild4d.protocol import render
from rewild4d.transforms import axis_angle_to_matrix, look_at
from rewild4d.types import OBJECT_DIAGONAL, Camera, Clip, Frame, Splats, Truth

ROWS = 4
"""Moments shown in the comparison picture."""
PANEL = 320
"""Least width of one panel in pixels."""
ORBIT_FRAMES = 72


def save_pictures(reconstruction: Reconstruction, clip: Clip, truth: Truth, folder: Path) -> list[str]:
    """Write all pictures of a run into ``folder`` and return their names.

    comparison.png  rows are moments; input, render, held-out truth, held-out render
    canonical.png   canonical Gaussians coloured by skinning weight (methods that have them)
    input.mp4       input beside render, in the input view
    orbit.mp4       one turn around the moving animal
    """
    names = ["comparison.png", "input.mp4", "orbit.mp4"]
    save_png(comparison(reconstruction, clip, truth), folder / names[0])
    fps = max(5.0, min(clip.fps, 30.0))
    save_mp4([_beside(frame.over(1.0), _shot(reconstruction, frame)) for frame in clip.frames], folder / names[1], fps)
    save_mp4(orbit(reconstruction, clip), folder / names[2], fps)
    if hasattr(reconstruction, "canonical") and hasattr(reconstruction, "weights"):
        save_png(canonical(reconstruction.canonical(), reconstruction.weights), folder / "canonical.png")
        names.append("canonical.png")
    return names


def comparison(reconstruction: Reconstruction, clip: Clip, truth: Truth) -> Tensor:
    """The comparison picture, [3, H, W]."""
    panels, times = [], [frame.time for frame in truth.held_out]
    for row in range(ROWS):
        frame = clip.frames[row * len(clip.frames) // ROWS]
        held = [i for i, time in enumerate(times) if abs(time - frame.time) < 1e-6]
        images = [frame.over(1.0), _shot(reconstruction, frame)]
        if held:
            other = truth.held_out[held[(len(held) // 3 + row * len(held) // (2 * ROWS)) % len(held)]]
            images += [other.over(1.0), _shot(reconstruction, other)]
        panels.append(torch.cat([_widen(image) for image in images], dim=2))
    titles = ["input", "render", "held-out truth", "held-out render"]
    return torch.cat([_header(titles[: len(images)], panels[0].shape[2]), *panels], dim=1)


def orbit(reconstruction: Reconstruction, clip: Clip) -> list[Tensor]:
    """Images [3, h, w] of one turn around the animal while time runs; empty where no camera is known."""
    cameras = [camera for frame in clip.frames if (camera := input_camera(reconstruction, frame)) is not None]
    if not cameras or len(reconstruction.at(clip.times[0])) == 0:
        return [torch.ones(3, 16, 16)]
    up = torch.nn.functional.normalize(-torch.stack([c.world_to_camera[1, :3] for c in cameras]).mean(0), dim=0)
    middle = reconstruction.at(clip.times[len(clip.times) // 2]).means.double().median(0).values
    first = cameras[0]
    first = first.resized(_even(first.width, PANEL), _even(first.height * PANEL / first.width, 2))
    images = []
    for step in range(ORBIT_FRAMES):
        turn = axis_angle_to_matrix(up * (2 * math.pi * step / ORBIT_FRAMES))
        eye = middle + turn @ (first.center - middle)
        camera = Camera(look_at(eye, middle, up), first.intrinsics, first.width, first.height)
        splats = reconstruction.at(clip.times[step % len(clip.times)])
        images.append(_over_white(splats, camera))
    return images


def canonical(splats: Splats, weights: Tensor) -> Tensor:
    """Canonical Gaussians from the side, obliquely, the front and above, each part in its own colour, [3, H, W]."""
    hues = np.array([[((part * 97) % 180, 200, 235) for part in range(weights.shape[1])]], np.uint8)
    palette = torch.from_numpy(cv2.cvtColor(hues, cv2.COLOR_HSV2RGB)[0]).float() / 255
    colored = Splats(splats.means, splats.quats, splats.scales, splats.opacities, (weights @ palette)[:, None])
    center = splats.means.double().median(0).values
    up, ahead = torch.tensor((0.0, 1.0, 0.0)).double(), torch.tensor((0.0, 0.0, 1.0)).double()
    focal = PANEL * 1.9
    intrinsics = torch.tensor(((focal, 0, PANEL / 2), (0, focal, PANEL / 2), (0, 0, 1.0))).double()
    panels = []
    for direction, top in (((1, 0.1, 0), up), ((0.8, 0.4, 0.8), up), ((0, 0.1, 1), up), ((0, 1, 0), ahead)):
        toward = torch.nn.functional.normalize(torch.tensor(direction).double(), dim=0)
        camera = Camera(look_at(center + 2.4 * OBJECT_DIAGONAL * toward, center, top), intrinsics, PANEL, PANEL)
        panels.append(_over_white(colored, camera))
    return torch.cat([_header(["side", "oblique", "front", "above"], 4 * PANEL), torch.cat(panels, dim=2)], dim=1)


def save_png(image: Tensor, path: Path) -> None:
    """Write an RGB image in [0, 1], [3, h, w], atomically."""
    with atomic(path) as temporary:
        imageio.imwrite(temporary, _bytes(image), format="png")


def save_mp4(images: list[Tensor], path: Path, fps: float) -> None:
    """Write RGB images in [0, 1], each [3, h, w] of one size, as H.264 atomically; odd sizes are padded."""
    settings: Any = {"codec": "libx264", "quality": 8, "macro_block_size": 2, "ffmpeg_log_level": "error"}
    with atomic(path) as temporary:
        imageio.mimwrite(temporary, [_bytes(image) for image in images], fps=fps, **settings)


def _shot(reconstruction: Reconstruction, frame: Frame) -> Tensor:
    """The reconstruction as the frame's camera sees it, on white."""
    camera = input_camera(reconstruction, frame)
    if camera is None:
        return torch.ones_like(frame.rgb)
    return _over_white(reconstruction.at(frame.time), camera)


def _over_white(splats: Splats, camera: Camera) -> Tensor:
    color, alpha = render(splats, camera)
    return (color + 1 - alpha).clamp(0, 1)


def _widen(image: Tensor) -> Tensor:
    """Enlarged by a whole factor to at least `PANEL` pixels."""
    factor = max(1, math.ceil(PANEL / image.shape[2]))
    return image.repeat_interleave(factor, 1).repeat_interleave(factor, 2)


def _beside(left: Tensor, right: Tensor) -> Tensor:
    return torch.cat((_widen(left), _widen(right)), dim=2)


def _header(titles: list[str], width: int) -> Tensor:
    strip = np.full((24, width, 3), 255, np.uint8)
    for i, title in enumerate(titles):
        corner = (i * width // len(titles) + 6, 17)
        cv2.putText(strip, title, corner, cv2.FONT_HERSHEY_SIMPLEX, 0.5, (40, 40, 40), 1, cv2.LINE_AA)
    return torch.from_numpy(strip).permute(2, 0, 1).float() / 255


def _even(value: float, least: int) -> int:
    return max(least, 2 * round(value / 2))


def _bytes(image: Tensor) -> np.ndarray:
    return (image.clamp(0, 1) * 255).round().byte().permute(1, 2, 0).numpy()
