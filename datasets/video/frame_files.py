"""Frames of a video that lie in a folder as images, and masks beside them."""

from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from rewild4d.datasets.images import expect_size, read_rgb
from rewild4d.datasets.masking.masks import MaskFiles

FRAME_SUFFIXES = (".png", ".jpg", ".jpeg")


def image_size(file: Path) -> tuple[int, int]:
    """Return the width and height of an upright image."""
    height, width = read_rgb(file, upright=True).shape[:2]
    return width, height


def read_images(files: Sequence[Path], size: tuple[int, int]) -> Iterator[np.ndarray]:
    """Yield the frames one after the other, turned upright as their EXIF says, uint8 [h, w, 3].

    Raises:
        UserError: a frame that cannot be read or has another size than the first.
    """
    for file in files:
        image = read_rgb(file, upright=True)
        expect_size(file, image, size, files[0].name)
        yield image


def read_masks(
    masks: MaskFiles, object_id: int | None, indices: Sequence[int], size: tuple[int, int]
) -> Iterator[np.ndarray | None]:
    """Yield the masks of some frames, one after the other; None where a frame has none."""
    for index in indices:
        yield masks.read(index, object_id, size)
