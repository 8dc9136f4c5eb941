"""The rough way to masks: GrabCut (Rother, Kolmogorov and Blake 2004) from a box, carried along by optical flow.

It needs no network weights and nothing but OpenCV. It takes shadows for the animal, loses thin legs and tails, and
drifts onto what looks alike; a segmentation network does much better. Look at the contact sheet of `check` first.
"""

from collections.abc import Iterator

import cv2
import numpy as np

from rewild4d.datasets.images import size_within
from rewild4d.datasets.masking.flow import Flow, carried
from rewild4d.datasets.masking.makers import Box, Unmasked
from rewild4d.errors import UserError

WORK_SIDE = 480
"""Frames are segmented at this longer side."""
GROWN = 0.06
"""Around the carried mask, this share of its size is unsure in both directions."""
LOST = 0.3
"""The animal is lost where its mask falls below this share of its median size so far."""
STRANGE = 0.7
"""It is lost, too, where the colours in its mask are further than this (Bhattacharyya) from those in its box."""
LEAST_FILL = 0.2
"""Share of a box that its animal fills at least."""
FIRST_ROUNDS, ROUNDS = 5, 2


def rough_masks(source: Unmasked) -> Iterator[np.ndarray]:
    """Yield grabCut on every frame; before the first box and after the animal is lost masks are empty.

    Raises:
        UserError: no box.
    """
    if not source.boxes:
        raise UserError("--box: the rough masks need a box around the animal: --box left,top,width,height (pixels).")
    scale = min(1.0, WORK_SIDE / max(source.size))
    size = size_within(source.size, WORK_SIDE)
    flow = Flow()
    before: np.ndarray | None = None
    mask: np.ndarray | None = None
    looks: np.ndarray | None = None
    areas: list[int] = []
    for index, image in enumerate(source.images()):
        small = cv2.resize(image, size, interpolation=cv2.INTER_AREA)
        grey = cv2.cvtColor(small, cv2.COLOR_RGB2GRAY)
        if index in source.boxes:
            mask, areas = from_box(small, source.boxes[index], scale), []
            looks = colors(small, mask)
        elif mask is not None and before is not None:
            mask = from_mask(small, carried(mask, flow(grey, before), cv2.INTER_NEAREST))
        if mask is not None:
            areas.append(int(mask.sum()))
            strange = looks is not None and cv2.compareHist(looks, colors(small, mask), cv2.HISTCMP_BHATTACHARYYA)
            if areas[-1] < LOST * np.median(areas) or strange > STRANGE:
                mask = None
        before = grey
        found = np.zeros(size[::-1], np.uint8) if mask is None else mask * np.uint8(255)
        yield cv2.resize(found, source.size, interpolation=cv2.INTER_LINEAR)


def from_box(image: np.ndarray, box: Box, scale: float) -> np.ndarray:
    """Return the mask inside a box (pixels of the original frame, ``scale`` of which ``image`` has), 0 or 1."""
    height, width = image.shape[:2]
    left, top = (round(max(0.0, value * scale)) for value in box[:2])
    right, bottom = (round((box[i] + box[i + 2]) * scale) for i in (0, 1))
    labels = np.full((height, width), cv2.GC_BGD, np.uint8)
    labels[top : min(bottom, height - 1), left : min(right, width - 1)] = cv2.GC_PR_FGD
    if not (labels == cv2.GC_PR_FGD).any():
        raise UserError(f"--box: expected a box inside the frame of {width / scale:.0f} pixels width, got {box}.")
    mask = _largest(_cut(image, labels, FIRST_ROUNDS))
    inside = int((labels != cv2.GC_BGD).sum())
    if mask.sum() < LEAST_FILL * inside:  # the animal looks like what is around it: its middle must be the animal
        x, y, w, h = cv2.boundingRect((labels != cv2.GC_BGD).astype(np.uint8))
        cv2.ellipse(labels, (x + w // 2, y + h // 2), (max(1, w // 4), max(1, h // 5)), 0, 0, 360, cv2.GC_FGD, -1)
        mask = _largest(_cut(image, labels, FIRST_ROUNDS))
    return mask


def colors(image: np.ndarray, mask: np.ndarray) -> np.ndarray:
    """Return the histogram of the colours in a mask, [8, 8, 8], sums to one."""
    counts = cv2.calcHist([image], [0, 1, 2], mask, [8, 8, 8], [0, 256] * 3)
    return counts / max(1.0, float(counts.sum()))


def from_mask(image: np.ndarray, carried: np.ndarray) -> np.ndarray | None:
    """Return the mask near one that was carried over from the frame before, 0 or 1; None where nothing is left."""
    area = int(carried.sum())
    if not area:
        return None
    radius = max(3, round(GROWN * area**0.5))
    kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * radius + 1, 2 * radius + 1))
    near, sure = cv2.dilate(carried, kernel), cv2.erode(carried, kernel)
    labels = np.where(near > 0, np.where(carried > 0, cv2.GC_PR_FGD, cv2.GC_PR_BGD), cv2.GC_BGD).astype(np.uint8)
    labels[sure > 0] = cv2.GC_FGD
    if not (labels == cv2.GC_BGD).any():
        return carried
    return _largest(_cut(image, labels, ROUNDS))


def _cut(image: np.ndarray, labels: np.ndarray, rounds: int) -> np.ndarray:
    """Run GrabCut on the part of the image around the labels: colours far away say nothing about the animal."""
    height, width = labels.shape
    x, y, w, h = cv2.boundingRect((labels != cv2.GC_BGD).astype(np.uint8))
    pad = max(12, round(0.35 * max(w, h)))
    part = slice(max(0, y - pad), min(height, y + h + pad)), slice(max(0, x - pad), min(width, x + w + pad))
    window = np.ascontiguousarray(labels[part])
    cv2.setRNGSeed(0)  # its colour models start at random
    models, pixels = np.zeros((2, 1, 65)), np.ascontiguousarray(image[part])
    cv2.grabCut(pixels, window, (0, 0, 0, 0), models[0], models[1], rounds, cv2.GC_INIT_WITH_MASK)
    mask = np.zeros_like(labels)
    mask[part] = np.isin(window, (cv2.GC_FGD, cv2.GC_PR_FGD))
    return mask


def _largest(mask: np.ndarray) -> np.ndarray:
    """Return the largest part and those not far below it, without small holes, 0 or 1."""
    closed = cv2.morphologyEx(mask, cv2.MORPH_CLOSE, np.ones((3, 3), np.uint8))
    count, labels, stats, _ = cv2.connectedComponentsWithStats(closed)
    if count < 2:
        return closed
    areas = stats[1:, cv2.CC_STAT_AREA]
    return np.isin(labels, 1 + np.flatnonzero(areas >= 0.1 * areas.max())).astype(np.uint8)
