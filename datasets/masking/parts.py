"""Parts of masks that hang together: which of them are the animal's, and which are something else."""

import cv2
import numpy as np

YOUNG, GAP = 0.5, 5
"""A loose part is dropped where it was first seen less than this share of the largest part's frames ago; parts with a
narrower gap between them, pixels, are one."""
LEAST_PART, TOUCHING = 0.02, 0.3
"""Least area of a part, of the largest one's, and the least share of it where flow carries the mask, or near."""
GRAIN = 5
"""Side of the smallest square that counts as a part, pixels."""
AWAY, LEAST_OTHER = 15, 0.3
"""Something else lies more than so many pixels from the animal, and has at least this share of its area."""


def main_parts(mask: np.ndarray, near: np.ndarray, touching: float = TOUCHING) -> np.ndarray:
    """Return the parts of a mask that are not small and of which more than a share lies in ``near``."""
    count, labels, stats, _ = cv2.connectedComponentsWithStats(mask.astype(np.uint8))
    areas = stats[:, cv2.CC_STAT_AREA].astype(np.float64)
    inside = np.bincount(labels[near], minlength=count)
    is_kept = inside > touching * areas
    is_kept[0] = False
    if is_kept.any():
        is_kept &= areas >= LEAST_PART * areas[is_kept].max()
    found: np.ndarray = is_kept[labels]
    return found


def without_young(mask: np.ndarray, seen: np.ndarray) -> np.ndarray:
    """Return a mask without the loose parts that were first seen long after the largest one.

    Args:
        mask: bool [h, w].
        seen: for how many frames flow has carried each pixel, [h, w].
    """
    together = cv2.dilate(mask.astype(np.uint8), np.ones((GAP, GAP), np.uint8))
    count, labels, stats, _ = cv2.connectedComponentsWithStats(together)
    if count <= 2:
        return mask
    ages = [float(np.median(seen[(labels == part) & mask])) for part in range(1, count)]
    oldest = ages[int(stats[1:, cv2.CC_STAT_AREA].argmax())]
    return mask & np.isin(labels, [part + 1 for part, age in enumerate(ages) if age >= YOUNG * oldest])


def coarse(mask: np.ndarray) -> np.ndarray:
    """Return a mask without what is too thin for a square of `GRAIN` pixels: rims that flow leaves over."""
    found: np.ndarray = cv2.morphologyEx(mask.astype(np.uint8), cv2.MORPH_OPEN, np.ones((GRAIN, GRAIN), np.uint8)) > 0
    return found


def others(mask: np.ndarray, apart: np.ndarray) -> np.ndarray:
    """Return what is there apart from the animal, a person for one, float32 [h, w], 0 or 1.

    Args:
        mask: of the animal, bool [h, w].
        apart: log odds that a pixel is no backdrop; 0, where nothing is known, is no backdrop either, since something
            stood out there throughout.
    """
    if not mask.any():
        return np.zeros(mask.shape, np.float32)
    animal = mask.astype(np.uint8)
    things = coarse((apart > 1) | (apart == 0))
    _, labels, stats, _ = cv2.connectedComponentsWithStats((things | mask).astype(np.uint8))
    is_other = stats[:, cv2.CC_STAT_AREA] >= LEAST_OTHER * mask.sum()
    is_other[0] = False
    is_other[np.unique(labels[cv2.dilate(animal, np.ones((2 * AWAY + 1,) * 2, np.uint8)) > 0])] = False
    found: np.ndarray = is_other[labels].astype(np.float32)
    return found
