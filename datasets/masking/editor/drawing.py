"""Put strokes into a frame's marks, and carry them to the image's edges in its mask."""

from collections.abc import Sequence

import cv2
import numpy as np

from rewild4d.datasets.images import size_within
from rewild4d.datasets.masking.correcting import corrected
from rewild4d.datasets.masking.marks import is_whole, resized
from rewild4d.datasets.masking.tracking import WORK_SIDE

SIGNS = {"animal": 1, "surroundings": -1, "eraser": 0}
"""What each brush writes."""
SPECK = 0.003
"""Share of a mask's area below which a part of it, or a hole in it, is a speck."""
PARTS = 16
"""Of a pixel, in which OpenCV takes coordinates here (as a shift of 4 bits)."""


def drawn(said: np.ndarray, tool: str, radius: float, points: Sequence[tuple[float, float]]) -> np.ndarray:
    """Return marks with one more stroke.

    Args:
        said: marks, int8 [h, w]; stays as it is.
        tool: one of `SIGNS`.
        radius: of the brush, pixels.
        points: along the stroke, pixels from the frame's left upper corner; the middle of the first pixel is 0.5.
    """
    touched = np.zeros(said.shape, np.uint8)
    at = np.rint((np.asarray(points, np.float64) - 0.5) * PARTS).astype(np.int32)
    cv2.polylines(touched, [at.reshape(-1, 1, 2)], False, 1, max(1, round(2 * radius)), cv2.LINE_8, 4)
    for point in (at[0], at[-1]):  # a tap is a stroke too
        cv2.circle(touched, point.tolist(), max(1, round(radius * PARTS)), 1, -1, cv2.LINE_8, 4)
    return np.where(touched > 0, np.int8(SIGNS[tool]), said).astype(np.int8)


def mask_of(image: np.ndarray, base: np.ndarray | None, said: np.ndarray) -> np.ndarray | None:
    """Return a frame's mask as its marks correct it, uint8 [h, w]; None where there is neither a mask nor marks.

    Args:
        image: the frame, uint8 [h, w, 3], red, green, blue.
        base: the mask before, uint8 [h, w]; None where there is none.
        said: marks, int8 [h, w].
    """
    if not said.any():
        return base
    if is_whole(said):
        return np.where(said > 0, 255, 0).astype(np.uint8)
    before = np.zeros(said.shape, np.uint8) if base is None else base
    size = size_within(said.shape[::-1], WORK_SIDE)
    small = cv2.resize(image, size, interpolation=cv2.INTER_AREA)
    chance = cv2.resize(before.astype(np.float32) / 255, size, interpolation=cv2.INTER_AREA)
    found = corrected(small, chance, resized(said, size))
    other = cv2.dilate(((found > 0.5) != (chance > 0.5)).astype(np.uint8), np.ones((5, 5)))
    changed = cv2.resize(other, said.shape[::-1], interpolation=cv2.INTER_NEAREST) > 0
    smooth = cv2.resize(found, said.shape[::-1], interpolation=cv2.INTER_LINEAR) > 0.5
    smooth = (smooth | (said > 0)) & (said >= 0)
    least = SPECK * float(smooth.sum())
    clean = ~_without_specks(~_without_specks(smooth, least, changed, said > 0), least, changed, said < 0)
    changed |= (clean != smooth) | (said != 0)
    # Away from what changed the mask keeps its own, finer edge.
    return np.where(changed, clean * np.uint8(255), before).astype(np.uint8)


def _without_specks(mask: np.ndarray, least: float, changed: np.ndarray, told: np.ndarray) -> np.ndarray:
    """Return a mask without parts of less than ``least`` pixels that a change touched, unless they were told."""
    _, labels, stats, _ = cv2.connectedComponentsWithStats(mask.astype(np.uint8), connectivity=4)
    areas = stats[:, cv2.CC_STAT_AREA]
    dropped = areas < least
    dropped &= np.bincount(labels[changed], minlength=len(areas)) > 0
    dropped &= np.bincount(labels[told], minlength=len(areas)) == 0
    found: np.ndarray = mask & ~dropped[labels]
    return found


def true_marks(mask: np.ndarray) -> np.ndarray:
    """Return the marks, int8 [h, w], that tell of each pixel what a mask, uint8 [h, w], does."""
    return np.where(mask > 127, 1, -1).astype(np.int8)
