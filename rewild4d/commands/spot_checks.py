"""Score again what a bundle predicts: some of its runs, on the data that are here."""

from __future__ import annotations

import math
import random
import shutil
import tempfile
from pathlib import Path

import msgspec

from rewild4d.commands.verifying import Bundle, counted
from rewild4d.errors import UserError, reason
from rewild4d.evaluation.protocol import find_protocol, load_protocols
from rewild4d.leaderboard.predictions import FOLDER
from rewild4d.leaderboard.records import RunRecord, write_record
from rewild4d.leaderboard.variants import comparable
from rewild4d.metrics.score import Score
from rewild4d.registry import names
from rewild4d.running.provenance import reading
from rewild4d.running.rescoring import reader_of, score_again

DECIBELS, PART, LEAST = 0.01, 1e-3, 1e-4
"""A score may come out this far from its record: dB; of other units this part of the value, and at least so much."""
TOLERANCE = f"{DECIBELS:g} dB, {100 * PART:g} % of other scores (at least {LEAST:g})"


def runs_here(bundle: Bundle, data: Path, dataset: str) -> tuple[list[str], dict[str, list[str]]]:
    """List the runs whose data can be read here, and all cases that the data have under each of their protocols.

    Runs whose data were read with files of their own, as other masks, need these here too; without them they are noted.

    Raises:
        UserError: the folder cannot be read as that data set.
    """
    cases: dict[tuple[str, str], list[str] | None] = {}
    runs = _runs(bundle, dataset)
    keys = {run: (record.protocol["name"], record.data.get("settings", "{}")) for run, record in runs.items()}
    for run, key in keys.items():
        if key in cases:
            continue
        try:
            selection = find_protocol(dataset, key[0]).selection
            cases[key] = list(reader_of(bundle.folder / run, runs[run], data).cases(selection))
        except UserError as error:
            if key[1] == "{}":
                raise
            cases[key] = None
            bundle.unverified.append(f"runs whose data were read with {key[1]}: {str(error).rstrip('.')}")
    known: dict[str, list[str]] = {}
    for (name, _), listed in cases.items():
        if listed is not None:
            known[name] = sorted({*known.get(name, ()), *listed})
    return [run for run, key in keys.items() if cases[key] is not None], known


def score_some(bundle: Bundle, runs: list[str], data: Path, sample: int, device: str, rasterizer: str) -> None:
    """Hold some runs against the data that are here, and score their predictions again; the bundle takes what is found.

    Args:
        bundle: as it was unpacked.
        runs: whose data can be read here.
        data: folder of the data.
        sample: how many runs, picked by chance; 0 for all.
        device: auto, cpu or cuda.
        rasterizer: one of `rewild4d.rasterizer.BACKENDS`.
    """
    good = {run: bundle.records[run] for run in runs if bundle.records[run].status == "ok"}
    saved = [run for run in good if bundle.predictions(run)]
    candidates = sorted(saved or good)
    # By chance, not by the bundle's digest: who makes a bundle must not know which runs will be looked at.
    some = 0 < sample < len(candidates)
    chosen = sorted(random.SystemRandom().sample(candidates, sample)) if some else candidates
    for run in chosen:
        if saved:
            _score_one(bundle, run, data, device, rasterizer)
        else:
            with bundle.looking(f"{run}: clip and truth are the data here"):
                _on_data_here(bundle.folder / run, run, good[run], data)
    if left := len(bundle.records) - len(bundle.rescored):
        why = "no predictions inside, failed, or not in the sample"
        bundle.unverified.append(f"scores of {counted(left, 'run')}: {why}")


def _runs(bundle: Bundle, dataset: str) -> dict[str, RunRecord]:
    """Return the runs on a data set whose method and protocol are known here."""
    known, methods = load_protocols(), names("methods")
    return {
        run: record
        for run, record in bundle.records.items()
        if record.dataset == dataset and record.method in methods and record.protocol["name"] in known
    }


def _score_one(bundle: Bundle, run: str, data: Path, device: str, rasterizer: str) -> None:
    """Score a run's predictions in a copy of its folder, and compare."""
    record = bundle.records[run]
    with bundle.looking() as found, tempfile.TemporaryDirectory() as scratch:
        copy = Path(scratch) / "run"
        shutil.copytree(bundle.folder / run / FOLDER, copy / FOLDER)
        try:
            write_record(_on_data_here(bundle.folder / run, run, record, data), copy)
            again = score_again(copy, data, device, rasterizer)
        except UserError as error:
            raise UserError(f"{run}: {str(error).replace(f'{copy}', run)}") from error
        except (LookupError, TypeError, ValueError, AttributeError, RuntimeError, ArithmeticError) as error:
            raise UserError(f"{run}: its predictions cannot be scored: {reason(error)}.") from error
        values = {
            name: (score.value, again.scores[name].value if name in again.scores else None)
            for name, score in record.scores.items()
        }
        one_sided = [name for name, pair in values.items() if pair.count(None) == 1]
        found += [f"{run}: {fault}" for fault in differences(record, again)]
        bundle.rescored.append(run)
    if not found:
        equal = sum(None not in pair for pair in values.values())
        bundle.verified.append(f"{run}: {equal} scores came out again, within {TOLERANCE}")
        if one_sided:
            bundle.unverified.append(f"{run}: {', '.join(one_sided)}: computed only there or only here")


def _on_data_here(folder: Path, run: str, record: RunRecord, data: Path) -> RunRecord:
    """Return the record as of the data that are here.

    Raises:
        UserError: they are other data; those rendered from one recipe are equal but for the rounding of processors.
    """
    reader = reader_of(folder, record, data)
    clip, truth = reader.load(record.case, find_protocol(record.dataset, record.protocol["name"]).selection)
    digests = {"clip": clip.digest, "truth": truth.digest}
    here = msgspec.structs.replace(record, data={"root": str(data), **digests, **reading(reader, clip)})
    if not comparable(record, here):
        raise UserError(f"{run}: the data in {data} are others than those that it was scored on.")
    return msgspec.structs.replace(record, data={**record.data, **digests})


def differences(record: RunRecord, again: RunRecord) -> list[str]:
    """Say which scores and marks of a record did not come out again, a sentence each."""
    said = []
    for name, score in record.scores.items():
        new = again.scores[name].value if name in again.scores else None  # a metric whose package is not here
        if score.value is not None and new is not None and not abs(new - score.value) <= _allowed(score):
            said.append(
                f"{name}: its record says {score.value:.6g}, but its predictions score {new:.6g}; expected at most "
                f"{_allowed(score):.2g} between them."
            )
    said += [f"expected the mark '{mark}', got none." for mark in again.marks if mark not in record.marks]
    return said


def _allowed(score: Score) -> float:
    value = score.value if score.value is not None else math.nan
    return DECIBELS if score.unit == "dB" else max(LEAST, PART * abs(value))
