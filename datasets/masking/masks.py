"""Read masks from files of any kind: which values mean the animal, and which frame a mask belongs to.

The same value means different things: 255 is the foreground of DAVIS 2016 (grey images of 0 and 255) and "void" in
DAVIS 2017 (indexed images whose values are object ids). So a folder is read as a whole before its values are told.
"""

import re
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from PIL import Image, ImageOps, UnidentifiedImageError

from rewild4d.datasets.masking.coloured import BLACK, FILE_TINT, color_numbers, numbered, object_colors
from rewild4d.datasets.masking.meaning import Census, Meaning
from rewild4d.errors import UserError
from rewild4d.files import natural
from rewild4d.foreign.reading import picture_size

SUFFIXES = (".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff", ".webp")
LOSSY = (".jpg", ".jpeg", ".webp")
FILM_TINT = 40
"""Largest difference of two channels where a film of masks is grey: compression tints it."""


@dataclass(frozen=True)
class MaskFiles:
    """The masks of one video: a file for each frame that has one, and how to read their values.

    Attributes:
        files: of each frame; None where it has no mask.
        is_indexed: whether files with a palette hold numbers of objects; otherwise the palette's greys count.
        meaning: of the values of all files.
        stored: width and height of the video's frames before their pixels were made square; masks may have that shape.
        colors: of the objects, where files tell them apart by colour (`coloured`).
    """

    files: tuple[Path | None, ...]
    is_indexed: bool = False
    meaning: Meaning = Meaning()
    stored: tuple[int, int] | None = None
    colors: tuple[int, ...] = ()

    @property
    def ids(self) -> tuple[int, ...]:
        """The objects that the files name, ascending; empty where they hold a foreground or a soft matte."""
        return self.meaning.ids

    def read(self, index: int, object_id: int | None, size: tuple[int, int]) -> np.ndarray | None:
        """Return the mask of a frame, uint8 [h, w], 255 inside; None where it has none.

        Args:
            index: of the frame.
            object_id: which of `ids`; None: all of them together.
            size: width and height of the frame; a mask of the same shape in another size is scaled.

        Raises:
            UserError: a file that cannot be read, or of another shape than the frame.
        """
        file = self.files[index]
        if file is None:
            return None
        values = color_numbers(file, self.colors) if self.colors else stored_values(file, self.is_indexed)
        mask = self.meaning.mask(values, object_id)
        return fit_size(mask, size, str(file), self.stored)


def open_masks(files: Sequence[Path | None]) -> MaskFiles:
    """Look at all masks of a video and tell what their values mean.

    Raises:
        UserError: a file that cannot be read.
    """
    there = [file for file in files if file is not None]
    indexed = any(map(_has_colored_palette, there))
    census = Census(any(file.suffix.lower() in LOSSY for file in there))
    for file in there:
        census.add(stored_values(file, indexed))
    if not indexed and not census.is_lossy and (colors := object_colors(there)):
        return MaskFiles(tuple(files), meaning=numbered(colors), colors=colors)
    return MaskFiles(tuple(files), indexed, census.indexed() if indexed else census.meaning())


def stored_values(file: Path, indexed: bool = False) -> np.ndarray:
    """Return the values of a mask file, [h, w]: as they are stored, of a palette its greys or its indices.

    An alpha channel that varies, or is zero everywhere, is the mask; colours are taken as foreground unless nearly
    black. Values are uint8, uint16 or float32.

    Args:
        file: an image.
        indexed: whether the numbers of a palette's entries are wanted, not what the palette says of them.

    Raises:
        UserError: the file cannot be read, or holds numbers that are not finite.
    """
    with _opened(file) as stored:
        image = ImageOps.exif_transpose(stored)
        if image.mode in ("CMYK", "YCbCr", "LAB", "HSV"):
            image = image.convert("RGB")
        values, mode = np.asarray(image), image.mode
        if mode == "P" and not indexed:
            values = _greys(values, _palette(image))
    if values.dtype == bool:
        return values.astype(np.uint8) * 255
    if values.ndim == 3:
        return _from_channels(values, mode)
    if values.dtype in (np.uint8, np.uint16):
        return values
    if not np.isfinite(values).all():
        raise UserError(f"{file}: expected a mask of finite numbers, got some that are not.")
    if values.dtype.kind in "iu" and values.min(initial=0) >= 0 and values.max(initial=0) <= 65535:
        return values.astype(np.uint16)
    return values.astype(np.float32)


def read_transparency(file: Path) -> np.ndarray | None:
    """Return the alpha channel of an image, turned upright as its EXIF says, uint8 [h, w]; None where it has none.

    Raises:
        UserError: the file cannot be read.
    """
    with _opened(file, "an image") as image:
        if "A" not in image.getbands() and "transparency" not in image.info:
            return None
        return np.asarray(ImageOps.exif_transpose(image).convert("RGBA").getchannel("A"))


@contextmanager
def _opened(file: Path, what: str = "a mask image") -> Iterator[Image.Image]:
    """Return an image file, decoded in the block."""
    picture_size(file, file)
    try:
        with Image.open(file) as image:
            yield image
    except (OSError, UnidentifiedImageError, SyntaxError, ValueError, Image.DecompressionBombError) as error:
        reason = getattr(error, "strerror", None)
        came = f"but: {reason}" if reason else "got a damaged or another file"
        raise UserError(f"{file}: expected {what} that can be read, {came}.") from error


def _from_channels(values: np.ndarray, mode: str) -> np.ndarray:
    alpha = values[..., -1]
    if mode in ("LA", "RGBA", "PA") and (alpha.min() < alpha.max() or not alpha.any()):
        return alpha
    return shades(values[..., :3] if mode in ("RGB", "RGBA") else values[..., :1])


def shades(colors: np.ndarray, tint: int = FILE_TINT) -> np.ndarray:
    """Return the mask that colours mean: grey is a shade, any other colour the foreground unless nearly black.

    Args:
        colors: uint8, [h, w, 3] or [h, w, 1].
        tint: channels that differ by no more are grey.
    """
    if not (np.ptp(colors, axis=2) > tint).any():
        return colors.max(axis=2)
    return np.where(colors.max(axis=2) > BLACK, 255, 0).astype(np.uint8)


def _has_colored_palette(file: Path) -> bool:
    """Whether a file's palette gives what the file shows other colours than greys: numbers of objects, not shades."""
    with _opened(file) as image:
        if image.mode != "P":
            return False
        palette = _palette(image)
        used = np.flatnonzero(np.bincount(np.asarray(image).ravel(), minlength=256))
    return bool((np.ptp(palette[used[used < len(palette)]], axis=1) > FILE_TINT).any())


def _greys(values: np.ndarray, palette: np.ndarray) -> np.ndarray:
    """Return what a palette of greys makes of its indices; the indices where it shows them all alike."""
    greys = np.arange(256, dtype=np.uint8)
    greys[: len(palette)] = palette.max(axis=1)
    shown = greys[values]
    return values if np.ptp(shown) == 0 < np.ptp(values) else shown


def _palette(image: Image.Image) -> np.ndarray:
    """Return the colours that a file gives to its indices, uint8 [entries, 3]; indices beyond them have none."""
    return np.array(image.getpalette("RGB"), np.uint8).reshape(-1, 3)


def fit_size(mask: np.ndarray, size: tuple[int, int], title: str, stored: tuple[int, int] | None = None) -> np.ndarray:
    """Return the mask at the size of its frame; one of the same shape in another size is scaled.

    Args:
        mask: uint8 [h, w].
        size: width and height of the frame.
        title: of the mask, for the error.
        stored: width and height of the frame before its pixels were made square; a mask of that shape is stretched.

    Raises:
        UserError: another shape.
    """
    height, width = mask.shape
    if (width, height) == size:
        return mask
    shapes = (size, stored) if stored else (size,)
    # beyond rounding of either
    if all(abs(width * down - height * across) > across + down + max(width, height) for across, down in shapes):
        raise UserError(
            f"{title}: expected a mask of {size[0]}x{size[1]} pixels like its frame (or of that shape), "
            f"got {width}x{height}."
        )
    return cv2.resize(mask, size, interpolation=cv2.INTER_AREA if width > size[0] else cv2.INTER_LINEAR)


def list_images(folder: Path, suffixes: Sequence[str] = SUFFIXES) -> list[Path]:
    """Return the image files of a folder in natural order (2 before 10).

    Raises:
        UserError: no such folder, or two files that differ in their ending alone.
    """
    try:
        found = [entry for entry in folder.iterdir() if entry.suffix.lower() in suffixes and entry.name[0] != "."]
    except OSError as error:
        raise UserError(f"{folder}: expected a folder of images, but: {error.strerror}.") from error
    by_stem: dict[str, Path] = {}
    for entry in sorted(found):
        twin = by_stem.setdefault(entry.stem, entry)
        if twin is not entry:
            raise UserError(f"{folder}: expected one image of each name, got {twin.name} and {entry.name}.")
    return sorted(found, key=natural)


def match_masks(masks: Sequence[Path], stems: Sequence[str], folder: Path) -> tuple[list[Path | None], str]:
    """Return which mask belongs to which frame: by equal names, else by the number in the name, else by order.

    Args:
        masks: files in natural order.
        stems: names of the frames without suffix; of a video the frame numbers, from 0.
        folder: of the masks, for messages.

    Returns:
        A file or None for each frame, and a sentence where names did not settle it or masks are left over ("" else).

    Raises:
        UserError: no mask, or masks that fit no frame.
    """
    if not masks:
        raise UserError(f"{folder}: expected masks ({', '.join(SUFFIXES)}), got none.")
    by_name = {mask.stem: mask for mask in masks}
    by_number = {number: mask for mask in masks if (number := last_number(mask.stem)) is not None}
    numbers = [number for stem in stems if (number := last_number(stem)) is not None]
    counted = len(by_number) == len(masks) and len({*numbers}) == len(stems)
    shift = min(by_number) - min(numbers) if counted else 0
    # Numbers that fit no frame as they are, and all fit one by one: counted from 1 beside frames from 0, or vice versa.
    if abs(shift) == 1 and not {*by_number} <= {*numbers} and {mask - shift for mask in by_number} <= {*numbers}:
        note = f"masks are numbered from {min(by_number)}, frames from {min(numbers)}"
        return [by_number.get(number + shift) for number in numbers], note
    if any(stem in by_name for stem in stems):
        found = [by_name.get(stem) for stem in stems]
        return found, _left_over(masks, found)
    if counted and any(number in by_number for number in numbers):
        found = [by_number.get(number) for number in numbers]
        return found, _left_over(masks, found)
    if len(masks) == len(stems):
        return list(masks), f"masks and frames share no names: matched in order, {masks[0].name} first"
    raise UserError(
        f"{folder}: expected masks named like the frames ({stems[0]}, ...) or one for each of the {len(stems)} frames, "
        f"got {len(masks)} ({masks[0].name}, ...)."
    )


def _left_over(masks: Sequence[Path], found: Sequence[Path | None]) -> str:
    """Return a sentence on the masks that fit no frame; "" where there are none."""
    rest = [mask.name for mask in masks if mask not in {*found}]
    if not rest:
        return ""
    return f"{len(rest)} of {len(masks)} masks fit no frame: {', '.join(rest[:3])}{', ...' if len(rest) > 3 else ''}"


def last_number(stem: str) -> int | None:
    """Return the last number in a file's name, or None."""
    found = re.findall(r"[0-9]+", stem)
    return int(found[-1]) if found else None
