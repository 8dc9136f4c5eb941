"""Objects that masks tell apart by colour: an indexed image that was saved without its palette."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from PIL import Image, ImageOps

from rewild4d.datasets.masking.meaning import MOST_OBJECTS, Meaning

BLACK = 31
"""Colours without a channel above this are background: a JPEG's black is not quite black."""
FILE_TINT = 8
"""Channels of an image file that differ by no more are grey: conversion between colour spaces tints it a little."""


def object_colors(files: Sequence[Path]) -> tuple[int, ...]:
    """Return the colours of the objects in all masks of a video, as numbers 0xRRGGBB, ascending.

    None where a file has no colours, where colours are those of soft edges (more than `MOST_OBJECTS`), and where fewer
    than two are used besides black and one grey: one colour is the animal.

    Args:
        files: images that can be read.
    """
    found: set[int] = set()
    for file in files:
        codes = _codes(file)
        if codes is None:
            return ()
        found |= set(np.unique(codes).tolist())
        if len(found) > MOST_OBJECTS:
            return ()
    colors = tuple(color for color in sorted(found) if max(_channels(color)) > BLACK)
    tinted = sum(max(_channels(color)) - min(_channels(color)) > FILE_TINT for color in colors)
    return colors if tinted > 1 and len(colors) - tinted < 2 else ()


def color_numbers(file: Path, colors: Sequence[int]) -> np.ndarray:
    """Return a mask as numbers of objects, 1 for the first colour, 0 for all others, uint8 [h, w]."""
    codes = _codes(file)
    if codes is None:
        raise ValueError(f"{file} has no colours")
    numbers = np.searchsorted(colors, codes).clip(max=len(colors) - 1)
    return np.where(np.asarray(colors)[numbers] == codes, numbers + 1, 0).astype(np.uint8)


def numbered(colors: Sequence[int]) -> Meaning:
    """Return what the numbers of colours mean, and say which object has which colour."""
    listed = ", ".join(f"{number} is {_channels(color)}" for number, color in enumerate(colors[:6], 1))
    more = ", ..." if len(colors) > 6 else ""
    note = f"masks hold {len(colors)} colours: taken as numbers of objects ({listed}{more})"
    return Meaning(tuple(range(1, len(colors) + 1)), note=note)


def _codes(file: Path) -> np.ndarray | None:
    """Return each pixel's colour as 0xRRGGBB, int64 [h, w]; None where the image is not opaque RGB."""
    with Image.open(file) as image:
        if image.mode not in ("RGB", "RGBA"):
            return None
        values = np.asarray(ImageOps.exif_transpose(image)).astype(np.int64)
    if values.shape[2] == 4 and (values[..., 3] < 255).any():
        return None
    return values[..., 0] << 16 | values[..., 1] << 8 | values[..., 2]


def _channels(color: int) -> tuple[int, int, int]:
    return color >> 16, color >> 8 & 255, color & 255
