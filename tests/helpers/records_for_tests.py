"""Run records with chosen values, and tables of chosen rows."""

from collections.abc import Sequence
from typing import Any

import msgspec

from rewild4d.leaderboard.layout import Table
from rewild4d.leaderboard.records import RunRecord, Timing
from rewild4d.leaderboard.specs import Condition, Line, Spec
from rewild4d.metrics.score import Score

PROTOCOL = {"name": "p-v1", "title": "P", "scores": ["psnr"], "floors": ["empty"], "digest": "d"}


def record(**changes: Any) -> RunRecord:
    """A finished run of `ours` on wolf/Run that scored 20 dB."""
    fields: dict[str, Any] = {
        "schema": 1, "run_id": "0" * 16, "method": "ours", "dataset": "artemis", "case": "wolf/Run", "seed": 0,
        "preset": "quick", "status": "ok", "error": "", "scores": psnr(20.0), "coverage": {"foreground": 0.1},
        "config": {}, "data": {}, "prior": {}, "diagnostics": {}, "items": [], "pictures": [],
        "protocol": PROTOCOL, "code": {}, "machine": {},
        "timing": Timing("2026-01-01T00:00:00+00:00", 60.0, 1.0, 100.0),
    }  # fmt: skip
    return RunRecord(**{**fields, **changes})


def psnr(value: float | None, note: str = "") -> dict[str, Score]:
    """One score."""
    return {"psnr": Score(value, "dB", "higher", 1, [value], note)}


def lower(value: float) -> dict[str, Score]:
    """One score of which less is better."""
    return {"psnr": Score(value, "1", "lower", 1, [value])}


def runs(values: dict[str, list[float]], **changes: object) -> tuple[RunRecord, ...]:
    """Runs by case, a seed a value."""
    return tuple(
        record(case=case, seed=seed, scores=psnr(value), **changes)
        for case, found in values.items()
        for seed, value in enumerate(found)
    )


def texts(made: Table) -> dict[str, tuple[str, str, str]]:
    """Row -> text, spread and mark of its first cell."""
    return {row.stubs[0]: (row.cells[0].text, row.cells[0].spread, row.cells[0].mark) for row in made.rows}


def still(record: RunRecord) -> RunRecord:
    """A record without what may differ between two equal runs."""
    return msgspec.structs.replace(record, timing=Timing("", 0, 0, 0))


def spec(rows: Sequence[Line], **changes: Any) -> Spec:
    """A table of rows under one condition."""
    fields: dict[str, Any] = {
        "title": "Demo", "dataset": "artemis", "scores": ("psnr", "iou"), "rows": tuple(rows),
        "conditions": (Condition(protocol="artemis-sweep-128"),), "preset": "quick", "seeds": (0,),
    }  # fmt: skip
    return Spec(**{**fields, **changes})
