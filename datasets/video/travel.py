"""Where an animal goes: its motion against the background, which tells head from tail better than any outline."""

import cv2
import numpy as np
import torch
from torch import Tensor

CORNERS = 400
LONGEST = 960
"""Larger frames are averaged down to this many pixels on the longer side: the flow needs no more."""
MARGIN = 15
"""Pixels around the mask that count as neither animal nor background."""
LEAST = 12
"""Corners that must be found again in the next frame; below, the background counts as still."""


class TravelMeter:
    """Takes the frames of a video one after the other, backgrounds included, and adds up where the animal went."""

    def __init__(self) -> None:
        self._before: tuple[np.ndarray, np.ndarray, np.ndarray | None] | None = None
        self._steps: list[np.ndarray] = []

    def add(self, image: np.ndarray, mask: np.ndarray) -> None:
        """Add the next whole frame, uint8 [h, w, 3], and its mask, uint8 [h, w], 255 inside the animal."""
        scale = max(1.0, max(mask.shape) / LONGEST)
        grey = cv2.cvtColor(reduced(image), cv2.COLOR_RGB2GRAY)
        solid = (reduced(mask) > 127).astype(np.uint8)
        middle = np.argwhere(solid).mean(0)[::-1] if solid.any() else None
        if self._before is not None:
            earlier, covered, start = self._before
            step = np.zeros(2)
            if start is not None and middle is not None:
                step = middle - start - _background_shift(earlier, grey, covered)
            self._steps.append(step * scale)
        self._before = (grey, solid, middle)

    def result(self) -> Tensor:
        """Return the motion of the mask's centre over the background from frame to frame in pixels, [T - 1, 2]."""
        return torch.from_numpy(np.array(self._steps, dtype=np.float32).reshape(-1, 2))


def _background_shift(before: np.ndarray, after: np.ndarray, covered: np.ndarray) -> np.ndarray:
    """Return the median motion of corners outside the animal, [2]."""
    free = 255 * (1 - cv2.dilate(covered, np.ones((2 * MARGIN + 1, 2 * MARGIN + 1), np.uint8)))
    corners = cv2.goodFeaturesToTrack(before, CORNERS, 0.01, 8, mask=free)
    if corners is None:
        return np.zeros(2)
    moved, found, _ = cv2.calcOpticalFlowPyrLK(before, after, corners, np.empty_like(corners))
    shifts = (moved - corners)[found[:, 0] == 1, 0]
    return np.median(shifts, axis=0) if len(shifts) >= LEAST else np.zeros(2)


def reduced(image: np.ndarray, longest: int = LONGEST) -> np.ndarray:
    """Return the image averaged down to at most so many pixels on its longer side, [h, w] or [h, w, 3]."""
    scale = longest / max(image.shape[:2])
    if scale >= 1:
        return np.ascontiguousarray(image)
    size = (round(image.shape[1] * scale), round(image.shape[0] * scale))
    return cv2.resize(np.ascontiguousarray(image), size, interpolation=cv2.INTER_AREA)
