"""A metric: how far the rendered animal stands from the true one in the image."""

import math
from collections.abc import Iterable, Iterator

from torch import Tensor, arange

from rewild4d.contracts import HeldOut, MetricInfo


class CentroidOffset:
    """Distance of the centroids of two mattes (contracts.Metric)."""

    info = MetricInfo(
        title="centroid offset",
        definition="Distance of the true from the predicted matte's centroid, mean over images that have both",
        unit="px",
        better="lower",
        needs="images",
        licence="MIT",
    )

    def measure(self, items: Iterable[HeldOut]) -> Iterator[float | None]:
        for item in items:
            found, wanted = _centroid(item.prediction_matte[0]), _centroid(item.truth_matte[0])
            yield None if found is None or wanted is None else math.dist(found, wanted)


def _centroid(matte: Tensor) -> tuple[float, float] | None:
    """Return the mean (column, row) of a matte [h, w]; None where it is empty."""
    total = matte.sum()
    if total <= 0:
        return None
    rows, columns = (arange(size) + 0.5 for size in matte.shape)
    return float((matte.sum(0) * columns).sum() / total), float((matte.sum(1) * rows).sum() / total)
