"""Judge a result without the truth: parts that came off the body, needles, held-out masks."""

from collections.abc import Mapping, Sequence

import numpy as np
from scipy.ndimage import label

from rewild4d.contracts import Reconstruction, Verdict
from rewild4d.metrics.score import Score
from rewild4d.types import Splats

COVERED, BARELY = 0.7, 0.5
"""IoU of the render with the held-out masks: below the first look at it, below the second do not rely on it."""
GAP, SEEN = 0.02, 0.3
"""Gaussians of at least this opacity belong together whose cells of this share of the body's diagonal touch."""
FAR = 100
"""Cells from the body's corner at which a stray Gaussian counts at most."""
APART, TORN = 0.02, 0.08
"""Share of the visible Gaussians that are apart from the body: more, and it is to be looked at; limbs are torn off."""
NEEDLE, NEEDLES = 0.1, 0.005
"""A Gaussian longer than this share of the body's diagonal is a needle; share of them above which it is told."""


def result_verdict(reconstruction: Reconstruction, times: Sequence[float], scores: Mapping[str, Score]) -> Verdict:
    """Judge a reconstruction by its Gaussians and by held-out masks.

    Args:
        reconstruction: of a clip.
        times: of its frames, seconds.
        scores: of the record; "iou" is asked for.
    """
    moments = [reconstruction.at(times[i]) for i in sorted({0, len(times) // 2, len(times) - 1})]
    if not min(len(moment) for moment in moments):
        return Verdict("result", "red", "there are no Gaussians")
    apart, needles = (max(values) for values in zip(*map(body_facts, moments), strict=True))
    look = "look at orbit.png"
    iou = scores["iou"].value if "iou" in scores else None
    if apart > TORN:
        told = f"{apart:.0%} of the visible Gaussians are apart from the body: a limb is torn off, or a thing beside it"
        return Verdict("result", "red", told, look)
    if iou is not None and iou < BARELY:
        return Verdict("result", "red", f"it covers the animal in held-out images with IoU {iou:.2f} only", look)
    if apart > APART:
        told = f"{apart:.0%} of the visible Gaussians are apart from the body"
        return Verdict("result", "yellow", told, look)
    if needles > NEEDLES:
        return Verdict("result", "yellow", f"{needles:.1%} of the visible Gaussians are long needles", look)
    if iou is not None and iou < COVERED:
        return Verdict("result", "yellow", f"it covers the animal in held-out images with IoU {iou:.2f} only", look)
    covers = "" if iou is None else f" and covers the animal in held-out images (IoU {iou:.2f})"
    return Verdict("result", "green", f"it hangs together{covers}")


def body_facts(splats: Splats) -> tuple[float, float]:
    """Return the share of the visible Gaussians that are apart from the body, and the share of needles.

    Args:
        splats: at one time.
    """
    seen = splats.opacities.detach().cpu().numpy().ravel() >= SEEN
    means = splats.means.detach().cpu().numpy()[seen]
    if not len(means):
        return 0.0, 0.0
    low, high = np.quantile(means, (0.005, 0.995), axis=0)
    diagonal = float(np.linalg.norm(high - low)) or 1.0
    cells = np.clip((means - low) / (GAP * diagonal), -FAR, FAR).astype(int)
    cells -= cells.min(axis=0)
    filled = np.zeros(cells.max(axis=0) + 1, bool)
    filled[tuple(cells.T)] = True
    parts, _ = label(filled, np.ones((3, 3, 3)))
    apart = 1 - np.bincount(parts[tuple(cells.T)]).max() / len(means)
    longest = splats.scales.detach().cpu().numpy()[seen].max(axis=1)
    return float(apart), float((longest > NEEDLE * diagonal).mean())
