"""Data frames of records: every number as in the JSON files, failures as rows, dtypes, one sentence where none are."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from records_for_tests import PROTOCOL, psnr, record, runs

import rewild4d as rw
from rewild4d.errors import UserError
from rewild4d.leaderboard.formats import tidy_frame
from rewild4d.leaderboard.frame import ITEMS, RECORDS, items_frame, records_frame
from rewild4d.leaderboard.records import RunRecord, Timing, find_records, write_record
from rewild4d.leaderboard.tables import protocol_tables, standings
from rewild4d.metrics.score import Score

ROOT = Path(__file__).resolve().parents[2]
RESULTS = ROOT / "results" / "2026-11-23-artemis-standard"
TWO = {**PROTOCOL, "scores": ["psnr", "chamfer_relative"]}
LABELS = ["view 1 at 0.0000 s", "view 2 at 0.0000 s", "view 1 at 0.5000 s", "view 2 at 0.5000 s"]


def keep(folder: Path, *records: RunRecord) -> Path:
    for index, made in enumerate(records):
        write_record(made, folder / f"{index:02d}")
    return folder


def test_every_row_is_what_the_json_file_says() -> None:
    frame = records_frame(RESULTS)
    files = {
        data["run_id"]: (path, data) for path in RESULTS.rglob("record.json") if (data := json.loads(path.read_text()))
    }
    assert set(frame["run_id"]) == set(files)
    assert len(frame) == sum(len(data["scores"]) for _, data in files.values())
    for row in frame.iloc[:: len(frame) // 40].to_dict("records"):
        path, data = files[row["run_id"]]
        score = data["scores"][row["metric"]]
        for name in ("value", "floor"):
            assert row[name] == score[name] if score[name] is not None else np.isnan(row[name])
        for name in ("unit", "better", "count", "note"):
            assert row[name] == score[name]
        for name in ("dataset", "case", "method", "preset", "seed", "status"):
            assert row[name] == data[name]
        for name in ("fit_seconds", "evaluate_seconds", "peak_memory_mib"):
            assert row[name] == data["timing"][name]
        assert row["started"] == pd.Timestamp(data["timing"]["started"])
        assert (row["protocol"], row["prior"]) == (data["protocol"]["name"], data["prior"]["choice"])
        assert (row["processor"], row["code"]) == (data["machine"]["processor"], data["code"]["sources"])
        assert (row["folder"], row["marks"]) == (str(path.parent), "; ".join(data["marks"]))


def test_means_are_those_of_the_tables() -> None:
    """The example in the docstring against the table that ranks methods."""
    frame = records_frame(RESULTS).query("latest and metric == 'psnr'")
    means = frame.groupby(["protocol", "variant", "case"]).value.mean().groupby(["protocol", "variant"]).mean()
    (ranked,) = standings([made for _, made in find_records(RESULTS)])
    assert {row.stubs[0]: pytest.approx(row.cells[0].value) for row in ranked.rows} == means.droplevel(0).to_dict()


def test_columns_and_dtypes(tmp_path: Path) -> None:
    folder = keep(tmp_path, record(items=["view 1 at 0.0000 s"]))
    frame, items = records_frame(folder), items_frame(folder)
    assert (tuple(frame.columns), tuple(items.columns)) == (RECORDS, ITEMS)
    numbers = {"seed": "int64", "count": "int64", "item": "int64", "latest": "bool"}
    numbers |= dict.fromkeys(
        ("value", "floor", "time", "fit_seconds", "evaluate_seconds", "peak_memory_mib"), "float64"
    )
    for column in (*(frame[name] for name in RECORDS), *(items[name] for name in ITEMS)):
        if column.name == "started":
            assert isinstance(column.dtype, pd.DatetimeTZDtype) and str(column.dt.tz) == "UTC"
        elif column.name in numbers:
            assert column.dtype == numbers[str(column.name)], column.name
        else:
            assert all(isinstance(value, str) for value in column), column.name


def test_a_failure_has_a_row_for_every_metric_of_its_protocol(tmp_path: Path) -> None:
    scores = psnr(20.0) | {"chamfer_relative": Score(0.01, "1", "lower", 2, [0.01, 0.01], "", 0.004)}
    good = record(run_id="a", protocol=TWO, scores=scores)
    failed = record(run_id="b", protocol=TWO, method="gart", status="failed", error="it diverged", scores={})
    frame = records_frame(keep(tmp_path, good, failed)).set_index(["run_id", "metric"])
    assert list(frame.loc["b"].index) == ["psnr", "chamfer_relative"]
    for metric, unit, better in (("psnr", "dB", "higher"), ("chamfer_relative", "1", "lower")):
        row = frame.loc[("b", metric)]
        assert np.isnan(row["value"]) and np.isnan(row["floor"])
        assert (row["status"], row["count"], row["note"]) == ("failed", 0, "it diverged")
        assert (row["unit"], row["better"]) == (unit, better), "as the run beside it says"
    assert frame.loc[("a", "chamfer_relative"), ["value", "floor"]].tolist() == [0.01, 0.004]
    alone = records_frame(keep(tmp_path / "01"))
    assert list(zip(alone["unit"], alone["better"], strict=True)) == [("", "higher"), ("", "lower")]


def test_what_was_not_measured_or_not_computed_says_why(tmp_path: Path) -> None:
    scores = {"iou": Score(0.5, "1", "higher", 1), **psnr(None, "not computed: why")}
    frame = records_frame(keep(tmp_path, record(protocol=TWO, scores=scores)))
    assert list(frame["metric"]) == ["psnr", "chamfer_relative", "iou"], "those of the protocol first"
    assert frame["value"].isna().tolist() == [True, True, False]
    assert frame["note"].tolist() == ["not computed: why", "p-v1 does not measure it", ""]
    assert set(frame["status"]) == {"ok"}


def test_rows_are_told_apart_as_in_tables(tmp_path: Path) -> None:
    def at(day: int, **changes: Any) -> RunRecord:
        return record(timing=Timing(f"2026-01-{day:02d}T00:00:00+00:00", 1.0, 1.0, 1.0), **changes)

    found = [
        at(1, run_id="old", scores=psnr(10.0)), at(2, run_id="new"), at(2, run_id="seed1", seed=1),
        at(2, run_id="off", config={"deform": {"enabled": False}}), at(2, run_id="empty", method="empty"),
        at(2, run_id="seen", method="gart", marks=["upper bound: rotated", "seen"], prior={"choice": "rig"}),
    ]  # fmt: skip
    frame = records_frame(keep(tmp_path, *found)).set_index("run_id")
    assert frame["latest"].to_dict() == {name: name != "old" for name in frame.index}
    assert frame["kind"].to_dict() == {
        **dict.fromkeys(("old", "new", "seed1", "off"), "method"), "empty": "floor", "seen": "unranked",
    }  # fmt: skip
    assert frame.loc["seen", ["marks", "prior"]].tolist() == ["upper bound: rotated; seen", "rig"]
    (made,) = protocol_tables(found)
    assert set(frame["variant"]) == {row.stubs[1] for row in made.rows}
    assert frame.loc["off", "variant"] == "ours [deform.enabled=false]"


def test_a_value_for_each_image(tmp_path: Path) -> None:
    scores = {
        "psnr": Score(20.0, "dB", "higher", 3, [10.0, 20.0, None, 30.0]),
        "chamfer_relative": Score(0.2, "1", "lower", 2, [0.1, 0.3]),
        "fscore_1": Score(0.5, "1", "higher", 3, [0.5, 0.5, 0.5]),
        "iou": Score(0.5, "1", "higher", 4),
    }
    failed = record(run_id="f" * 16, seed=1, status="failed", error="it diverged", scores={})
    frame = items_frame(keep(tmp_path, record(items=LABELS, scores=scores), failed))
    assert set(frame["metric"]) == {"psnr", "chamfer_relative", "fscore_1"}
    assert set(frame["run_id"]) == {"0" * 16}, "a failure has no images"
    image = frame[frame["metric"] == "psnr"]
    assert image["value"].fillna(-1).tolist() == [10.0, 20.0, -1.0, 30.0]
    assert image["label"].tolist() == LABELS and image["item"].tolist() == [0, 1, 2, 3]
    assert image["time"].tolist() == [0.0, 0.0, 0.5, 0.5]
    shape = frame[frame["metric"] == "chamfer_relative"]
    assert shape["time"].tolist() == [0.0, 0.5] and shape["label"].tolist() == ["", ""], "one value a moment"
    unknown = frame[frame["metric"] == "fscore_1"]
    assert unknown["time"].isna().all() and unknown["item"].tolist() == [0, 1, 2]
    curve = frame.query("metric == 'psnr'").pivot_table("value", "time", "variant")
    assert curve["ours"].tolist() == [(10.0 + 20.0) / 2, 30.0]


def test_items_are_those_of_the_json_file() -> None:
    frame = items_frame(RESULTS)
    path = next(iter(sorted(RESULTS.rglob("record.json"))))
    data = json.loads(path.read_text())
    for metric, score in data["scores"].items():
        chosen = frame[(frame["run_id"] == data["run_id"]) & (frame["metric"] == metric)]
        assert chosen["value"].tolist() == score["per_item"]
        assert set(chosen["unit"]) == {score["unit"]} and set(chosen["case"]) == {data["case"]}


@pytest.mark.parametrize("read", [records_frame, items_frame])
def test_a_folder_without_records_is_a_sentence(read: Any, tmp_path: Path) -> None:
    with pytest.raises(UserError, match=f"{tmp_path}: expected run records, found none."):
        read(tmp_path)
    with pytest.raises(UserError, match="none: expected a folder of runs, but there is no such folder"):
        read(tmp_path / "none")


def test_runs_without_values_of_images_have_no_rows(tmp_path: Path) -> None:
    frame = items_frame(keep(tmp_path, record(status="failed", error="it diverged", scores={})))
    assert frame.empty and tuple(frame.columns) == ITEMS and frame["value"].dtype == "float64"


def test_a_notebook_reads_and_plots_them(tmp_path: Path) -> None:
    several = [record(run_id=f"{i:02d}", case=made.case, seed=made.seed, scores=made.scores)
               for i, made in enumerate(runs({"a": [20.0, 22.0], "b": [30.0]}))]  # fmt: skip
    frame = rw.records(keep(tmp_path, *several))
    assert frame["value"].tolist() == rw.items(tmp_path)["value"].tolist() == [20.0, 22.0, 30.0]
    (axes,) = rw.plot(frame, "psnr").axes
    assert [bar.get_height() for bar in axes.patches] == [21.0, 30.0] and axes.get_ylabel() == "psnr, dB"


def test_a_table_as_a_frame() -> None:
    (made,) = protocol_tables(runs({"a": [20.0, 21.0], "b": [30.0, 31.0]}))
    frame = tidy_frame(made).query("score == 'psnr'")
    assert frame["case"].tolist() == ["a", "b", "mean"] and frame["value"].tolist() == [20.5, 30.5, 25.5]
