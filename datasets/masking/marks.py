"""What a person says of a frame: strokes on the animal and beside it, or a whole mask.

Marks are int8 [h, w]: 1 on the animal, -1 on its surroundings, 0 where nothing is said. In a file green is the animal,
red the surroundings, any other colour nothing; an image of greys is a whole mask.
"""

from collections.abc import Mapping, Sequence
from pathlib import Path

import cv2
import numpy as np
from PIL import Image

from rewild4d.datasets.images import read_rgb
from rewild4d.datasets.masking.makers import frame_places
from rewild4d.datasets.masking.masks import fit_size, list_images, open_masks
from rewild4d.errors import UserError
from rewild4d.files import atomic

GREEN, RED = (0, 255, 0), (255, 0, 0)
STRONG, WEAK = 160, 96
"""A stroke's own channel is above the first, the two others below the second."""


def read_marks(folder: Path, stems: Sequence[str], size: tuple[int, int]) -> dict[int, np.ndarray]:
    """Return the marks of a film by the frame's place.

    Args:
        folder: of images that are named as the frames, or by their numbers.
        stems: names of the frames that are used.
        size: width and height of the frames.

    Raises:
        UserError: no image, one that names no frame, that has another shape, or that says nothing.
    """
    places = frame_places(stems)
    files = list_images(folder)
    if not files:
        raise UserError(f"{folder}: expected images named as the frames ({stems[0]}.png, ...), got none.")
    found = {}
    for file in files:
        place = places.get(file.stem.lstrip("0") or "0")
        if place is None:
            raise UserError(f"{file}: expected the name of a frame from {stems[0]} to {stems[-1]}, got '{file.stem}'.")
        found[place] = _read(file, size)
    return found


def write_marks(marks: Mapping[int, np.ndarray], stems: Sequence[str], folder: Path) -> list[Path]:
    """Write folder/<stem>.png for each marked frame: a whole mask in greys, strokes in green and red on black.

    A frame without the animal is red all over.

    Args:
        marks: by the frame's place.
        stems: names of all frames.
        folder: is made.

    Returns:
        The files.
    """
    paths = []
    for place, said in sorted(marks.items()):
        paths.append(folder / f"{stems[place]}.png")
        image = np.zeros((*said.shape, 3), np.uint8)
        image[said > 0], image[said < 0] = GREEN, RED
        is_mask = is_whole(said) and (said > 0).any()  # a black one says nothing to a reader
        drawn = (said > 0) * np.uint8(255) if is_mask else cv2.cvtColor(image, cv2.COLOR_RGB2BGR)
        with atomic(paths[-1]) as temporary:
            cv2.imwrite(str(temporary), drawn)
    return paths


def is_whole(said: np.ndarray) -> bool:
    """Whether marks say of each pixel what it is."""
    return bool(said.all())


def resized(said: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """Return marks at another width and height; thin strokes stay."""
    if said.shape[::-1] == size:
        return said
    if is_whole(said):
        whole = cv2.resize((said > 0).astype(np.float32), size, interpolation=cv2.INTER_AREA)
        return np.where(whole > 0.5, 1, -1).astype(np.int8)
    parts = [
        cv2.resize((said == sign).astype(np.float32), size, interpolation=cv2.INTER_AREA) > 0.25 for sign in (1, -1)
    ]
    return np.where(parts[0], 1, np.where(parts[1], -1, 0)).astype(np.int8)


def _read(file: Path, size: tuple[int, int]) -> np.ndarray:
    red, green, blue = read_rgb(file, upright=True).transpose(2, 0, 1)
    said = np.zeros(red.shape, np.int8)
    said[(green > STRONG) & (red < WEAK) & (blue < WEAK)] = 1
    said[(red > STRONG) & (green < WEAK) & (blue < WEAK)] = -1
    fit_size(np.zeros(said.shape, np.uint8), size, str(file))
    if said.any():
        return resized(said, size)
    mask = open_masks((file,)).read(0, None, size)
    if not _is_mask(file) or mask is None or not mask.any():
        raise UserError(
            f"{file}: expected green strokes on the animal and red ones beside it, or a mask of the animal in black "
            "and white, got neither."
        )
    return np.where(mask > 127, 1, -1).astype(np.int8)


def _is_mask(file: Path) -> bool:
    """Whether an image is grey or has a palette, as masks do."""
    with Image.open(file) as image:
        greys = image.mode in ("1", "L", "P", "I", "I;16", "F")
        return greys or bool((np.ptp(np.asarray(image.convert("RGB")), axis=2) == 0).all())
