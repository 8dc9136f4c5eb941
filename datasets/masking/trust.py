"""Judge a film's masks without true ones: do their edges lie on the picture's, and does what stands out lie in them?

Three kinds of evidence, from a few frames. Around a good mask the picture changes most along the mask's own edge, and
not further in or out. What stands out in a window around the mask (U²-Net-p, where its weights are here) is what the
mask holds. Optical flow carries each mask to the next one. And from all frames: whether masks are lost between others,
or jump. The bounds were set on two films of DAVIS with true masks and with spoilt ones (docs/experiments/trust.md).
"""

from collections.abc import Sequence
from dataclasses import dataclass, field

import cv2
import numpy as np

from rewild4d.contracts import Verdict
from rewild4d.datasets.images import size_within
from rewild4d.datasets.masking.facts import FRAMED, MaskFacts, jumps, mask_facts
from rewild4d.datasets.masking.flow import Flow, carried
from rewild4d.datasets.masking.saliency import NAME, Saliency
from rewild4d.metrics.weights import FETCH, is_here, load_weights

LOOKED_AT = 6
"""Frames of a film that are looked at, each with the one after it."""
WORK_SIDE = 854
"""They are read at this longer side."""
RING, RINGS = 0.02, 8
"""Width of a ring along the edge, as a share of the root of the mask's area, and rings inward and outward."""
ON_EDGE = 1.25
"""On a mask's edge the picture changes by at least so many times as much as in the other rings."""
BESIDE, SHARPER = 2, 1.3
"""An edge lies elsewhere where the picture changes most so many rings away, by at least so many times as much."""
WINDOW, OWN = 0.6, 0.2
"""Share by which the window is larger than the mask's box; what stands out counts where as much of it is the mask's."""
COVERED, BARE = 0.9, 0.6
"""Share of what stands out that lies in a mask: less, and parts may be missing; less than the second, most is."""
INSIDE = 0.5
"""Share of a mask that stands out: less, and it may be another thing."""
AGREED = 0.65
"""Overlap (IoU) of a mask with what stands out: less counts against it where its edges are poor, too."""
CARRIED = 0.85
"""Overlap (IoU) of a mask with the one before carried by flow, where flow is sure: less, and masks jump."""
UNSTEADY = 0.025
"""Share of a film's frames in which the animal is lost between others, or its mask jumps: more, and it is told."""
GOOD = Verdict("masks", "green", "their edges lie on the picture's, and what stands out lies in them")


@dataclass
class MaskTrust:
    """Gathers evidence from a film's frames, in their order.

    Attributes:
        count: of the film's frames.
    """

    count: int
    _rings: list[np.ndarray] = field(default_factory=list)
    _outstanding: list[tuple[float, float, float]] = field(default_factory=list)
    _carried: list[float] = field(default_factory=list)
    _bare: list[int] = field(default_factory=list)
    _framed: list[float] = field(default_factory=list)
    _facts: list[MaskFacts | None] = field(default_factory=list)
    _before: tuple[np.ndarray, np.ndarray] | None = None
    _saliency: Saliency | None = None

    def __post_init__(self) -> None:
        last = max(0, self.count - 2)
        self._chosen = set(np.linspace(0, last, min(LOOKED_AT, last + 1)).round().astype(int).tolist())
        if is_here(NAME):
            self._saliency = Saliency(load_weights(NAME))

    def add(self, index: int, image: np.ndarray, mask: np.ndarray | None) -> None:
        """Look at a frame.

        Args:
            index: of it, from 0.
            image: uint8 [h, w, 3], red, green, blue.
            mask: uint8 [h, w]; None where there is none.
        """
        self._facts.append(None if mask is None else mask_facts(mask))
        before, self._before = self._before, None
        if before is None and index not in self._chosen:
            return
        size = size_within(image.shape[1::-1], WORK_SIDE)
        small = cv2.resize(image, size, interpolation=cv2.INTER_AREA)
        solid = np.zeros(size[::-1], bool)
        if mask is not None:
            solid = cv2.resize(mask, size, interpolation=cv2.INTER_AREA) > 127
        if before is not None and before[1].any() and solid.any():
            self._carried.append(_followed(*before, small, solid))
        if index in self._chosen:
            self._before = (small, solid)
            self._look(index, small, solid)

    def _look(self, index: int, image: np.ndarray, mask: np.ndarray) -> None:
        if not mask.any() or mask.all():
            return
        self._framed.append(mask_facts(mask * np.uint8(255)).framed)
        self._rings.append(_rings(image, mask))
        if self._saliency is not None:
            covered, inside, overlap = _outstanding(self._saliency, image, mask)
            self._outstanding.append((covered, inside, overlap))
            if covered < COVERED:
                self._bare.append(index)

    def verdict(self, labels: Sequence[str]) -> Verdict:
        """Return what the evidence says.

        Args:
            labels: what a sentence calls each frame.
        """
        if not self._rings:
            return Verdict("masks", "red", "none of the frames that were looked at has a mask", "make masks: masks")
        if np.median(self._framed) > FRAMED:
            return Verdict("masks", "red", "the animal lies all along the image's border", "invert the masks")
        rings = np.mean(self._rings, axis=0)
        here, peak = float(rings[RINGS]), int(rings.argmax()) - RINGS
        if abs(peak) >= BESIDE and rings.max() > SHARPER * here:
            way, where = ("small", "outside") if peak < 0 else ("large", "inside")
            told = f"they are too {way}, or shifted: the picture's edges lie {where} theirs, by {abs(peak) * RING:.0%}"
            return Verdict("masks", "red", f"{told} of the animal's size", "look at the contact sheet; make them anew")
        covered, inside, overlap = np.median(self._outstanding, axis=0) if self._outstanding else (1.0, 1.0, 1.0)
        if covered < BARE or (here < ON_EDGE and overlap < AGREED):
            told = f"{overlap:.0%} of them and of what stands out in the picture is the same"
            return Verdict(
                "masks", "red", told, "are they of these frames, and of the animal? look at the contact sheet"
            )
        return self._doubts(here, covered, inside, labels)

    def _doubts(self, here: float, covered: float, inside: float, labels: Sequence[str]) -> Verdict:
        look = "look at the contact sheet"
        if inside < INSIDE:
            return Verdict("masks", "yellow", f"only {inside:.0%} of them stands out in the picture", look)
        if covered < COVERED:
            where = ", ".join(labels[index] for index in self._bare[:3])
            told = f"{1 - covered:.0%} of what stands out lies outside them (head, legs or a rider?), first in {where}"
            return Verdict("masks", "yellow", told, f"{look}; --marks sets masks right")
        if self._carried and np.median(self._carried) < CARRIED:
            told = f"motion carries only {np.median(self._carried):.0%} of a mask to the next one"
            return Verdict("masks", "yellow", f"they jump: {told}", look)
        if told := self._unsteady(labels):
            return Verdict("masks", "yellow", told, f"{look}; --box frame:..., or --marks, sets masks right")
        if here < ON_EDGE:
            return Verdict("masks", "yellow", "their edges do not lie on the picture's", f"shifted masks? {look}")
        if self._saliency is None:
            told = f"their edges lie on the picture's; what stands out was not looked at ({FETCH} {NAME})"
            return Verdict("masks", "green", told)
        return GOOD

    def _unsteady(self, labels: Sequence[str]) -> str:
        """Return a sentence where masks are lost between others, or jump, in too many frames; "" elsewhere."""
        areas = [None if fact is None else fact.area for fact in self._facts]
        there = [index for index, area in enumerate(areas) if area]
        lost = {index for index, area in enumerate(areas) if area == 0 and there[0] < index < there[-1]}
        found = sorted(lost | {*jumps(self._facts)})
        if len(found) <= UNSTEADY * len(self._facts):
            return ""
        where = ", ".join(labels[index] for index in found[:3])
        return f"the animal is lost, or its mask jumps, in {len(found)} of {len(self._facts)} frames, first in {where}"


def _rings(image: np.ndarray, mask: np.ndarray) -> np.ndarray:
    """Return how much the picture changes in rings along a mask's edge, from inside to outside, over their mean.

    Returns:
        [2 RINGS + 1], the mask's own edge in the middle; outside comes first.
    """
    lab = cv2.GaussianBlur(cv2.cvtColor(image, cv2.COLOR_RGB2LAB).astype(np.float32), (0, 0), 1.0)
    change = np.sqrt(sum((cv2.Sobel(lab, cv2.CV_32F, *way) ** 2).sum(-1) for way in ((1, 0), (0, 1))))
    solid = mask.astype(np.uint8)
    depth = cv2.distanceTransform(solid, cv2.DIST_L2, 5) - cv2.distanceTransform(1 - solid, cv2.DIST_L2, 5)
    depth -= np.sign(depth) / 2  # the edge lies between two pixels
    ring = np.round(depth / max(1.0, RING * float(np.sqrt(mask.sum())))).astype(int) + RINGS
    inner = np.zeros_like(mask)
    inner[3:-3, 3:-3] = True
    counted = inner & (ring >= 0) & (ring <= 2 * RINGS)
    total = np.bincount(ring[counted], change[counted], minlength=2 * RINGS + 1)
    means = total / np.maximum(1, np.bincount(ring[counted], minlength=2 * RINGS + 1))
    found: np.ndarray = means / max(float(means.mean()), 1e-6)
    return found


def _outstanding(saliency: Saliency, image: np.ndarray, mask: np.ndarray) -> tuple[float, float, float]:
    """Return the share of what stands out that is the mask's, the share of the mask that stands out, and their IoU."""
    left, top, width, height = cv2.boundingRect(mask.astype(np.uint8))
    x, y = int(WINDOW * width / 2), int(WINDOW * height / 2)
    near = np.s_[max(0, top - y) : top + height + y, max(0, left - x) : left + width + x]
    own = mask[near]
    _, labels = cv2.connectedComponents((saliency(image[near]) > 0.5).astype(np.uint8))
    areas, shared = np.bincount(labels.ravel()), np.bincount(labels.ravel(), own.ravel().astype(float))
    counts = shared > OWN * areas
    counts[0] = False
    found = counts[labels]
    both = float((found & own).sum())
    return both / max(1, found.sum()), both / max(1, own.sum()), both / max(1, (found | own).sum())


def _followed(image: np.ndarray, mask: np.ndarray, after: np.ndarray, mask_after: np.ndarray) -> float:
    """Return the overlap (IoU) of a mask, carried by flow, with the next frame's, where flow is sure."""
    greys = (cv2.cvtColor(after, cv2.COLOR_RGB2GRAY), cv2.cvtColor(image, cv2.COLOR_RGB2GRAY))
    flow, sure = Flow().checked(*greys)
    there = carried(mask.astype(np.float32), flow) > 0.5
    return float((there & mask_after & sure).sum() / max(1, ((there | mask_after) & sure).sum()))
