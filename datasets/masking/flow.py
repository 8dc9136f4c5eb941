"""Optical flow between frames (DIS, Kroeger et al. 2016), and what is carried along it."""

import cv2
import numpy as np

TOLERANCE, STRETCH = 1.5, 0.05
"""Flow there and back may end this far from its start: pixels, and a share of its length."""


class Flow:
    """Flow between two grey images, uint8 [h, w]."""

    def __init__(self) -> None:
        self._dis = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_FAST)

    def __call__(self, here: np.ndarray, there: np.ndarray) -> np.ndarray:
        """Return where each pixel of ``here`` lies in ``there``, less its own place, float32 [h, w, 2]."""
        found: np.ndarray = self._dis.calc(here, there, np.zeros((*here.shape, 2), np.float32))
        return found

    def checked(self, here: np.ndarray, there: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the flow, and where flow there and back ends at its start, bool [h, w].

        What ``there`` hides has no flow that does.
        """
        away, back = self(here, there), self(there, here)
        returned = np.stack([carried(back[..., axis], away) for axis in (0, 1)], axis=-1)
        error, length = (np.linalg.norm(value, axis=-1) for value in (away + returned, away))
        return away, error < TOLERANCE + STRETCH * length


def carried(values: np.ndarray, flow: np.ndarray, how: int = cv2.INTER_LINEAR) -> np.ndarray:
    """Return values of another frame, seen from this one; 0 where they come from outside.

    Args:
        values: [h, w].
        flow: from this frame to the other, [h, w, 2].
        how: OpenCV's interpolation.
    """
    height, width = values.shape
    grid = np.stack(np.meshgrid(np.arange(width), np.arange(height)), axis=-1).astype(np.float32) + flow
    found: np.ndarray = cv2.remap(values, grid[..., 0], grid[..., 1], how, borderMode=cv2.BORDER_CONSTANT)
    return found
