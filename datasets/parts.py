"""Masks in several parts: all of them, or the one that is the animal where a segmenter took in something else.

An animal behind a pole is in parts too, so nothing is left out unless a person who looked at `check`'s sheet asks.
"""

from collections.abc import Iterator
from dataclasses import replace
from functools import partial
from typing import Literal

import cv2
import numpy as np

from rewild4d.datasets.wild import Masks, Video
from rewild4d.errors import unknown_name

Parts = Literal["all", "main"]
"""Which connected parts of a mask are the animal."""
NOTE = "of masks in several parts only the one that goes on from the frame before is taken (--parts main)"


def with_parts(video: Video, parts: str) -> Video:
    """The video with its masks cut down to the parts that are wanted.

    Args:
        video: its ``true_masks`` stay as they are.
        parts: `Parts`.

    Raises:
        UserError: another word.
    """
    if parts == "all":
        return video
    if parts != "main":
        raise unknown_name("choice of --parts", parts, ("all", "main"))
    masks, identity = partial(main_parts, video.masks), f"{video.identity} main part"
    return replace(video, masks=masks, identity=identity, notes=(*video.notes, NOTE))


def main_parts(masks: Masks) -> Iterator[np.ndarray | None]:
    """Of every mask the part that shares most pixels with what was kept before it, or the largest where none does.

    Args:
        masks: uint8 [h, w], or None where a frame has none.

    Yields:
        The same, with the other parts and their soft rims at 0.
    """
    before: np.ndarray | None = None
    for mask in masks():
        if mask is None or not (solid := mask > 127).any():
            yield mask
            continue
        part = _main(solid, before)
        before = part & solid
        yield np.where(part, mask, 0).astype(np.uint8)


def _main(solid: np.ndarray, before: np.ndarray | None) -> np.ndarray:
    """Pixels nearer to the main part than to another, bool [h, w]."""
    nearest: np.ndarray
    _, nearest = cv2.distanceTransformWithLabels(
        (~solid).astype(np.uint8), cv2.DIST_L2, 5, labelType=cv2.DIST_LABEL_CCOMP
    )
    shared = np.bincount(nearest[solid & before]) if before is not None else np.zeros(0, dtype=np.int64)
    if not shared.any():
        shared = np.bincount(nearest[solid])
    return nearest == int(shared.argmax())
