"""What lies behind an animal that moves, or that the camera follows: other frames of the film, laid over this one.

Frames are registered by homographies of what most of the picture does. A pixel that two other frames show alike, where
nothing stood out in them, is backdrop; one that no other frame shows so is not, also where it does not stand out. Where
the animal hid its backdrop throughout, nothing is known. What the air moves (leaves, water) differs by itself: how far
pixels differ is measured against how far those around them do.
"""

from collections.abc import Iterable
from dataclasses import dataclass

import cv2
import numpy as np

from rewild4d.datasets.images import size_within
from rewild4d.datasets.masking.saliency import Saliency

SIDE = 427
"""Frames are compared at this longer side."""
EVERY, NEAR, MOST = 5, 6, 24
"""Every so many frames one is kept to be compared with; those nearer are not, and so many of the nearest are."""
OUTSTANDING, MARGIN = 0.3, 9
"""What stands out by more, or so many pixels around it, is no backdrop."""
KNOWN = 4
"""Least number of other frames that tell a pixel's backdrop."""
CORNERS, LEAST_CORNERS, APART = 600, 8, 6
"""Most and least corners that frames are registered by, and pixels between two of them."""
RETURN, INLIER, AGREE = 0.7, 1.0, 0.5
"""Pixels by which a corner may miss its start when it is followed there and back, and by which it may depart from what
most do; least share of corners that do what most do."""
CHANNELS = (1.0, 1.5, 1.5)
"""Weights of lightness and of both colours (OpenCV's 8-bit Lab)."""
AROUND, LOUD = 61, 3.0
"""Side of the square around a pixel over which differences are averaged; those above so many medians count as that."""
FLOOR, TIMES = 5.0, 2.0
"""Log odds are 0 where a pixel differs by the first, and the second times the average around it, together."""
STEEP, RANGE = 2.3, (-3.0, 4.0)
"""Log odds for each e-fold of that, and their range: fitted to the true masks of two films."""


@dataclass
class _Kept:
    place: int
    lab: np.ndarray
    is_backdrop: np.ndarray


class Backdrop:
    """The backdrops of a film's frames.

    Args:
        images: all frames, uint8 [h, w, 3]; they are read when the first backdrop is wanted.
        saliency: the network.
    """

    def __init__(self, images: Iterable[np.ndarray], saliency: Saliency) -> None:
        self._images: Iterable[np.ndarray] | None = images
        self._saliency = saliency
        self._kept, self._to = list[_Kept](), list[np.ndarray]()
        self._shot = [0]  # places at which what comes cannot be laid over what was before

    def _look_through(self) -> None:
        """Register all frames, and keep those that others are compared with."""
        before: np.ndarray | None = None
        images, self._images = self._images or (), None
        for place, image in enumerate(images):
            small = _small(image)
            grey = cv2.cvtColor(small, cv2.COLOR_RGB2GRAY)
            step = np.eye(3) if before is None else _registered(before, grey)
            if step is None:
                self._shot.append(place)
                step = np.eye(3)
            self._to.append(step @ self._to[-1] if self._to else step)
            before = grey
            if place % EVERY == 0:
                found = (self._saliency(small) > OUTSTANDING).astype(np.uint8)
                hidden = cv2.dilate(found, np.ones((MARGIN, MARGIN), np.uint8))
                self._kept.append(_Kept(place, _lab(small), 1 - hidden))

    def odds(self, place: int, image: np.ndarray) -> np.ndarray:
        """Return the log odds that a pixel is no backdrop, float32 [h, w]; 0 where nothing is known.

        Args:
            place: of the frame in the film.
            image: the frame, uint8 [h, w, 3].
        """
        if self._images is not None:
            self._look_through()
        lab = _lab(_small(image))
        high, wide = lab.shape[:2]
        least = np.full((2, high, wide), np.inf, np.float32)  # the two smallest differences
        count = np.zeros((high, wide), np.uint8)
        for kept in self._compared(place):
            across = self._to[place] @ np.linalg.inv(self._to[kept.place])
            there = cv2.warpPerspective(kept.lab, across, (wide, high))
            shown = cv2.warpPerspective(kept.is_backdrop, across, (wide, high), flags=cv2.INTER_NEAREST) > 0
            differs = np.where(shown, np.abs(lab - there) @ np.array(CHANNELS, np.float32), np.inf)
            least[1] = np.minimum(least[1], np.maximum(least[0], differs))
            least[0] = np.minimum(least[0], differs)
            count += shown
        known = count >= KNOWN
        if not known.any():
            return np.zeros(image.shape[:2], np.float32)
        differs = np.where(known, least[1], 0)
        loud = LOUD * float(np.median(differs[known]))
        share = cv2.blur(known.astype(np.float32), (AROUND, AROUND))
        usual = cv2.blur(np.minimum(differs, loud), (AROUND, AROUND)) / np.maximum(share, 1e-3)
        odds = (STEEP * np.log((differs + 1e-3) / (FLOOR + TIMES * usual))).clip(*RANGE)
        found: np.ndarray = cv2.resize(np.where(known, odds, 0).astype(np.float32), image.shape[1::-1])
        return found

    def _compared(self, place: int) -> list[_Kept]:
        """Return the frames of the same shot that a frame is compared with."""
        first = max(start for start in self._shot if start <= place)
        last = min([start for start in self._shot if start > place], default=len(self._to))
        fitting = [kept for kept in self._kept if first <= kept.place < last and abs(kept.place - place) >= NEAR]
        return sorted(fitting, key=lambda kept: abs(kept.place - place))[:MOST]


def _small(image: np.ndarray) -> np.ndarray:
    return cv2.resize(image, size_within(image.shape[1::-1], SIDE), interpolation=cv2.INTER_AREA)


def _lab(image: np.ndarray) -> np.ndarray:
    found: np.ndarray = cv2.cvtColor(image, cv2.COLOR_RGB2LAB).astype(np.float32)
    return found


def _registered(before: np.ndarray, after: np.ndarray) -> np.ndarray | None:
    """Return the homography from one grey frame to the next, [3, 3]; None where most of the picture has none."""
    corners = np.asarray(cv2.goodFeaturesToTrack(before, CORNERS, 0.005, APART), np.float32)
    if corners.ndim < 3 or len(corners) < LEAST_CORNERS:
        return None
    there, ahead = _tracked(before, after, corners)
    again, back = _tracked(after, before, there)
    missed = np.linalg.norm((again - corners)[:, 0], axis=1)
    sure = ahead & back & (missed < RETURN)
    if sure.sum() < LEAST_CORNERS:
        return None
    found, agree = cv2.findHomography(corners[sure], there[sure], cv2.RANSAC, INLIER)
    return None if found is None or agree.mean() < AGREE else found


def _tracked(here: np.ndarray, there: np.ndarray, corners: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return where corners went, [n, 1, 2], and which were found, bool [n]."""
    found, status, _ = cv2.calcOpticalFlowPyrLK(here, there, corners, np.zeros_like(corners), winSize=(15, 15))
    return np.asarray(found), np.asarray(status)[:, 0] > 0
