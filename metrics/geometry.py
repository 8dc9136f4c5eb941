"""Compare point clouds: Chamfer distance and F-score, after one similarity for all times.

Distances are Euclidean, not squared, between samples of the two surfaces. Two samplings of one surface are not at
distance zero, so every score carries its sampling floor: the same score of a second sampling of the truth.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from rewild4d.metrics.alignment import Alignment, Undetermined, align_sequence
from rewild4d.metrics.clouds import Cloud, Points, as_points, box_diagonal, check_paired, subsample
from rewild4d.metrics.names import ALIGNMENTS, QUANTITIES, THRESHOLDS, Fit, geometry_unit
from rewild4d.metrics.score import Score

POINTS = 30_000
"""Points of a cloud that are compared; of a larger one so many are drawn by the seed."""


@dataclass(frozen=True)
class Chamfer:
    """Mean nearest-neighbour distances in the clouds' unit, not squared.

    Attributes:
        to_truth: from the prediction to the truth (accuracy).
        to_prediction: from the truth to the prediction (completeness).
    """

    to_truth: float
    to_prediction: float

    @property
    def symmetric(self) -> float:
        """Mean (not sum) of the two directions."""
        return (self.to_truth + self.to_prediction) / 2


@dataclass(frozen=True)
class Distances:
    """Nearest-neighbour distances between two clouds.

    Attributes:
        to_truth: from each point of the prediction, float64, [n].
        to_prediction: from each point of the truth; infinite where the prediction is empty, float64, [m].
    """

    to_truth: Points
    to_prediction: Points

    @property
    def chamfer(self) -> Chamfer:
        """Means of the two directions; `to_truth` is NaN where the prediction is empty."""
        forward = float(self.to_truth.mean()) if len(self.to_truth) else math.nan
        return Chamfer(forward, float(self.to_prediction.mean()))

    def fscore(self, threshold: float) -> float:
        """See `fscore`."""
        precision = float((self.to_truth < threshold).mean()) if len(self.to_truth) else 0.0
        recall = float((self.to_prediction < threshold).mean())
        return 2 * precision * recall / (precision + recall) if precision + recall > 0 else 0.0


def distances(prediction: Tensor, truth: Tensor) -> Distances:
    """Compute exact nearest-neighbour distances in both directions.

    Args:
        prediction: finite, may be empty, [n, 3].
        truth: finite, at least one point, [m, 3].

    Raises:
        ValueError: another shape, a NaN or an infinite value, an empty truth.

    Examples:
        >>> found = distances(torch.tensor([[0.0, 0, 0], [3, 0, 0]]), torch.tensor([[0.0, 0, 0], [1, 0, 0]]))
        >>> found.to_truth.tolist(), found.to_prediction.tolist()
        ([0.0, 2.0], [0.0, 1.0])
    """
    source, target = as_points(prediction, "prediction", empty=True), as_points(truth, "truth")
    if not len(source):
        return Distances(np.empty(0), np.full(len(target), np.inf))
    return Distances(Cloud(target).nearest(source)[0], Cloud(source).nearest(target)[0])


def chamfer(prediction: Tensor, truth: Tensor) -> Chamfer:
    """Compute the Chamfer distance: mean_p min_g |p - g| and mean_g min_p |p - g|, not squared.

    Papers differ by the square and by a factor of two; `Chamfer.symmetric` is the mean of the two directions. Arguments
    and errors are those of `distances`, but the prediction may not be empty.

    Examples:
        >>> found = chamfer(torch.tensor([[0.0, 0, 0], [3, 0, 0]]), torch.tensor([[0.0, 0, 0], [1, 0, 0]]))
        >>> found, found.symmetric
        (Chamfer(to_truth=1.0, to_prediction=0.5), 0.75)
    """
    as_points(prediction, "prediction")
    return distances(prediction, truth).chamfer


def fscore(prediction: Tensor, truth: Tensor, threshold: float) -> float:
    """Compute the F-score (Knapitsch et al. 2017): harmonic mean of precision and recall at a distance, in [0, 1].

    Precision is the share of the prediction's points nearer to the truth than the threshold, recall the share of the
    truth's points nearer to the prediction. Zero where both are zero, and for an empty prediction. The threshold is in
    the clouds' unit; other arguments and errors are those of `distances`.

    Examples:
        >>> fscore(torch.tensor([[0.0, 0, 0], [3, 0, 0]]), torch.tensor([[0.0, 0, 0], [1, 0, 0]]), threshold=0.5)
        0.5
    """
    return distances(prediction, truth).fscore(threshold)


@dataclass(frozen=True)
class Comparison:
    """A prediction against the truth.

    Attributes:
        scores: by name; each score's ``per_item`` is its value at each time, its ``floor`` the same quantity for a
            second sampling of the truth.
        alignments: applied to the predictions: one for all times, or one a time (None where the points do not
            determine it), or none.
        diagonal: length that 100 % stands for, in the clouds' unit.
        note: how many points were compared, and how the floor was made.
    """

    scores: dict[str, Score]
    alignments: tuple[Alignment | None, ...]
    diagonal: float
    note: str


def compare(prediction: Tensor, truth: Tensor, *, second: Tensor | None = None, **settings: Any) -> Comparison:
    """Score one cloud: `compare_sequence` of one time.

    Args:
        prediction: finite, may be empty, [n, 3].
        truth: finite, at least one point, [m, 3].
        second: another sampling of the truth, for the floor, [k, 3].
        settings: further keywords of `compare_sequence`.

    Examples:
        >>> cube = torch.cartesian_prod(*[torch.tensor([0.0, 1.0])] * 3)
        >>> shifted = cube + torch.tensor([0.25, 0.0, 0.0])
        >>> compare(shifted, cube, fit="none").scores["chamfer_unaligned"].value
        0.25
        >>> round(compare(shifted, cube).scores["chamfer"].value, 4)
        0.0
    """
    return compare_sequence([prediction], [truth], seconds=None if second is None else [second], **settings)


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
    even: bool = True,
) -> Comparison:
    """Compute Chamfer distance and F-score of a sequence, each the mean over all its times.

    At a time without predicted points the F-score is 0. The Chamfer distance is undefined there, and so is the
    sequence's: a mean over the other times would favour a method that leaves out its worst.

    Scores: "chamfer" (mean of the directions), "chamfer_to_truth" and "chamfer_to_prediction", in the clouds' unit;
    "chamfer_relative", over the diagonal; "fscore_1", "fscore_2", "fscore_5" at so many percent of the diagonal. Each
    name ends in `names.ALIGNMENTS` of the fit. The relative ones do not depend on the unit.

    Args:
        predictions: one cloud a time, each finite, may be empty, [n, 3].
        truths: the same times, each finite, at least one point, [m, 3].
        fit: "sequence" aligns all predictions by one similarity; "frame" by one a time, which hides global motion,
            drift and flicker of scale; "none" does not align.
        diagonal: of the truth's bounding box in its rest pose; of the first truth where None.
        up: direction that the two frames share, for the alignment's starts (see `align_sequence`), [3].
        seconds: an independent sampling of each truth for the floor, at least as large as the prediction, [k, 3].
            Where None, the floor compares two disjoint draws from each truth; of a truth with fewer than twice
            ``points`` these are halves, and their floor is worse than one of all points.
        points: a larger cloud is compared by so many of its points.
        seed: of all draws.
        even: see `align_sequence`; scores themselves are means over the points as they are.

    Raises:
        ValueError: unequal lengths, another shape, a NaN or an infinite value, an empty truth.

    Examples:
        >>> cube = torch.cartesian_prod(*[torch.tensor([0.0, 1.0])] * 3)
        >>> found = compare_sequence([cube, cube + 0.25], [cube, cube], fit="none")
        >>> [round(value, 3) for value in found.scores["chamfer_unaligned"].per_item]
        [0.0, 0.433]
    """
    check_paired(predictions, truths)
    if seconds is not None:
        check_paired(seconds, truths)
    for prediction, truth in zip(predictions, truths, strict=True):
        as_points(prediction, "prediction", empty=True)
        as_points(truth, "truth")
    if diagonal is not None and not 0 <= diagonal < math.inf:
        raise ValueError(f"expected a finite diagonal that is not negative, got {diagonal}")
    length = box_diagonal(as_points(truths[0], "truth")) if diagonal is None else diagonal
    given = [subsample(cloud, points, seed) for cloud in predictions]
    targets = [subsample(cloud, points, seed + 1) for cloud in truths]
    moved, alignments, reason = _aligned(given, targets, fit, up, seed, even)
    frames = [
        {} if cloud is None else _values(distances(cloud, truth), length)
        for cloud, truth in zip(moved, targets, strict=True)
    ]
    empty = [cloud is not None and not len(cloud) for cloud in moved]
    pairs, floor_note = _floor_pairs(truths, seconds, targets, given, points, seed)
    floors = [_values(distances(*pair), length) for pair in pairs]
    scores = {name + ALIGNMENTS[fit]: _score(name, frames, floors, empty, reason) for name in QUANTITIES}
    return Comparison(scores, alignments, length, f"{_counts(predictions, truths, points, seed)}; {floor_note}")


def _aligned(
    predictions: list[Tensor], truths: list[Tensor], fit: Fit, up: Tensor | None, seed: int, even: bool
) -> tuple[list[Tensor | None], tuple[Alignment | None, ...], str]:
    """Align the predictions; None where no similarity is determined, and the reason."""
    if fit == "none":
        return list(predictions), (), ""
    groups = [range(len(truths))] if fit == "sequence" else [range(t, t + 1) for t in range(len(truths))]
    moved: list[Tensor | None] = []
    alignments: list[Alignment | None] = []
    reason = ""
    for group in groups:
        clouds = [predictions[t].double() for t in group]
        try:
            found = align_sequence(clouds, [truths[t] for t in group], up=up, seed=seed, even=even)
        except Undetermined as error:
            reason = str(error).replace("source", "prediction").replace("target", "truth")
            moved += [cloud if not len(cloud) else None for cloud in clouds]
            alignments.append(None)
        else:
            moved += [found.apply(cloud) for cloud in clouds]
            alignments.append(found)
    return moved, tuple(alignments), reason


def _values(found: Distances, diagonal: float) -> dict[str, float]:
    """Compute every quantity that is defined at one time."""
    mean = found.chamfer
    values = {
        "chamfer": mean.symmetric,
        "chamfer_to_truth": mean.to_truth,
        "chamfer_to_prediction": mean.to_prediction,
    }
    if diagonal > 0:
        values["chamfer_relative"] = mean.symmetric / diagonal
        values |= {f"fscore_{percent}": found.fscore(percent / 100 * diagonal) for percent in THRESHOLDS}
    return {name: value for name, value in values.items() if math.isfinite(value)}


def _score(
    name: str, frames: Sequence[dict[str, float]], floors: Sequence[dict[str, float]], empty: list[bool], reason: str
) -> Score:
    """Average a quantity over the times, or say why it has no value."""
    items = [values.get(name) for values in frames]
    present = [item for item in items if item is not None]
    below = [values[name] for values in floors if name in values]
    floor = math.fsum(below) / len(below) if below else None
    unit, better = geometry_unit(name)
    if len(present) == len(items):
        return Score(math.fsum(present) / len(items), unit, better, len(items), items, "", floor)
    if all(none for item, none in zip(items, empty, strict=True) if item is None):
        reason = "the prediction has no points"
    where = f" at {len(items) - len(present)} of {len(items)} moments" if present else ""
    reason = reason or "the truth's diagonal is zero"
    return Score(None, unit, better, len(present), items, f"not computed: {reason}{where}", floor)


def _floor_pairs(
    truths: Sequence[Tensor],
    seconds: Sequence[Tensor] | None,
    targets: Sequence[Tensor],
    given: Sequence[Tensor],
    points: int,
    seed: int,
) -> tuple[list[tuple[Tensor, Tensor]], str]:
    """Pair a second sampling with the truth at each time, and say in one sentence how it was made."""
    if seconds is not None:
        drawn = [subsample(cloud, len(other) or points, seed + 2) for cloud, other in zip(seconds, given, strict=True)]
        note = f"floor: an independent sampling of the truth with {_span(drawn)} points against the same truth"
        return list(zip(drawn, targets, strict=True)), note
    halves = []
    for truth in truths:
        count = min(len(truth) // 2, points)
        order = torch.from_numpy(np.random.default_rng(seed + 2).permutation(len(truth))).to(truth.device)
        if count:
            halves.append((truth[order[:count]], truth[order[count : 2 * count]]))
    if not halves:
        return [], "floor: not computed, the truth has one point"
    return halves, f"floor: two disjoint samples of the truth with {_span([half for half, _ in halves])} points each"


def _counts(predictions: Sequence[Tensor], truths: Sequence[Tensor], points: int, seed: int) -> str:
    """Say which points were compared."""
    words = []
    for clouds, name in ((predictions, "prediction"), (truths, "truth")):
        drawn = f", {points} of them drawn with seed {seed}" if max(map(len, clouds)) > points else ""
        words.append(f"{name} of {_span(clouds)} points{drawn}")
    return "; ".join(words)


def _span(clouds: Sequence[Tensor]) -> str:
    low, high = min(map(len, clouds)), max(map(len, clouds))
    return f"{low}" if low == high else f"{low} to {high}"
