"""Score a reconstruction's shape: points of its Gaussians against the true surface, over the times of a clip."""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import msgspec
from torch import Tensor

from rewild4d.cameras.placement import IDENTITY, Placement
from rewild4d.contracts import Reconstruction
from rewild4d.evaluation.drawn_surface import RULE, sample_drawn
from rewild4d.evaluation.placing import describe
from rewild4d.io.sampling import sample_gaussians
from rewild4d.metrics.geometry import Comparison, compare_sequence
from rewild4d.metrics.names import ALIGNMENTS, DENSE, geometry_unit
from rewild4d.metrics.score import Score
from rewild4d.types import Splats, Truth


class Sampling(NamedTuple):
    """How points stand for a reconstruction.

    Attributes:
        sample: splats, most points and a seed -> points, float64, [m, 3].
        rule: what the points are.
    """

    sample: Callable[[Splats, int, int], Tensor]
    rule: str


SAMPLINGS = {"": Sampling(sample_gaussians, "centres of Gaussians"), "_drawn": Sampling(sample_drawn, RULE)}
"""End of a score's name (`metrics.names.SAMPLINGS`) -> its points."""


class Parts(NamedTuple):
    """Parts of a score's name."""

    quantity: str
    alignment: str
    sampling: str
    dense: str


def score_geometry(
    reconstruction: Reconstruction,
    truth: Truth,
    times: Sequence[float],
    names: Sequence[str],
    points: int,
    *,
    placement: Placement = IDENTITY,
    even: bool = True,
) -> tuple[dict[str, Score], list[dict[str, Any]]]:
    """Compare shapes.

    Args:
        reconstruction: to score.
        truth: with a surface.
        times: seconds.
        names: out of `metrics.names.GEOMETRY`.
        points: drawn from each cloud.
        placement: applied to the reconstruction first.
        even: see `metrics.alignment.align_sequence`.

    Returns:
        The scores by name, each with its sampling floor, and the alignments.
    """
    if not names:
        return {}, []
    if truth.sample is None:
        reason = "not computed: the data set has no geometry"
        return {name: Score(None, *geometry_unit(name), 0, [], reason) for name in names}, []
    parts = {name: _split(name) for name in names}
    scores: dict[str, Score] = {}
    alignments: list[dict[str, Any]] = []
    for sampling, dense in dict.fromkeys((one.sampling, one.dense) for one in parts.values()):
        drawn, (sample, rule) = DENSE[dense] or points, SAMPLINGS[sampling]
        predictions = [placement.apply(sample(reconstruction.at(time), drawn, 0)) for time in times]
        truths, seconds = ([truth.sample(time, drawn, seed) for time in times] for seed in (1, 2))
        for fit, end in ALIGNMENTS.items():
            wanted = [name for name, one in parts.items() if one[1:] == (end, sampling, dense)]
            if not wanted:
                continue
            found = compare_sequence(
                predictions, truths, fit=fit, diagonal=truth.diagonal, up=truth.up, seconds=seconds, points=drawn,
                even=even,
            )  # fmt: skip
            scores |= {name: _score(found, parts[name], rule) for name in wanted}
            alignments += [
                describe(one, fit, drawn, moment if fit == "frame" else None) | {"sampling": rule}
                for moment, one in enumerate(found.alignments) if one is not None
            ]  # fmt: skip
    return {name: scores[name] for name in names}, alignments


def _split(name: str) -> Parts:
    ends = []
    for known in (DENSE, SAMPLINGS, ALIGNMENTS.values()):
        end = next((end for end in known if end and name.endswith(end)), "")
        ends.append(end)
        name = name.removesuffix(end)
    dense, sampling, alignment = ends
    return Parts(name, alignment, sampling, dense)


def _score(found: Comparison, parts: Parts, rule: str) -> Score:
    score = found.scores[parts.quantity + parts.alignment]
    return score if score.value is None else msgspec.structs.replace(score, note=f"{rule}; {found.note}")
