"""Judge a result without the truth: parts that came off the body, needles, shown frames, held-out masks."""

from collections.abc import Mapping

import numpy as np
from scipy.ndimage import label

from rewild4d.contracts import Reconstruction, Verdict
from rewild4d.evaluation.shown_frames import shown_facts
from rewild4d.metrics.score import Score
from rewild4d.types import Clip, Splats

COVERED, BARELY = 0.7, 0.5
"""IoU of the render with the held-out masks: below the first look at it, below the second do not rely on it."""
GAP, SEEN = 0.02, 0.3
"""Gaussians of at least this opacity belong together whose cells of this share of the body's diagonal touch."""
FAR = 100
"""Cells from the body's corner at which a stray Gaussian counts at most."""
APART, TORN = 0.02, 0.08
"""Share of the visible Gaussians that are apart from the body: more, and it is to be looked at; limbs are torn off."""
WORSE = 0.04
"""IoU with shown masks that a result may lose against the posed template, whose mesh has sharper edges."""
INSIDE, BEYOND = 0.12, 0.06
"""Mean errors of colour in shown frames, inside masks and in a ring around them, above which they are told."""
NEEDLE, NEEDLES = 0.1, 0.005
"""A Gaussian longer than this share of the body's diagonal is a needle; share of them above which it is told."""


def result_verdict(
    reconstruction: Reconstruction, clip: Clip, scores: Mapping[str, Score], template_iou: float | None = None
) -> Verdict:
    """Judge a reconstruction by its Gaussians, by the frames that it was fitted to and by held-out masks.

    Args:
        reconstruction: of a clip.
        clip: that it was fitted to.
        scores: of the record; "iou" is asked for.
        template_iou: of the posed template that the fit started from, with the masks of the clip; None: unknown.
    """
    times = clip.times
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
    if told := _unlike_shown(reconstruction, clip, template_iou):
        return Verdict("result", "yellow", told, "look at comparison.png")
    if iou is not None and iou < COVERED:
        return Verdict("result", "yellow", f"it covers the animal in held-out images with IoU {iou:.2f} only", look)
    covers = "" if iou is None else f" and covers the animal in held-out images (IoU {iou:.2f})"
    return Verdict("result", "green", f"it hangs together{covers}")


def _unlike_shown(reconstruction: Reconstruction, clip: Clip, template_iou: float | None) -> str:
    """Say what is wrong in the frames that were fitted; "" where nothing is."""
    facts = shown_facts(reconstruction, clip)
    if facts is None:
        return ""
    if template_iou is not None and facts.iou < template_iou - WORSE:
        return (
            f"it covers the animal in shown frames less well (IoU {facts.iou:.2f}) than the posed template that it "
            f"started from ({template_iou:.2f})"
        )
    if facts.inside > INSIDE:
        return f"colours inside the masks of shown frames are off by {facts.inside:.2f} of 1 in the mean"
    if facts.beyond > BEYOND:
        return f"it spills beyond the masks of shown frames: colours around them are off by {facts.beyond:.2f} of 1"
    return ""


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
