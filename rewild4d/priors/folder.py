"""A folder of frames and a folder of masks, as a clip to fit a prior to."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import torch
from torch import Tensor

from rewild4d.errors import UserError
from rewild4d.files import digest
from rewild4d.priors.travel import TravelMeter
from rewild4d.types import Clip, Frame

SUFFIXES = (".png", ".jpg", ".jpeg")
LONGEST = 960
"""Frames are averaged down to this many pixels on the longer side: a fit looks at 80 pixels of the animal."""


@dataclass(frozen=True)
class Footage:
    """What two folders hold.

    Attributes:
        clip: the frames that have a mask, cameras unknown.
        stems: file names of its frames without their ending.
        size: width and height of the frames as they are stored; the clip's may be smaller.
        travel: of the animal against the background, pixels of the clip, [T - 1, 2].
        notes: what was left out, a sentence each.
    """

    clip: Clip
    stems: tuple[str, ...]
    size: tuple[int, int]
    travel: Tensor
    notes: tuple[str, ...]


def read_footage(frames: Path, masks: Path, fps: float) -> Footage:
    """Read two folders whose files have the same names but for the ending.

    Raises:
        UserError: a folder is missing or empty, no names agree, a file cannot be read, or sizes differ.
    """
    images, mattes = _files(frames, "frames"), {file.stem: file for file in _files(masks, "masks")}
    pairs = [(image, mattes[image.stem]) for image in images if image.stem in mattes]
    if not pairs:
        raise UserError(
            f"{masks}: expected masks named like the frames in {frames} ({images[0].stem}, ...), "
            f"got {', '.join(list(mattes)[:3])}."
        )
    meter, found, sizes = TravelMeter(), [], set()
    start = images.index(pairs[0][0])
    for image_file, mask_file in pairs:
        image = _read(image_file, cv2.IMREAD_COLOR)[..., ::-1]
        mask = _foreground(_read(mask_file, cv2.IMREAD_UNCHANGED))
        if mask.shape != image.shape[:2]:
            raise UserError(
                f"{mask_file}: expected a mask of {image.shape[1]}x{image.shape[0]} pixels like {image_file.name}, "
                f"got {mask.shape[1]}x{mask.shape[0]}."
            )
        sizes.add((image.shape[1], image.shape[0]))
        if len(sizes) > 1:
            raise UserError(f"{image_file}: expected frames of one size, got {' and '.join(map(str, sorted(sizes)))}.")
        image, mask = _reduced(image), _reduced(mask)
        meter.add(image, mask)
        matte = torch.from_numpy(mask).float()[None] / 255
        rgb = torch.from_numpy(np.ascontiguousarray(image)).permute(2, 0, 1).float() / 255 * matte
        found.append(Frame((images.index(image_file) - start) / fps, None, rgb, matte))
    missing = len(images) - len(pairs)
    notes = (f"{missing} of {len(images)} frames without a mask left out",) if missing else ()
    key = digest(*(part for frame in found for part in (repr(frame.time), frame.mask)))
    clip = Clip(frames.name, "unknown", tuple(found), fps, "unknown", key)
    return Footage(clip, tuple(image.stem for image, _ in pairs), sizes.pop(), meter.result(), notes)


def _files(folder: Path, what: str) -> list[Path]:
    if not folder.is_dir():
        raise UserError(f"{folder}: expected a folder of {what}, but there is none.")
    files = [file for file in folder.iterdir() if file.suffix.lower() in SUFFIXES]
    if not files:
        raise UserError(f"{folder}: expected {what} as {', '.join(SUFFIXES)}, but it holds none.")
    return sorted(files, key=_order(files))


def _order(files: Sequence[Path]):  # type: ignore[no-untyped-def]
    """By number where all names are numbers ("10" after "9"), else by name."""
    if all(file.stem.isdigit() for file in files):
        return lambda file: int(file.stem)
    return lambda file: file.name


def _read(file: Path, mode: int) -> np.ndarray:
    image = cv2.imdecode(np.fromfile(file, np.uint8), mode) if file.stat().st_size else None
    if image is None:
        raise UserError(f"{file}: expected an image that can be read, got a damaged or another file.")
    return image


def _foreground(values: np.ndarray) -> np.ndarray:
    """A mask file as a matte, uint8, [h, w]: alpha where it varies, else grey; colours and small numbers are ids."""
    if values.dtype != np.uint8:
        values = (values / max(int(values.max()), 1) * 255).astype(np.uint8)
    if values.ndim == 3 and values.shape[2] == 4 and values[..., 3].min() < values[..., 3].max():
        return values[..., 3]
    grey = values if values.ndim == 2 else values[..., :3].max(axis=2)
    colored = values.ndim == 3 and bool((values[..., :3] != values[..., :1]).any())
    return np.where(grey > 0, 255, 0).astype(np.uint8) if colored or grey.max() < 128 else grey


def _reduced(image: np.ndarray) -> np.ndarray:
    scale = LONGEST / max(image.shape[:2])
    if scale >= 1:
        return np.ascontiguousarray(image)
    size = (round(image.shape[1] * scale), round(image.shape[0] * scale))
    return cv2.resize(np.ascontiguousarray(image), size, interpolation=cv2.INTER_AREA)
