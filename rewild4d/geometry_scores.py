"""Scores of a reconstruction's shape: points of its Gaussians against the true surface, over the moments of a clip."""

from collections.abc import Sequence
from typing import Any

from rewild4d.contracts import Reconstruction
from rewild4d.leaderboard.records import Score
from rewild4d.metrics.geometry import SUFFIX, THRESHOLDS, Comparison, Fit, compare_sequence
from rewild4d.sampling import sample_gaussians
from rewild4d.types import Truth

QUANTITIES = ("chamfer", "chamfer_to_truth", "chamfer_to_prediction", "chamfer_relative") + tuple(
    f"fscore_{percent}" for percent in THRESHOLDS
)
NAMES = tuple(quantity + suffix for suffix in SUFFIX.values() for quantity in QUANTITIES)
"""Names of the scores: a quantity, and how predictions were laid on the truth (see `metrics.geometry`)."""


def score_geometry(
    reconstruction: Reconstruction, truth: Truth, times: Sequence[float], names: Sequence[str], points: int
) -> tuple[dict[str, Score], list[dict[str, Any]]]:
    """Compare shapes.

    Args:
        reconstruction: what is scored; `sampling.sample_gaussians` says which points stand for it.
        truth: with a surface.
        times: moments, seconds.
        names: out of `NAMES`.
        points: drawn from each cloud.

    Returns:
        The scores by name, each with its floor in the note, and the alignments that they stand on.
    """
    if not names:
        return {}, []
    if truth.sample is None:
        reason = "not computed: the data set has no geometry"
        return {name: Score(None, *_kind(name), 0, [], reason) for name in names}, []
    predictions = [sample_gaussians(reconstruction.at(time), points, seed=0) for time in times]
    truths = [truth.sample(time, points, 1) for time in times]
    seconds = [truth.sample(time, points, 2) for time in times]
    scores: dict[str, Score] = {}
    alignments: list[dict[str, Any]] = []
    for fit, suffix in SUFFIX.items():
        wanted = [name for name in names if _suffix(name) == suffix]
        if not wanted:
            continue
        found = compare_sequence(
            predictions, truths, fit=fit, diagonal=truth.diagonal, up=truth.up, seconds=seconds, points=points
        )
        scores |= {name: _score(found, name) for name in wanted}
        alignments += _describe(found, fit)
    return {name: scores[name] for name in names}, alignments


def _suffix(name: str) -> str:
    return next((suffix for suffix in SUFFIX.values() if suffix and name.endswith(suffix)), "")


def _kind(name: str) -> tuple[str, str]:
    """Unit, and which way is better."""
    if name.startswith("fscore"):
        return "1", "higher"
    return ("1" if name.startswith("chamfer_relative") else "world"), "lower"


def _score(found: Comparison, name: str) -> Score:
    item = found.scores[name]
    parts = [item.note] if item.note else []
    if item.value is not None:
        parts += [f"floor {item.floor:.4g}"] if item.floor is not None else []
        parts.append(found.note)
    present = sum(value is not None for value in item.per_frame)
    return Score(item.value, item.unit, item.better, present, list(item.per_frame), "; ".join(parts))


def _describe(found: Comparison, fit: Fit) -> list[dict[str, Any]]:
    return [
        {
            "fit": fit, "moment": index if fit == "frame" else None, "scale": one.transform.scale,
            "matrix": one.transform.matrix.tolist(), "start": one.start, "iterations": one.iterations,
            "converged": one.converged, "clamped": one.clamped,
        }
        for index, one in enumerate(found.alignments) if one is not None
    ]  # fmt: skip
