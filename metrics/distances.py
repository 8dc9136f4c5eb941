"""Nearest-neighbour distances between two clouds as they stand: Chamfer distance and F-score."""

import math
from dataclasses import dataclass

import numpy as np
from torch import Tensor

from rewild4d.metrics.clouds import Cloud, Points, as_points


@dataclass(frozen=True)
class Distances:
    """Nearest-neighbour distances between two clouds, computed once.

    Attributes:
        to_truth: from each point of the prediction, float64, [n].
        to_prediction: from each point of the truth; infinite where the prediction has no points, float64, [m].
    """

    to_truth: Points
    to_prediction: Points

    @property
    def chamfer(self) -> "Chamfer":
        """Means of the two directions; `to_truth` is NaN where the prediction has no points."""
        forward = float(self.to_truth.mean()) if len(self.to_truth) else math.nan
        return Chamfer(forward, float(self.to_prediction.mean()))

    def fscore(self, threshold: float) -> float:
        """See `fscore`."""
        precision = float((self.to_truth < threshold).mean()) if len(self.to_truth) else 0.0
        recall = float((self.to_prediction < threshold).mean())
        return 2 * precision * recall / (precision + recall) if precision + recall > 0 else 0.0


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


def distances(prediction: Tensor, truth: Tensor) -> Distances:
    """Nearest-neighbour distances in both directions, exact.

    Args:
        prediction: finite, may be empty, [n, 3].
        truth: finite, at least one point, [m, 3].

    Raises:
        ValueError: another shape, a NaN or an infinite value, an empty truth.
    """
    source, target = as_points(prediction, "prediction", empty=True), as_points(truth, "truth")
    if not len(source):
        return Distances(np.empty(0), np.full(len(target), np.inf))
    return Distances(Cloud(target).nearest(source)[0], Cloud(source).nearest(target)[0])


def chamfer(prediction: Tensor, truth: Tensor) -> Chamfer:
    """Chamfer distance: mean_p min_g |p - g| and mean_g min_p |p - g|, not squared.

    Conventions differ between papers by the square and by a factor of two; here both directions are kept, and
    `Chamfer.symmetric` is their mean.

    Args:
        prediction: finite, at least one point, [n, 3].
        truth: finite, at least one point, [m, 3].

    Raises:
        ValueError: another shape, a NaN or an infinite value, an empty cloud.
    """
    as_points(prediction, "prediction")
    return distances(prediction, truth).chamfer


def fscore(prediction: Tensor, truth: Tensor, threshold: float) -> float:
    """F-score (Knapitsch et al. 2017): harmonic mean of precision and recall at a distance.

    Precision is the share of the prediction's points nearer to the truth than the threshold, recall the share of the
    truth's points nearer to the prediction. Zero where both are zero, and for a prediction without points.

    Args:
        prediction: finite, [n, 3].
        truth: finite, at least one point, [m, 3].
        threshold: in the clouds' unit.

    Returns:
        In [0, 1].

    Raises:
        ValueError: another shape, a NaN or an infinite value, an empty truth.
    """
    return distances(prediction, truth).fscore(threshold)
