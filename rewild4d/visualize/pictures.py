"""Draw a render on a background, lay panels side by side, write PNG and MP4 files."""

import math
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import cv2
import imageio.v2 as imageio
import numpy as np
import torch
from torch import Tensor

from rewild4d.cameras.rendering import render
from rewild4d.files import atomic
from rewild4d.types import Camera, Splats

PANEL = 320
"""Least width of one panel in pixels."""


def save_png(image: Tensor, path: Path) -> None:
    """Write an RGB image in [0, 1], [3, h, w], atomically."""
    with atomic(path) as temporary:
        imageio.imwrite(temporary, to_bytes(image), format="png")


def save_mp4(images: Iterable[Tensor], path: Path, fps: float, quality: int = 8) -> None:
    """Write RGB images in [0, 1], each [3, h, w] of one size, as H.264 atomically; odd sizes are padded.

    Args:
        images: read one at a time, so that a long film need not fit into memory.
        path: of the film.
        fps: frames a second.
        quality: 1 to 10.
    """
    settings: Any = {"codec": "libx264", "quality": quality, "macro_block_size": 2, "ffmpeg_log_level": "error"}
    with atomic(path) as temporary:
        writer: Any = imageio.get_writer(temporary, fps=fps, **settings)
        with writer:
            for image in images:
                writer.append_data(to_bytes(image))


def film_rate(fps: float) -> float:
    """Return a film's frames a second: the clip's, between 5 and 30."""
    return max(5.0, min(fps, 30.0))


def over(splats: Splats, camera: Camera, background: float | Tensor = 1.0) -> Tensor:
    """Render on a background (a number, or an image [3, h, w]), [3, h, w]."""
    color, alpha = render(splats, camera)
    return (color + (1 - alpha) * background).clamp(0, 1)


def beside(*images: Tensor) -> Tensor:
    """Lay images of one height side by side, each enlarged by a whole factor to at least `PANEL` pixels."""
    factors = [max(1, math.ceil(PANEL / image.shape[2])) for image in images]
    wide = [image.repeat_interleave(n, 1).repeat_interleave(n, 2) for image, n in zip(images, factors, strict=True)]
    return torch.cat(wide, dim=2)


def header(titles: Sequence[str], width: int) -> Tensor:
    """Draw a white strip with a title over each of as many equal columns, [3, 24, width]."""
    strip = np.full((24, width, 3), 255, np.uint8)
    for i, title in enumerate(titles):
        corner = (i * width // len(titles) + 6, 17)
        cv2.putText(strip, title, corner, cv2.FONT_HERSHEY_SIMPLEX, 0.5, (40, 40, 40), 1, cv2.LINE_AA)
    return torch.from_numpy(strip).permute(2, 0, 1).float() / 255


def part_colors(parts: int) -> Tensor:
    """Return colours by which the parts of a body are told apart, RGB in [0, 1], float64, [parts, 3]."""
    hues = np.array([[((part * 97) % 180, 200, 235) for part in range(parts)]], np.uint8)
    return torch.from_numpy(cv2.cvtColor(hues, cv2.COLOR_HSV2RGB)[0]).double() / 255


def even(value: float, least: int = 2) -> int:
    """Round to an even number, which films need, of at least the least."""
    return max(least, 2 * round(value / 2))


def to_bytes(image: Tensor) -> np.ndarray:
    """Return an RGB image in [0, 1], [3, h, w], as bytes, uint8 [h, w, 3]."""
    return (image.clamp(0, 1) * 255).round().byte().permute(1, 2, 0).numpy()
