"""Score a reconstruction's shape: points of its Gaussians against the true surface, over the times of a clip."""

from collections.abc import Sequence
from typing import Any

import msgspec

from rewild4d.cameras.placement import IDENTITY, Placement
from rewild4d.contracts import Reconstruction
from rewild4d.evaluation.placing import describe
from rewild4d.io.sampling import sample_gaussians
from rewild4d.metrics.geometry import Comparison, compare_sequence
from rewild4d.metrics.names import ALIGNMENTS, DENSE, geometry_unit
from rewild4d.metrics.score import Score
from rewild4d.types import Truth


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
        reconstruction: to score; its points are `io.sampling.sample_gaussians`.
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
    scores: dict[str, Score] = {}
    alignments: list[dict[str, Any]] = []
    for dense, count in DENSE.items():
        asked = [name for name in names if _parts(name)[1] == dense]
        if not asked:
            continue
        drawn = count or points
        predictions = [placement.apply(sample_gaussians(reconstruction.at(time), drawn, seed=0)) for time in times]
        truths, seconds = ([truth.sample(time, drawn, seed) for time in times] for seed in (1, 2))
        for fit, suffix in ALIGNMENTS.items():
            wanted = [name for name in asked if _parts(name)[0] == suffix]
            if not wanted:
                continue
            found = compare_sequence(
                predictions, truths, fit=fit, diagonal=truth.diagonal, up=truth.up, seconds=seconds, points=drawn,
                even=even,
            )  # fmt: skip
            scores |= {name: _score(found, name) for name in wanted}
            alignments += [
                describe(one, fit, drawn, moment if fit == "frame" else None)
                for moment, one in enumerate(found.alignments) if one is not None
            ]  # fmt: skip
    return {name: scores[name] for name in names}, alignments


def _parts(name: str) -> tuple[str, str]:
    """Split off the ends of a name: alignment and number of points."""
    dense = next((end for end in DENSE if end and name.endswith(end)), "")
    short = name.removesuffix(dense)
    return next((suffix for suffix in ALIGNMENTS.values() if suffix and short.endswith(suffix)), ""), dense


def _score(found: Comparison, name: str) -> Score:
    score = found.scores[name.removesuffix(_parts(name)[1])]
    return score if score.value is None else msgspec.structs.replace(score, note=found.note)
