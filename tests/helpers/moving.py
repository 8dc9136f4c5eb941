"""A small film: a red animal with four legs walks over a green meadow; its masks are known."""

import json
import subprocess
from pathlib import Path

import cv2
import imageio_ffmpeg
import numpy as np
from PIL import Image

SIZE = (96, 64)
VOC = [0, 0, 0, 128, 0, 0, 0, 128, 0, 128, 128, 0]


def mask(index: int, size: tuple[int, int] = SIZE, left: float = 20.0, step: float = 1.0) -> np.ndarray:
    """The animal at a frame, uint8 0 or 255, [h, w]; ``left`` is its middle at frame 0."""
    canvas = np.zeros((size[1], size[0]), np.uint8)
    unit = min(size) / 64
    x, y = left * unit + step * unit * index, 30 * unit
    cv2.ellipse(canvas, (round(x), round(y)), (round(14 * unit), round(8 * unit)), 0, 0, 360, 255, -1)
    for leg in (-10, -5, 5, 10):
        corner = (round(x + (leg - 1.5) * unit), round(y))
        cv2.rectangle(canvas, corner, (round(x + (leg + 1.5) * unit), round(y + 16 * unit)), 255, -1)
    return canvas


def image(index: int, size: tuple[int, int] = SIZE, **where: float) -> np.ndarray:
    """The frame, RGB uint8 [h, w, 3]."""
    ramp = np.linspace(60, 120, size[0]).astype(np.uint8)[None, :, None]
    picture = np.broadcast_to(ramp, (size[1], size[0], 3)) // np.array((3, 1, 3), np.uint8)
    return np.where(mask(index, size, **where)[..., None] > 0, np.array((200, 40, 30), np.uint8), picture)


def save(path: Path, pixels: np.ndarray, mode: str | None = None) -> Path:
    """Write an image; mode "P" writes indices with DAVIS's palette."""
    path.parent.mkdir(parents=True, exist_ok=True)
    picture = Image.fromarray(pixels)
    if mode == "P":
        picture = Image.fromarray(pixels, mode="P")
        picture.putpalette(VOC + [0] * (768 - len(VOC)))
    picture.save(path)
    return path


def frames(folder: Path, count: int = 12, size: tuple[int, int] = SIZE, suffix: str = "png", **where: float) -> Path:
    """A folder of frames 00000.png, ..."""
    for i in range(count):
        save(folder / f"{i:05d}.{suffix}", image(i, size, **where))
    return folder


def masks(folder: Path, count: int = 12, size: tuple[int, int] = SIZE, **where: float) -> Path:
    """A folder of grey masks 00000.png, ..."""
    for i in range(count):
        save(folder / f"{i:05d}.png", mask(i, size, **where))
    return folder


def davis(
    root: Path, name: str = "camel", count: int = 12, values: tuple[int, int] = (0, 255), mode: str = "L"
) -> Path:
    """A DAVIS folder with one sequence whose masks hold two values."""
    frames(root / "JPEGImages" / "480p" / name, count, suffix="jpg")
    for i in range(count):
        indices = np.where(mask(i) > 0, values[1], values[0]).astype(np.uint8)
        save(root / "Annotations" / "480p" / name / f"{i:05d}.png", indices, mode)
    return root


def ffmpeg(*words: object) -> None:
    """Run ffmpeg quietly."""
    command = [imageio_ffmpeg.get_ffmpeg_exe(), "-y", "-loglevel", "error", "-nostdin", *map(str, words)]
    subprocess.run(command, check=True)


def film(path: Path, source: Path, *settings: object, fps: float = 10) -> Path:
    """A video of a folder of frames."""
    path.parent.mkdir(parents=True, exist_ok=True)
    ffmpeg("-framerate", fps, "-i", source / "%05d.png", *settings, path)
    return path


def apt(root: Path, count: int = 12, with_masks: bool = True, **changes: object) -> Path:
    """An APTv2 folder: one wolf (track 3) in one clip, and an image that no annotation names."""
    clip, pictures, entries = "easy/29wolf/v1C1", [], []
    for i in range(count):
        save(root / "data" / clip / f"{i:04d}.jpg", image(i))
        if with_masks:
            save(root / "masks" / clip / f"{i:04d}_3.png", mask(i))
        pictures.append(
            {"id": i, "file_name": f"{clip}/{i:04d}.jpg", "width": SIZE[0], "height": SIZE[1], "video_id": 7}
        )
        points = [0, 0, 0] * 16 + [20 + i, 30, 2]
        entries.append(
            {"id": 100 + i, "image_id": i, "category_id": 1, "video_id": 7, "track_id": 3, "bbox": [5 + i, 22, 30, 26],
             "keypoints": points, "num_keypoints": 40, **changes}
        )  # fmt: skip
    pictures.append({"id": 999, "file_name": "hard/1cat/v9C1/0000.jpg", "width": 10, "height": 10, "video_id": 8})
    table = {"images": pictures, "annotations": entries, "categories": [{"id": 1, "name": "wolf"}]}
    (root / "annotations").mkdir(parents=True, exist_ok=True)
    (root / "annotations" / "train_annotations.json").write_text(json.dumps(table))
    return root
