"""Keep sums and counts of every frame, so that each paper's mean over frames, joints and clips follows from them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

WORST = 0.05
"""Share of the frames that a mean of the worst covers (4D-Animal)."""


@dataclass(frozen=True)
class FrameSums:
    """Sums and counts by frame (or by pair of frames).

    Attributes:
        sums: of what was counted, float64, [T].
        counts: how many values each sum has, int64, [T].

    Examples:
        >>> clip = FrameSums(np.array([2.0, 1.0]), np.array([4, 1]))
        >>> clip.pooled(), clip.mean_of_frames()
        (0.6, 0.75)
    """

    sums: Floats
    counts: NDArray[np.int64]

    def __add__(self, other: FrameSums) -> FrameSums:
        """Put another clip's frames behind these."""
        return FrameSums(np.concatenate((self.sums, other.sums)), np.concatenate((self.counts, other.counts)))

    @property
    def total(self) -> int:
        """Values in all."""
        return int(self.counts.sum())

    def per_frame(self) -> list[float | None]:
        """Return each frame's own mean; None for a frame that counts nothing."""
        return [float(s / n) if n else None for s, n in zip(self.sums, self.counts, strict=True)]

    def pooled(self) -> float | None:
        """Return the mean over all values alike; None where there is none."""
        return float(self.sums.sum() / self.total) if self.total else None

    def mean_of_frames(self, empty: float | None = None) -> float | None:
        """Return the mean of the frames' own means; None where no frame has one.

        Args:
            empty: what a frame that counts nothing stands in with; where None it is left out.
        """
        values = [empty if value is None else value for value in self.per_frame()]
        present = [value for value in values if value is not None]
        return float(np.mean(present)) if self.total and present else None


def worst_mean(values: Sequence[float], better: str, share: float = WORST) -> float | None:
    """Compute the mean of the worst frames, int(share * n) of them.

    Source: 4D-Animal's IoU_w5 and PSNR_w5, scene_optim/callbacks/callback_eval.py at febe711, where too few frames give
    a NaN.

    Args:
        values: one a frame, finite.
        better: "higher" or "lower".
        share: of the frames, in (0, 1].

    Returns:
        None where the share of so few frames is not even one (fewer than 20 frames for 0.05).

    Examples:
        >>> worst_mean([0.9] * 38 + [0.1, 0.3], "higher")
        0.2
        >>> worst_mean([0.9] * 19, "higher") is None
        True
    """
    ordered = np.sort(np.asarray(values, dtype=np.float64))
    # multiplied before it is cut, as there: 0.05 * 20 is exactly 1
    count = int(share * len(ordered))
    if not count:
        return None
    return float((ordered[:count] if better == "higher" else ordered[-count:]).mean())
