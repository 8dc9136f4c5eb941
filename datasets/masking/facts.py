"""What a mask says about the animal in it: where it lies, parts, holes, what cuts it; and where masks jump."""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

NOISE = 0.04
"""Parts smaller than this share of the largest one do not widen the animal's box."""
CUT_SHARE = 0.1
"""The animal is cut where it touches the image's border along more than this share of its shorter side."""
JUMP = 0.35
"""A mask jumps where its area changes by more than this share, or its middle moves by as much of its width."""
FRAMED = 0.9
"""Of an image's border that is animal: more, and the mask is inverted or covers everything."""


@dataclass(frozen=True)
class MaskFacts:
    """What a mask says about the animal in it.

    Attributes:
        box: left, top, right, bottom of all parts that count, in pixels; None where there is no animal.
        is_cut: it reaches over the image's border.
        parts: the area of each connected part in pixels, largest first.
        holes: area enclosed by the animal over the animal's area.
        framed: share of the image's border that is animal, in [0, 1].
    """

    box: tuple[int, int, int, int] | None
    is_cut: bool
    parts: tuple[int, ...]
    holes: float
    framed: float = 0.0

    @property
    def area(self) -> int:
        return sum(self.parts)

    @property
    def second(self) -> float:
        """The second part's area over the largest one's; 0 where there is one part or none."""
        return self.parts[1] / self.parts[0] if len(self.parts) > 1 else 0.0


def mask_facts(mask: np.ndarray) -> MaskFacts:
    """Look at one mask, uint8 [h, w]."""
    solid = (mask > 127).astype(np.uint8)
    count, labels, stats, _ = cv2.connectedComponentsWithStats(solid)
    areas = stats[1:, cv2.CC_STAT_AREA]
    if count < 2:
        return MaskFacts(None, False, (), 0.0)
    large = 1 + np.flatnonzero(areas >= NOISE * areas.max())
    lower = stats[large, :2].min(axis=0)
    upper = (stats[large, :2] + stats[large, 2:4]).max(axis=0)
    edges = (labels[0], labels[-1], labels[:, 0], labels[:, -1])
    contact = max(int(np.isin(edge, large).sum()) for edge in edges)
    framed = float((np.concatenate(edges) > 0).mean())
    is_cut = contact > CUT_SHARE * int((upper - lower).min())
    box = (int(lower[0]), int(lower[1]), int(upper[0]), int(upper[1]))
    parts = tuple(sorted(map(int, areas), reverse=True))
    return MaskFacts(box, is_cut, parts, _holes(solid) / int(areas.sum()), framed)


def jumps(facts: Sequence[MaskFacts | None]) -> list[int]:
    """Return frames whose mask differs much from that of the frame before (`JUMP`).

    Args:
        facts: of each frame's mask; None where it has none.
    """
    found = []
    for i in range(1, len(facts)):
        before, after = facts[i - 1], facts[i]
        if before is None or after is None or before.box is None or after.box is None:
            continue
        grown = max(before.area, after.area) / min(before.area, after.area) - 1
        a, b = np.array(before.box, dtype=float), np.array(after.box, dtype=float)
        moved = np.abs((a[:2] + a[2:]) / 2 - (b[:2] + b[2:]) / 2).max() / max(1.0, float((a[2:] - a[:2]).max()))
        if grown > JUMP or moved > JUMP:
            found.append(i)
    return found


def _holes(solid: np.ndarray) -> int:
    """Return pixels of background that no path joins to the border."""
    padded = cv2.copyMakeBorder(1 - solid, 1, 1, 1, 1, cv2.BORDER_CONSTANT, value=1)
    _, labels = cv2.connectedComponents(padded, connectivity=4)
    return int(((padded > 0) & (labels != labels[0, 0])).sum())
