"""How far a cloud of points is from the truth: Chamfer distance and F-score, after one similarity for all moments.

Distances are Euclidean, not squared, between samples of the two surfaces. Two perfect samplings of one surface are not
at distance zero, so each result carries its floor: the same number for a second sampling of the truth.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
import torch
from torch import Tensor

from rewild4d.metrics.alignment import Alignment, Undetermined, align_sequence
from rewild4d.metrics.clouds import as_points, box_diagonal, paired, subsample
from rewild4d.metrics.distances import Chamfer, Distances, chamfer, distances, fscore
from rewild4d.metrics.names import ALIGNMENTS, THRESHOLDS, Fit

__all__ = [
    "Chamfer",
    "Comparison",
    "Distances",
    "Measured",
    "chamfer",
    "compare",
    "compare_sequence",
    "distances",
    "fscore",
]

POINTS = 30_000
"""Points of a cloud that a comparison looks at; more are drawn by the seed."""


@dataclass(frozen=True)
class Measured:
    """One quantity of a comparison.

    Attributes:
        value: mean over the moments; None where any of them has none, ``note`` then says why.
        unit: "1" for a ratio, "world" for the clouds' own unit of length.
        better: "higher" or "lower".
        per_frame: the value at each moment, None where there is none.
        floor: the same quantity for a second sampling of the truth in the prediction's place, which is what a perfect
            shape gets; ``Comparison.note`` says of how many points. None where there is no second sampling.
        note: why there is no value, or "".
    """

    value: float | None
    unit: str
    better: str
    per_frame: tuple[float | None, ...]
    floor: float | None
    note: str


@dataclass(frozen=True)
class Comparison:
    """A prediction against the truth.

    Attributes:
        scores: by name, in the order of printing.
        alignments: what was applied to the predictions: one for all moments, or one a moment (None where the points do
            not determine it), or none.
        diagonal: length that 100 % stands for, in the clouds' unit.
        note: how many points were compared, and what the floor is.
    """

    scores: dict[str, Measured]
    alignments: tuple[Alignment | None, ...]
    diagonal: float
    note: str


def compare(
    prediction: Tensor,
    truth: Tensor,
    *,
    fit: Literal["sequence", "none"] = "sequence",
    diagonal: float | None = None,
    up: Tensor | None = None,
    second: Tensor | None = None,
    points: int = POINTS,
    seed: int = 0,
) -> Comparison:
    """Score one cloud: `compare_sequence` of one moment, with the same keywords.

    Args:
        prediction: finite, may be empty, [n, 3].
        truth: finite, at least one point, [m, 3].
        second: another sampling of the truth, for the floor, [k, 3].
    """
    seconds = None if second is None else [second]
    return compare_sequence(
        [prediction], [truth], fit=fit, diagonal=diagonal, up=up, seconds=seconds, points=points, seed=seed
    )


def compare_sequence(
    predictions: Sequence[Tensor],
    truths: Sequence[Tensor],
    *,
    fit: Fit = "sequence",
    diagonal: float | None = None,
    up: Tensor | None = None,
    seconds: Sequence[Tensor] | None = None,
    points: int = POINTS,
    seed: int = 0,
) -> Comparison:
    """Chamfer distance and F-score of a sequence, each the mean over all its moments.

    A moment without points has an F-score of 0 and no Chamfer distance, and then the sequence has none either: a mean
    over the others would favour a method that leaves out its worst moments.

    Scores: "chamfer" (mean of the directions) with "chamfer_to_truth" and "chamfer_to_prediction", in the clouds' unit;
    "chamfer_relative", over the diagonal; "fscore_1", "fscore_2", "fscore_5" at so many percent of the diagonal. Each
    name ends in `names.ALIGNMENTS` of the fit. The relative ones do not depend on the unit.

    Args:
        predictions: one cloud a moment, each finite, may be empty, [n, 3].
        truths: the same moments, each finite, at least one point, [m, 3].
        fit: "sequence" lays all predictions on the truths by one similarity; "frame" by one a moment, which hides
            global motion, drift and flicker of scale; "none" compares them as they stand.
        diagonal: of the truth's bounding box in its rest pose; of the first truth where None.
        up: direction that the two frames share, for the alignment's starts (see `align_sequence`), [3].
        seconds: an independent sampling of each truth for the floor, at least as large as the prediction. Where it is
            None, two disjoint draws from each truth stand in; from a truth of fewer than twice ``points`` these are
            halves, and their floor is worse than one of all points, [k, 3].
        points: a larger cloud is compared by so many of its points.
        seed: of all draws.

    Raises:
        ValueError: unequal lengths, another shape, a NaN or an infinite value, an empty truth.
    """
    paired(predictions, truths)
    if seconds is not None:
        paired(seconds, truths)
    for prediction, truth in zip(predictions, truths, strict=True):
        as_points(prediction, "prediction", empty=True)
        as_points(truth, "truth")
    if diagonal is not None and not 0 <= diagonal < math.inf:
        raise ValueError(f"expected a finite diagonal that is not negative, got {diagonal}")
    length = box_diagonal(as_points(truths[0], "truth")) if diagonal is None else diagonal
    given = [subsample(cloud, points, seed) for cloud in predictions]
    targets = [subsample(cloud, points, seed + 1) for cloud in truths]
    moved, alignments, reason = _aligned(given, targets, fit, up, seed)
    frames = [None if cloud is None else distances(cloud, truth) for cloud, truth in zip(moved, targets, strict=True)]
    floors, floor_note = _floors(truths, seconds, targets, given, points, seed)
    scores = {
        name + ALIGNMENTS[fit]: _measured(quantity, unit, better, frames, floors, reason)
        for name, (quantity, unit, better) in _quantities(length).items()
    }
    return Comparison(scores, alignments, length, f"{_counts(predictions, truths, points, seed)}; {floor_note}")


def _aligned(
    predictions: list[Tensor], truths: list[Tensor], fit: Fit, up: Tensor | None, seed: int
) -> tuple[list[Tensor | None], tuple[Alignment | None, ...], str]:
    """The predictions where they are compared, None where no similarity is determined, and why it is not."""
    if fit == "none":
        return list(predictions), (), ""
    groups = [range(len(truths))] if fit == "sequence" else [range(t, t + 1) for t in range(len(truths))]
    moved: list[Tensor | None] = []
    alignments: list[Alignment | None] = []
    reason = ""
    for group in groups:
        clouds = [predictions[t].double() for t in group]
        try:
            found = align_sequence(clouds, [truths[t] for t in group], up=up, seed=seed)
        except Undetermined as error:
            reason = str(error).replace("source", "prediction").replace("target", "truth")
            moved += [cloud if not len(cloud) else None for cloud in clouds]
            alignments.append(None)
        else:
            moved += [found.transform.apply(cloud) for cloud in clouds]
            alignments.append(found)
    return moved, tuple(alignments), reason


Quantity = Callable[[Distances], float | None]


def _quantities(diagonal: float) -> dict[str, tuple[Quantity, str, str]]:
    """Name -> how it follows from the distances, its unit, and which way is better."""

    def relative(found: Distances) -> float | None:
        return found.chamfer.symmetric / diagonal if diagonal > 0 else None

    def score(percent: int) -> Quantity:
        return lambda found: found.fscore(percent / 100 * diagonal) if diagonal > 0 else None

    table: dict[str, tuple[Quantity, str, str]] = {
        "chamfer": (lambda found: found.chamfer.symmetric, "world", "lower"),
        "chamfer_to_truth": (lambda found: found.chamfer.to_truth, "world", "lower"),
        "chamfer_to_prediction": (lambda found: found.chamfer.to_prediction, "world", "lower"),
        "chamfer_relative": (relative, "1", "lower"),
    }
    return table | {f"fscore_{percent}": (score(percent), "1", "higher") for percent in THRESHOLDS}


def _measured(
    quantity: Quantity,
    unit: str,
    better: str,
    frames: Sequence[Distances | None],
    floors: Sequence[Distances],
    reason: str,
) -> Measured:
    def finite(found: Distances | None) -> float | None:
        value = None if found is None else quantity(found)
        return value if value is not None and math.isfinite(value) else None

    items = tuple(finite(found) for found in frames)
    below = [item for item in map(finite, floors) if item is not None]
    floor = math.fsum(below) / len(below) if below else None
    missing = [found for item, found in zip(items, frames, strict=True) if item is None]
    if missing:
        if all(found is not None and not len(found.to_truth) for found in missing):
            reason = "the prediction has no points"
        where = f" at {len(missing)} of {len(items)} moments" if len(missing) < len(items) else ""
        reason = reason or "the truth's diagonal is zero"
        return Measured(None, unit, better, items, floor, f"not computed: {reason}{where}")
    return Measured(math.fsum(filter(None, items)) / len(items), unit, better, items, floor, "")


def _floors(
    truths: Sequence[Tensor],
    seconds: Sequence[Tensor] | None,
    targets: Sequence[Tensor],
    given: Sequence[Tensor],
    points: int,
    seed: int,
) -> tuple[list[Distances], str]:
    """Distances of a second sampling from the truth at each moment, and one sentence on how it was made."""
    if seconds is not None:
        drawn = [subsample(cloud, len(other) or points, seed + 2) for cloud, other in zip(seconds, given, strict=True)]
        note = f"floor: an independent sampling of the truth with {_span(drawn)} points against the same truth"
        return [distances(*pair) for pair in zip(drawn, targets, strict=True)], note
    halves = []
    for truth in truths:
        count = min(len(truth) // 2, points)
        order = torch.from_numpy(np.random.default_rng(seed + 2).permutation(len(truth))).to(truth.device)
        if count:
            halves.append((truth[order[:count]], truth[order[count : 2 * count]]))
    if not halves:
        return [], "floor: not computed, the truth has one point"
    note = f"floor: two disjoint samples of the truth with {_span([half for half, _ in halves])} points each"
    return [distances(*pair) for pair in halves], note


def _counts(predictions: Sequence[Tensor], truths: Sequence[Tensor], points: int, seed: int) -> str:
    """Which points were compared, in words."""
    words = []
    for clouds, name in ((predictions, "prediction"), (truths, "truth")):
        drawn = f", {points} of them drawn with seed {seed}" if max(map(len, clouds)) > points else ""
        words.append(f"{name} of {_span(clouds)} points{drawn}")
    return "; ".join(words)


def _span(clouds: Sequence[Tensor]) -> str:
    low, high = min(map(len, clouds)), max(map(len, clouds))
    return f"{low}" if low == high else f"{low} to {high}"
