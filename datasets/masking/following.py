"""Follow one animal from frame to frame, from a box around it, a mask of it or strokes on it.

Each frame adds four kinds of evidence for every pixel, as log odds: how far it stands out in a window around the
animal (`saliency`), whether optical flow carries it from the mask of the frame before (`flow`), whether its colour is
the animal's or its surroundings', and whether other frames show the same there (`backdrop`). What the frame before had
hidden is no part of the animal at first, nor is what was seen apart from it before. A part that comes loose is dropped
where most of it was hidden a while ago: it is a neighbour that the animal had covered.
"""

from copy import copy

import cv2
import numpy as np
from scipy.special import expit, logit

from rewild4d.datasets.masking.correcting import corrected
from rewild4d.datasets.masking.flow import Flow, carried
from rewild4d.datasets.masking.grabcut import LOST, STRANGE, colors
from rewild4d.datasets.masking.makers import Box
from rewild4d.datasets.masking.parts import main_parts, others, without_young
from rewild4d.datasets.masking.saliency import Saliency

WINDOW = 0.6
"""Share of the animal's box by which the window around it is wider and higher."""
STARTS = (0.6, 2.0)
"""The same of the windows in which the first frame is read: a narrow one can miss a head, a wide one edges."""
OUTSTANDING, OUTSTANDING_RANGE = 0.6, (-3.0, 5.0)
"""Weight and range of the log odds of standing out."""
CARRIED, CARRIED_RANGE, SOFT = 0.6, 4.0, 2.0
"""The same of what flow carries, which is blurred by a Gaussian of so many pixels."""
UNSURE, UNCOVERED = 0.2, 2.0
"""Where flow there and back does not agree: share of that weight, and log odds against the animal."""
COLOURED, COLOURED_RANGE = 0.2, 2.5
"""The same of colours."""
BEHIND = 0.6
"""Weight of the log odds that a pixel is no backdrop."""
OTHER = 4.5
"""Log odds against the animal where something else is carried to that was seen apart from it (`parts.others`)."""
BINS, LEARNED = 16, 0.1
"""Colours a channel, and share of them that each frame teaches anew."""
TAUGHT = 0.5
"""The same of a frame that a person has corrected."""
DOUBT, DROPPED = 0.1, 0.05
"""How far from a half a chance is at least before strokes change it, and the chance of what they cut off."""
ALIKE = 0.5
"""What stands out elsewhere is the lost animal where its colours are this near (Bhattacharyya) those at the start."""
LEAST_AREA = 0.01
"""Least share of a frame that stands out as an animal."""


class Follower:
    """Follows an animal from a frame in which a box holds it, or marks tell where it is.

    Args:
        saliency: the network.
        image: the frame, uint8 [h, w, 3].
        apart: log odds that a pixel is no backdrop (`backdrop`), float32 [h, w].
        box: around the animal in its pixels; None: around the marks on it.
        said: marks (`marks`), int8 [h, w]; None where there are none.

    Attributes:
        mask: of the last frame, bool [h, w]; all False where the animal is lost.
        loose: what came loose in the last frame and was dropped, bool [h, w].
    """

    def __init__(
        self,
        saliency: Saliency,
        image: np.ndarray,
        apart: np.ndarray,
        box: Box | None = None,
        said: np.ndarray | None = None,
    ) -> None:
        self._saliency, self._flow = saliency, Flow()
        self._start(image, apart, box, said)
        self.loose = np.zeros_like(self.mask)
        self._looks, self._areas = colors(image, self.mask.astype(np.uint8)), [int(self.mask.sum())]

    def _start(self, image: np.ndarray, apart: np.ndarray, box: Box | None, said: np.ndarray | None = None) -> None:
        self._grey = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
        inside = np.zeros(self._grey.shape, bool)
        if box is not None:
            left, top, right, bottom = _clipped(box, self._grey.shape)
            inside[top:bottom, left:right] = True
            windows = [_window(inside, wider) for wider in STARTS]
        else:
            assert said is not None
            inside[:] = True
            windows = [(0, 0, image.shape[1], image.shape[0]), _window_about(said > 0)]
        if said is not None and said.all():
            odds = np.zeros(inside.shape)
        else:
            odds = np.mean([self._outstanding(image, window) for window in windows], axis=0) + BEHIND * apart
        chance = expit(np.where(inside, odds, -9.0))
        self.mask = main_parts(chance > 0.5, inside)
        if said is not None:
            chance = corrected(image, chance, said)
            near = said > 0 if (said > 0).any() else inside
            self.mask = _as_said(main_parts(chance > 0.5, near, touching=0.0), said)
        if not self.mask.any():  # nothing stands out: the box itself is the best guess
            self.mask = inside
        self._chance = np.where(self.mask, np.maximum(chance, expit(1.0)), chance).astype(np.float32)
        self._other = others(self.mask, apart)
        self._seen = self.mask.astype(np.float32)  # for how many frames flow has carried each pixel
        self._colours = _Colours(cv2.cvtColor(image, cv2.COLOR_RGB2LAB), self._chance)

    def twin(self) -> "Follower":
        """Return another follower that goes on from the same frame."""
        other = copy(self)
        other._areas, other._colours = [*self._areas], copy(self._colours)
        return other

    def correct(self, image: np.ndarray, apart: np.ndarray, said: np.ndarray) -> None:
        """Change the last frame's mask as strokes say.

        Args:
            image: the last frame, uint8 [h, w, 3].
            apart: its log odds that a pixel is no backdrop, float32 [h, w].
            said: marks, int8 [h, w].
        """
        if not self.mask.any():
            if (said > 0).any():
                self._start(image, apart, None, said)
            return
        before = np.where(self.mask, self._chance.clip(0.5 + DOUBT), self._chance.clip(0, 0.5 - DOUBT))
        chance = corrected(image, before, said)
        mask = _as_said(main_parts(chance > 0.5, self.mask | (said > 0), touching=0.0), said)
        oldest = float(self._seen.max())
        self._seen = np.where(mask, np.where(self.mask, self._seen, oldest), 0).astype(np.float32)
        self.mask, self._chance = mask, np.where(mask | (chance < 0.5), chance, DROPPED).astype(np.float32)
        self._other = np.where(mask, 0, self._other).astype(np.float32)
        if mask.any():
            self._areas[-1] = int(mask.sum())
            self._colours.learn(cv2.cvtColor(image, cv2.COLOR_RGB2LAB), self._chance, TAUGHT)

    def step(self, image: np.ndarray, apart: np.ndarray) -> np.ndarray:
        """Return the mask in the next frame, bool [h, w]; all False where the animal is lost or not found again.

        Args:
            image: the frame, uint8 [h, w, 3].
            apart: log odds that a pixel is no backdrop (`backdrop`), float32 [h, w].
        """
        grey = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
        self.loose = np.zeros(grey.shape, bool)
        if not self.mask.any():
            self._find_again(image, apart)
            self._grey = grey
            return self.mask
        flow, sure = self._flow.checked(grey, self._grey)
        before = carried(self._chance, flow)
        near = before > 0.5
        lab = cv2.cvtColor(image, cv2.COLOR_RGB2LAB)
        odds = self._outstanding(image, _window(near)) + BEHIND * apart + COLOURED * self._colours.odds(lab)
        soft = logit(cv2.GaussianBlur(before, (0, 0), SOFT).clip(0, 1)).clip(-CARRIED_RANGE, CARRIED_RANGE)
        odds += CARRIED * np.where(sure, 1.0, UNSURE) * soft
        odds -= np.where(sure, 0.0, UNCOVERED)
        other = carried(self._other, flow)
        odds -= OTHER * other
        mask = main_parts((odds > 0) & _window_of(near), cv2.dilate(near.astype(np.uint8), np.ones((9, 9))) > 0)
        seen = np.where(mask, np.where(sure, carried(self._seen, flow, cv2.INTER_NEAREST), 0) + 1, 0)
        whole, mask = mask, without_young(mask, seen)
        self._other = np.where(mask, 0, np.maximum(other, others(mask, apart))).astype(np.float32)
        self.loose = whole & ~mask
        self._keep(image, lab, mask, np.where(mask | (odds <= 0), odds, -3.0), seen)
        self._grey = grey
        return self.mask

    def _keep(self, image: np.ndarray, lab: np.ndarray, mask: np.ndarray, odds: np.ndarray, seen: np.ndarray) -> None:
        """Take a frame's mask over, or nothing where the animal is lost."""
        self._areas.append(int(mask.sum()))
        strange = cv2.compareHist(self._looks, colors(image, mask.astype(np.uint8)), cv2.HISTCMP_BHATTACHARYYA)
        if self._areas[-1] < max(LOST * np.median(self._areas), 1) or strange > STRANGE:
            mask = np.zeros_like(mask)
        self.mask, self._seen = mask, np.where(mask, seen, 0).astype(np.float32)
        self._chance = expit(np.where(_window_of(mask), odds, -6.0)).astype(np.float32)
        if mask.any():
            self._colours.learn(lab, self._chance, LEARNED)

    def _outstanding(self, image: np.ndarray, window: tuple[int, int, int, int]) -> np.ndarray:
        """Return the weighted log odds of standing out in a window, [h, w]; the lowest outside."""
        odds = np.full(image.shape[:2], OUTSTANDING * OUTSTANDING_RANGE[0], np.float32)
        left, top, right, bottom = window
        if right > left and bottom > top:
            found = logit(self._saliency(image[top:bottom, left:right])).clip(*OUTSTANDING_RANGE)
            odds[top:bottom, left:right] = OUTSTANDING * found
        return odds

    def _find_again(self, image: np.ndarray, apart: np.ndarray) -> None:
        """Start again from what stands out in the whole frame and looks most as the animal did, if anything does."""
        found = []
        for box, mask in standing_out(self._saliency(image)):
            away = cv2.compareHist(self._looks, colors(image, mask.astype(np.uint8)), cv2.HISTCMP_BHATTACHARYYA)
            if away < ALIKE and mask.sum() > LOST * np.median(self._areas):
                found.append((away, box))
        if found:
            self._start(image, apart, min(found)[1])


class _Colours:
    """How often each colour is the animal's and its surroundings'."""

    def __init__(self, lab: np.ndarray, chance: np.ndarray) -> None:
        self._inside = self._outside = np.zeros(BINS**3)
        self.learn(lab, chance, 1.0)

    def learn(self, lab: np.ndarray, chance: np.ndarray, share: float) -> None:
        """Learn from a frame, [h, w, 3], and the chance of each pixel, [h, w], in the window around the animal."""
        codes = _codes(lab)
        counts = []
        for chosen in (chance > 0.7, _window_of(chance > 0.5) & (chance < 0.2)):
            count = np.bincount(codes[chosen], minlength=BINS**3)
            counts.append(count / max(1, count.sum()))
        self._inside = (1 - share) * self._inside + share * counts[0]
        self._outside = (1 - share) * self._outside + share * counts[1]

    def odds(self, lab: np.ndarray) -> np.ndarray:
        """Return the log odds of each pixel's colour, [h, w]."""
        odds = np.log((self._inside + 1e-4) / (self._outside + 1e-4)).clip(-COLOURED_RANGE, COLOURED_RANGE)
        found: np.ndarray = odds.astype(np.float32)[_codes(lab)]
        return found


def _codes(lab: np.ndarray) -> np.ndarray:
    bins = lab.astype(np.int32) * BINS >> 8
    found: np.ndarray = (bins[..., 0] * BINS + bins[..., 1]) * BINS + bins[..., 2]
    return found


def _clipped(box: Box, shape: tuple[int, ...]) -> tuple[int, int, int, int]:
    """Return left, top, right and bottom of a box inside an image, in whole pixels."""
    left, top, width, height = box
    return (
        max(0, int(left)), max(0, int(top)),
        min(shape[1], int(np.ceil(left + width))), min(shape[0], int(np.ceil(top + height))),
    )  # fmt: skip


def _window(mask: np.ndarray, wider: float = WINDOW) -> tuple[int, int, int, int]:
    """Return left, top, right and bottom of the box around a mask, made larger by a share of its size."""
    left, top, width, height = cv2.boundingRect(mask.astype(np.uint8))
    x, y = wider * width / 2, wider * height / 2
    return _clipped((left - x, top - y, width + 2 * x, height + 2 * y), mask.shape)


def _window_about(strokes: np.ndarray) -> tuple[int, int, int, int]:
    """Return the window about strokes that may cover little of an animal: half the frame at least."""
    left, top, width, height = cv2.boundingRect(strokes.astype(np.uint8))
    high, wide = strokes.shape
    more_x, more_y = max(width, (wide / 2 - width) / 2), max(height, (high / 2 - height) / 2)
    return _clipped((left - more_x, top - more_y, width + 2 * more_x, height + 2 * more_y), strokes.shape)


def _window_of(mask: np.ndarray) -> np.ndarray:
    """Return the window around a mask as a mask."""
    inside = np.zeros(mask.shape, bool)
    if mask.any():
        left, top, right, bottom = _window(mask)
        inside[top:bottom, left:right] = True
    return inside


def _as_said(mask: np.ndarray, said: np.ndarray) -> np.ndarray:
    """Return a mask that keeps to the marks, however small."""
    found: np.ndarray = (mask | (said > 0)) & (said >= 0)
    return found


def standing_out(found: np.ndarray) -> list[tuple[Box, np.ndarray]]:
    """Return what stands out in a whole frame, the largest first: boxes and masks.

    Args:
        found: how far each pixel stands out, [h, w].
    """
    _, labels, stats, _ = cv2.connectedComponentsWithStats((found > 0.5).astype(np.uint8))
    order = 1 + np.argsort(-stats[1:, cv2.CC_STAT_AREA], kind="stable")
    left, top, width, height = cv2.CC_STAT_LEFT, cv2.CC_STAT_TOP, cv2.CC_STAT_WIDTH, cv2.CC_STAT_HEIGHT
    return [
        ((float(stats[k, left]), float(stats[k, top]), float(stats[k, width]), float(stats[k, height])), labels == k)
        for k in order
        if stats[k, cv2.CC_STAT_AREA] >= LEAST_AREA * found.size
    ]
