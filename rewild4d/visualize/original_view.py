"""Draw a reconstruction in the original frames that its clip was cut from, beside these.

The animal itself is removed from the frame before the render is laid on it, so that missing parts of the
reconstruction are white, and not the filmed animal.
"""

from collections.abc import Iterable, Iterator
from itertools import repeat
from pathlib import Path

import cv2
import numpy as np
import torch
from torch import Tensor

from rewild4d.cameras.input_view import input_camera
from rewild4d.contracts import DatasetReader, Reconstruction, Selection
from rewild4d.errors import UserError
from rewild4d.types import Clip, Crop, Frame
from rewild4d.visualize.pictures import beside, even, film_rate, header, over, save_mp4, save_png

LONGEST = 960
"""Longer side of shown original frames in pixels."""
QUALITY = 6
"""Of the film: frames with their background are large files."""
SHEET = 6
"""Times on the contact sheet, two a row."""
SHEET_WIDTH = 360


def original_frames(reader: DatasetReader, clip: Clip, selection: Selection) -> Iterable[np.ndarray] | None:
    """Read the whole frames of a clip and its truth, where the reader has them; never for a method."""
    read = getattr(reader, "originals", None)
    return None if read is None else read(clip.name, selection)


def save_original_view(
    reconstruction: Reconstruction, clip: Clip, originals: Iterable[np.ndarray] | None, folder: Path
) -> list[str]:
    """Write original.mp4 and original.png: original frame | render over its background, at every frame of the clip.

    Args:
        reconstruction: of the clip.
        clip: crops of a video, with the held-out frames (`recropping.all_moments`); of other data nothing is written.
        originals: the whole frames in the clip's order, uint8 [h, w, 3]; None: the render alone, on white.
        folder: of the run.

    Returns:
        The names of the files.
    """
    if any(frame.crop is None for frame in clip.frames):
        return []
    shown = [clip.frames[i * (len(clip.frames) - 1) // (SHEET - 1)].time for i in range(SHEET)]
    chosen: dict[float, Tensor] = {}
    titles = ["reconstruction"] if originals is None else ["original frame", "reconstruction"]

    def film() -> Iterator[Tensor]:
        for moment, image in _moments(reconstruction, clip, originals):
            if moment in shown:
                chosen[moment] = _reduced(image, len(titles) * SHEET_WIDTH)
            yield image

    save_mp4(film(), folder / "original.mp4", film_rate(clip.fps), QUALITY)
    save_png(_sheet([chosen[moment] for moment in shown], titles), folder / "original.png")
    return ["original.mp4", "original.png"]


def _moments(
    reconstruction: Reconstruction, clip: Clip, originals: Iterable[np.ndarray] | None
) -> Iterator[tuple[float, Tensor]]:
    """Iterate over time and picture of each frame of the clip."""
    count = 0
    for frame, whole in zip(clip.frames, repeat(None) if originals is None else originals, strict=False):
        count += 1
        yield frame.time, _beside(reconstruction, frame, whole)
    if count < len(clip.frames):
        raise UserError(f"{clip.name}: expected {len(clip.frames)} original frames for its pictures, got {count}.")


def _beside(reconstruction: Reconstruction, frame: Frame, whole: np.ndarray | None) -> Tensor:
    """Draw the original frame and the render in it, or the render alone, on white, [3, h, w]."""
    assert frame.crop is not None
    matte = _original_matte(frame.mask, frame.crop)
    height, width = matte.shape[1:]
    camera, background = input_camera(reconstruction, frame), torch.ones(3, height, width)
    if whole is not None:
        image = cv2.resize(whole, (width, height), interpolation=cv2.INTER_AREA)
        background = torch.from_numpy(image).permute(2, 0, 1).float() / 255
    empty = background + matte * (1 - background)
    if camera is not None:
        camera = frame.crop.original_camera(camera).resized(width, height)
        empty = over(reconstruction.at(frame.time), camera, empty)
    return empty if whole is None else beside(background, empty)


def _original_matte(mask: Tensor, crop: Crop) -> Tensor:
    """Resample a crop's matte to the original frame at its shown size, [1, h, w]."""
    scale = min(1.0, LONGEST / max(crop.width, crop.height))
    width, height = even(scale * crop.width), even(scale * crop.height)
    x, y, size = width / crop.width, height / crop.height, mask.shape[2]
    a, b = x * crop.side / size, y * crop.side / size
    # OpenCV counts from the middle of the first pixel.
    moved = np.array(((a, 0, x * crop.left + a / 2 - 0.5), (0, b, y * crop.top + b / 2 - 0.5)))
    return torch.from_numpy(cv2.warpAffine(mask[0].numpy(), moved, (width, height), flags=cv2.INTER_LINEAR))[None]


def _reduced(image: Tensor, width: int) -> Tensor:
    """Resize a picture of the film to a width of the contact sheet."""
    size = (width, even(image.shape[1] * width / image.shape[2]))
    small = cv2.resize(image.permute(1, 2, 0).numpy(), size, interpolation=cv2.INTER_AREA)
    return torch.from_numpy(small).permute(2, 0, 1)


def _sheet(images: list[Tensor], titles: list[str]) -> Tensor:
    """Lay out pictures of one size, two a row in the order of time, [3, H, W]."""
    rows = [torch.cat(images[i : i + 2], dim=2) for i in range(0, len(images), 2)]
    return torch.cat([header(2 * titles, rows[0].shape[2]), *rows], dim=1)
