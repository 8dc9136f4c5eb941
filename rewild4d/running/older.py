"""Records from before a preset or the prior was mended stand for their row, with a note, until there are later ones."""

from collections.abc import Sequence
from typing import Any

import msgspec

from rewild4d.errors import UserError
from rewild4d.leaderboard.records import RunRecord
from rewild4d.priors.config import PriorConfig
from rewild4d.registry import load_method

LOSSES = "run before two regularizers, the times of frames and the frame filter were mended (docs/experiments/paper.md)"
MIRRORS = "run without the mirror images that the preset has since (docs/experiments/baseline-presets.md)"
PRIOR = "from priors fitted without {parts}, which take part since (docs/prior.md)"


def notes_on(run: RunRecord) -> tuple[str, ...]:
    """Return notes on what was mended since a run, none where nothing was."""
    return tuple(note for note in (older(run.config), _older_prior(run)) if note)


def _older_prior(run: RunRecord) -> str:
    """Return a note on what had no part in the prior's fit yet, "" where nothing is missing or the method uses none."""
    cameras, settings = run.protocol.get("selection", {}).get("cameras"), run.prior.get("config") or {}
    if run.prior.get("choice") != "template" or not settings or not _uses_prior(run.method):
        return ""
    if cameras in ("fixed", "unknown"):
        missing = [] if "heading_weight" in settings else ["headings"]
        if cameras == "fixed":
            missing += [] if "density_weight" in settings else ["shapes of random animals"]
            missing += [] if "straight_weight" in settings else ["a straight spine"]
    else:
        coloured = run.preset == "quick" or any("colors" in stage for stage in settings["stages"])
        missing = [] if coloured else ["colours"]
    turns = "turned_weight" if cameras == "unknown" else "least_turn"
    missing += [] if turns in settings else ["turns that a network reads"]
    return PRIOR.format(parts=" and ".join(missing)) if missing else ""


def _uses_prior(method: str) -> bool:
    try:
        return load_method(method).info.uses_prior
    except UserError:  # a plug-in that is not installed here
        return True


def older(settings: Any) -> str:
    """Return a note on what was mended since a run with these settings, "" where nothing was."""
    if not isinstance(settings, dict):
        return ""
    if "compact_power" in settings.get("geometry", {}):
        return LOSSES
    is_gart = "template" in settings and "regularisers" in settings
    return MIRRORS if is_gart and "mirrored" not in settings else ""


def renewed(settings: Any, wanted: msgspec.Struct) -> Any:
    """Return older settings as they are called now, what was mended as in ``wanted``; others unchanged.

    "w/o Part Anchors" was another ablation before the losses were mended and stays unequal.
    """
    note = older(settings)
    if note == MIRRORS:
        return settings | {"mirrored": getattr(wanted, "mirrored", 0.0)}
    if note == LOSSES:
        deform, geometry = dict(settings["deform"]), dict(settings["geometry"])
        if deform.get("anchors"):
            del deform["anchors"]
        del geometry["compact_power"]
        return settings | {"deform": deform, "geometry": geometry}
    return settings


def renewed_prior(settings: dict[str, Any], wanted: PriorConfig) -> dict[str, Any]:
    """Add the rounds on colours of ``wanted`` to settings of a prior from before there were any; others unchanged."""
    stages = settings.get("stages", [])
    if any("colors" in stage for stage in stages):
        return settings
    return settings | {"stages": [*stages, *(msgspec.to_builtins(stage) for stage in wanted.stages if stage.colors)]}


def without_older(found: Sequence[RunRecord]) -> tuple[RunRecord, ...]:
    """Leave out older runs where there are later ones."""
    later = tuple(run for run in found if not notes_on(run))
    return later or tuple(found)
