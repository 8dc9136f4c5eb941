"""Take a neighbour out of the masks of earlier frames once it has come loose from the animal.

While a neighbour comes out from behind the animal both are one thing, and the mask has both. When they part it is told
apart, and flow says where it was in the frames before, back to the one in which the animal hid it.
"""

from collections import deque
from dataclasses import dataclass

import cv2
import numpy as np

from rewild4d.datasets.masking.flow import Flow, carried
from rewild4d.datasets.masking.parts import coarse, main_parts

FRAMES = 24
"""Whose masks are kept back."""
LEAST_LOOSE, LEAST_LEFT = 0.05, 0.02
"""Shares of the animal's area: of a loose part from which on it is followed back, and below which it is hidden."""
NEAR = 15
"""Pixels around what flow carries back, within which what the next mask lacks goes too."""


@dataclass
class _Frame:
    grey: np.ndarray
    mask: np.ndarray


class Recent:
    """Masks of the last frames, kept back until what later frames tell has been taken out of them."""

    def __init__(self) -> None:
        self._kept: deque[_Frame] = deque()
        self._flow = Flow()

    def add(self, image: np.ndarray, mask: np.ndarray, loose: np.ndarray) -> list[np.ndarray]:
        """Take the next frame's mask; return the masks that are ready, oldest first, bool [h, w].

        Args:
            image: the frame, uint8 [h, w, 3].
            mask: of the animal, bool [h, w].
            loose: what came loose from it in this frame and is no part of the mask, bool [h, w].
        """
        frame = _Frame(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY), mask)
        if self._kept and mask.any() and loose.sum() >= LEAST_LOOSE * mask.sum():
            self._take_out(frame, loose)
        self._kept.append(frame)
        return [self._kept.popleft().mask] if len(self._kept) > FRAMES else []

    def rest(self) -> list[np.ndarray]:
        """Return the masks that are still kept back, oldest first."""
        masks = [frame.mask for frame in self._kept]
        self._kept.clear()
        return masks

    def _take_out(self, after: _Frame, loose: np.ndarray) -> None:
        """Follow a loose part back through the frames that are kept, until it is hidden."""
        last = self._kept[-1]
        came = carried(last.mask.astype(np.float32), self._flow(after.grey, last.grey)) > 0.5
        part = (loose | coarse((came | loose) & ~after.mask)).astype(np.float32)
        for frame in reversed(self._kept):
            flow, sure = self._flow.checked(frame.grey, after.grey)
            part = carried(part, flow) * frame.mask
            if (part > 0.5).sum() <= LEAST_LEFT * frame.mask.sum():
                return
            ahead = carried(after.mask.astype(np.float32), flow) > 0.5
            around = cv2.dilate((part > 0.5).astype(np.uint8), np.ones((2 * NEAR + 1,) * 2, np.uint8)) > 0
            gone = (part > 0.5) | (around & coarse(frame.mask & ~ahead & sure))
            frame.mask = main_parts(frame.mask & ~gone, ahead)
            after = frame
