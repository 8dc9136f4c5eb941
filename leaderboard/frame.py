"""Run records as pandas data frames: a row for each run and metric, or for each image of each run and metric."""

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rewild4d.errors import UserError
from rewild4d.leaderboard.curves import times_of
from rewild4d.leaderboard.records import RunRecord, find_records
from rewild4d.leaderboard.titles import better_of, known_scores
from rewild4d.leaderboard.variants import by_protocol, latest, row_kind, variants
from rewild4d.metrics.score import Score

if TYPE_CHECKING:
    import pandas as pd

RUN = ("protocol", "dataset", "case", "method", "preset", "variant", "prior", "kind", "seed", "run_id", "latest")
RECORDS = (
    *RUN, "status", "metric", "value", "unit", "better", "count", "floor", "note", "marks", "started", "fit_seconds",
    "evaluate_seconds", "peak_memory_mib", "processor", "code", "folder", "package",
)  # fmt: skip
ITEMS = (*RUN, "metric", "item", "label", "time", "value", "unit", "better")
Found = Sequence[tuple[Path, RunRecord]]


def records_frame(folder: Path) -> "pd.DataFrame":
    """Read all run records below a folder into one long frame: a row for each run and metric.

    Every run has a row for each metric of its protocol, then for the further ones it has. A run that failed has them
    too: status "failed", value missing, the error in ``note``. For what tables show, average ``value`` of the rows
    where ``latest`` holds, first over seeds, then over cases::

        frame = records_frame(Path("runs")).query("latest and metric == 'psnr'")
        frame.groupby(["protocol", "variant", "case"]).value.mean().groupby(["protocol", "variant"]).mean()

    Args:
        folder: of runs (what `run --out` named) or collected records, at any depth.

    Returns:
        Columns, text where no dtype is named:

        - protocol, dataset, case, method, preset: names.
        - variant: the method as tables label it: with the settings and the prior that tell it from its other runs.
        - prior: what the run asked for ("template", "learned:weights.safetensors", "coarse:1", "rig", a file).
        - kind: "method", "floor" (a lower bound) or "unranked" (it had what the others had not; ``marks`` says what).
        - seed (int64), run_id.
        - latest (bool): whether tables count the run: of equal runs the newest, on the newest data.
        - status: "ok" or "failed".
        - metric: name of the score ("psnr", "lpips_alex", "chamfer_relative", ...).
        - value (float64): mean over ``count`` items; missing where there is none, ``note`` says why.
        - unit: "dB", "1" for a ratio; "" where no run here has that score.
        - better: "higher" or "lower".
        - count (int64): items that the mean is over; 0 where there is no value.
        - floor (float64): what a perfect result would get; missing where nobody knows.
        - note: why there is no value, or what was left out of the mean.
        - marks: sentences beside the numbers, such as "upper bound: ...", joined by "; ".
        - started (datetime64, UTC), fit_seconds, evaluate_seconds, peak_memory_mib (float64).
        - processor, code (digest of the sources), folder (of the record).
        - package: name and version of the package that a metric is from; "" where it is ours.

    Raises:
        UserError: no such folder, no record in it, or one that cannot be read.
    """
    import pandas as pd

    found = _found(folder)
    known = known_scores(record for _, record in found)
    rows = []
    for (place, record), run in zip(found, _runs(found), strict=True):
        about = {
            **run, "status": record.status, "marks": "; ".join(record.marks), "started": record.timing.started,
            "fit_seconds": record.timing.fit_seconds, "evaluate_seconds": record.timing.evaluate_seconds,
            "peak_memory_mib": record.timing.peak_memory_mib, "processor": record.machine.get("processor", ""),
            "code": record.code.get("sources", ""), "folder": str(place),
        }  # fmt: skip
        for metric, score in _scores(record, known).items():
            rows.append({
                **about, "metric": metric, "value": score.value, "unit": score.unit, "better": score.better,
                "count": score.count, "floor": score.floor, "note": score.note, "package": _package(record, metric),
            })  # fmt: skip
    frame = pd.DataFrame(rows, columns=list(RECORDS)).astype({"value": float, "floor": float})
    return frame.assign(started=pd.to_datetime(frame["started"], utc=True, format="ISO8601", errors="coerce"))


def items_frame(folder: Path) -> "pd.DataFrame":
    """Read the values of single images below a folder: a row for each run, metric and image (or moment).

    Runs that keep no values of single images have no rows. A curve over time::

        items_frame(Path("runs")).query("latest and metric == 'psnr'").pivot_table("value", "time", "variant")

    Args:
        folder: of runs (what `run --out` named) or collected records, at any depth.

    Returns:
        The columns protocol, dataset, case, method, preset, variant, prior, kind, seed, run_id, latest, metric, unit
        and better of `records_frame`, and:

        - item (int64): place in the order of the held-out images, from 0; for metrics of shapes, of the moments.
        - label: of the image ("view 3 at 0.0417 s"); "" for a moment.
        - time (float64): seconds in the clip; missing where the record does not say.
        - value (float64): missing where the metric is not defined on that image.

    Raises:
        UserError: no such folder, no record in it, or one that cannot be read.
    """
    import pandas as pd

    found = _found(folder)
    rows = []
    for (_, record), run in zip(found, _runs(found), strict=True):
        for metric, score in record.scores.items():
            if size := len(score.per_item):
                rows.append({
                    **run, "metric": metric, "item": range(size), "value": score.per_item, "unit": score.unit,
                    "label": record.items if len(record.items) == size else [""] * size,
                    "time": times_of(score, record.items) or [math.nan] * size, "better": score.better,
                })  # fmt: skip
    frame = pd.DataFrame(rows, columns=list(ITEMS)).explode(["item", "label", "time", "value"], ignore_index=True)
    return frame.astype({"item": int, "label": str, "time": float, "value": float})


def _found(folder: Path) -> Found:
    found = find_records(folder)
    if not found:
        raise UserError(f"{folder}: expected run records, found none.")
    return found


def _runs(found: Found) -> list[dict[str, Any]]:
    """Of each record what tells runs apart, by the names of `RUN`."""
    records = [record for _, record in found]
    labels: dict[int, str] = {}
    kept: set[int] = set()
    for group in by_protocol(records):
        newest, _ = latest(group)
        kept |= {id(record) for record in newest}
        for some in (group, newest):  # runs that tables leave out do not change the labels of the others
            labels |= {id(record): variant.label for variant in variants(some) for record in variant.records}
    return [
        {"protocol": record.protocol["name"], "dataset": record.dataset, "case": record.case, "method": record.method,
         "preset": record.preset, "variant": labels[id(record)], "kind": row_kind([record]), "seed": record.seed,
         "prior": record.prior.get("choice", record.prior.get("name", "")), "run_id": record.run_id,
         "latest": id(record) in kept}
        for record in records
    ]  # fmt: skip


def _package(record: RunRecord, metric: str) -> str:
    about = record.metrics.get(metric, {})
    return " ".join(filter(None, (about.get("package"), about.get("version"))))


def _scores(record: RunRecord, known: Mapping[str, Score]) -> dict[str, Score]:
    """The scores of a run, its protocol's first; one that it lacks has no value and says why."""
    failed = record.status != "ok"
    reason = record.error if failed else f"{record.protocol['name']} does not measure it"
    asked = {
        name: Score(None, known[name].unit if name in known else "", better_of(name, known), 0, note=reason)
        for name in record.protocol["scores"]
    }
    return asked if failed else asked | record.scores
