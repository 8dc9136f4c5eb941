"""Tiny pictures and films, as files."""

from pathlib import Path

import imageio.v2 as imageio
import numpy as np
from PIL import Image


def picture(path: Path, size: tuple[int, int] = (8, 6)) -> np.ndarray:
    """Write a picture of some width and height in the format of its suffix, and return its pixels."""
    pixels = np.random.default_rng(1).integers(0, 255, (size[1], size[0], 3), np.uint8)
    with path.open("wb") as file:
        Image.fromarray(pixels).save(file, path.suffix[1:])
    return pixels


def film(path: Path, frames: int = 3) -> None:
    """Write an H.264 film of 32 x 32 pixels."""
    rng = np.random.default_rng(1)
    images = [rng.integers(0, 255, (32, 32, 3), np.uint8) for _ in range(frames)]
    imageio.mimwrite(path, images, format="mp4", fps=10, codec="libx264", ffmpeg_log_level="error")  # type: ignore[call-arg, arg-type]
