"""Describe a run in its record: data, prior, inputs, marks and diagnostics."""

import contextlib
import json
from typing import Any

import msgspec

from rewild4d.contracts import DatasetReader, Reconstruction
from rewild4d.errors import UserError
from rewild4d.evaluation.measuring import input_psnr
from rewild4d.machine import code_of
from rewild4d.priors.choose import PriorChoice
from rewild4d.priors.config import STANDARD
from rewild4d.registry import load_method
from rewild4d.types import Clip, Prior

FROM_TRUTH = "upper bound: its prior was made from the truth"


def reading(reader: DatasetReader, clip: Clip) -> dict[str, str]:
    """Return how the data was read: the reader's settings, notes of the clip, recipe of rendered data."""
    settings, recipe = getattr(reader, "settings", {}), getattr(reader, "recipe", None)
    found = {
        "settings": json.dumps(settings) if settings else "",
        "notes": "; ".join(clip.notes),
        "recipe": recipe(clip.name) if recipe else "",
    }
    return {name: text for name, text in found.items() if text}


def prior_of(prior: Prior | None) -> dict[str, Any]:
    """Describe the prior."""
    if prior is None:
        return {"name": "none"}
    found = {"name": prior.name, "provenance": prior.provenance, "digest": prior.digest, "quality": prior.quality}
    return found | ({"notes": list(prior.notes)} if prior.notes else {})


def weights(choice: PriorChoice) -> dict[str, str]:
    """Return the digest of a learned prior's weights."""
    return {"weights": found} if (found := choice.weights_digest) else {}


def left_out(clip: Clip, shown: Clip | None) -> dict[str, list[int]]:
    """Return rows of the frames that the method was not shown, because the prior does not know their cameras."""
    times = set(clip.times if shown is None else shown.times)
    rows = [row for row, time in enumerate(clip.times) if time not in times]
    return {"left_out": rows} if rows else {}


def shown_clip(clip: Clip, prior: dict[str, Any]) -> Clip:
    """Return the part of its clip that a record's method was shown; ``prior`` as in the record."""
    missing = set(prior.get("left_out", ()))
    return clip.only([row for row in range(len(clip.frames)) if row not in missing]) if missing else clip


def keypoints(choice: PriorChoice, clip: Clip) -> dict[str, str]:
    """Return which annotated keypoints the fit of the prior used, where the clip has any."""
    if choice.mapping is None or all(frame.keypoints is None for frame in clip.frames):
        return {}
    return {"keypoints": choice.use, "mapping": choice.mapping}


def diagnostics(reconstruction: Reconstruction, shown: Clip, background: float) -> dict[str, Any]:
    """Return the method's own diagnostics, and the PSNR of its input frames.

    Args:
        reconstruction: of the clip.
        shown: input of the method.
        background: of the protocol.
    """
    describe = getattr(reconstruction, "diagnostics", None)
    fits = input_psnr(reconstruction, shown, background)
    return (describe() if describe else {}) | {"input_psnr_db": fits.value}


def inputs(method: str, config: msgspec.Struct, case: str) -> dict[str, str]:
    """Return the digest of files that a method reads besides its settings, if any."""
    asked = getattr(load_method(method), "inputs", None)
    return {"inputs": asked(config, case)} if asked else {}


def code(method: str, config: msgspec.Struct) -> dict[str, str]:
    """Return the versions of the code behind a run, and what a method that runs another program says of that."""
    describe = getattr(load_method(method), "describe", None)
    found: dict[str, str] = {}
    with contextlib.suppress(UserError):  # of a file that went away; the record of that failure is written all the same
        found = describe(config) if describe else {}
    return found | code_of(method)


def marks(method: str, prior: str, reconstruction: Reconstruction) -> list[str]:
    """Return marks that are printed with the numbers in every table, and exclude a row from the ranking.

    Args:
        method: its name.
        prior: the value of `--prior`.
        reconstruction: may have marks of its own.
    """
    info = load_method(method).info
    found = [info.mark] if info.mark else []
    if info.uses_prior and PriorChoice(prior, STANDARD).is_from_truth:
        found.append(FROM_TRUTH)
    return found + list(getattr(reconstruction, "marks", ()))
