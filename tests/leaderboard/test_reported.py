"""What the paper printed: every cell, a column for each, beside the data set that it is of."""

import json
from pathlib import Path

import pytest
from calling import call

from rewild4d.commands.choice import chosen
from rewild4d.leaderboard.specs import load_reported, load_specs
from rewild4d.leaderboard.tables import columns_of
from rewild4d.running import planning

RESULTS = Path(__file__).parents[2] / "results"


def test_every_cell_of_the_papers_tables_is_there() -> None:
    counts = {"input-view": 7 * 9, "novel-view": 7 * 9, "artemis": 3 * 7, "ablation": 6 * 3}
    for name, count in counts.items():
        assert sum(len(row.cells) for row in load_reported(name).rows) == count
    groups = {"davis": "DAVIS", "online": "Online", "aptv2": "APTv2"}
    scores = {"lpips": "lpips_alex", "kid_16v": "kid_v"}
    path = Path(__file__).parents[3] / "shared" / "paper" / "tables.json"
    if not path.is_file():
        pytest.skip(f"no {path}: the paper's cells are only counted")
    for name, rows in json.loads(path.read_text())["tables"].items():
        found = [(row.label, row.cells) for row in load_reported(name).rows]
        wanted = []
        for row in rows:
            parts = {key.rpartition("/")[::2]: value for key, value in row["cells"].items()}
            cells = {(f"{groups[g]}/" if g else "") + scores.get(s, s): value for (g, s), value in parts.items()}
            wanted.append((row["label"], cells))
        assert found == wanted


def test_every_reported_cell_has_a_column() -> None:
    for name, found in load_specs().items():
        if not found.paper or found.paper != name:
            continue
        full = planning.with_choice(name, found, planning.Choice())
        numbers = planning.reported(full)
        assert numbers is not None
        columns = columns_of([], full.scores, planning.frame(name, full).conditions)
        names = {f"{column.group}/{column.score}" if column.group else column.score for column in columns}
        assert {cell for row in numbers.rows for cell in row.cells} <= names, name


def test_what_only_notes_tell_is_marked(capsys: pytest.CaptureFixture[str]) -> None:
    assert call("table", "aim", "--runs", str(RESULTS / "2026-11-23-artemis-standard")) == 0
    out = capsys.readouterr().out
    assert "| 4D-Fauna (reported, unconfirmed) | 0.814 | 0.664 | 0.317 | 0.418 | 0.044 |" in out
    assert "Reported, unconfirmed: Zhao et al." in out
    assert load_reported("equine-motion").rows[0].cells["APT-36K/pck@0.1_crop_bones"] == pytest.approx(51.4 / 100)
    assert {load_reported(name).mark for name in ("artemis", "ablation", "input-view", "novel-view")} == {"reported"}


def test_the_protocol_chooses_the_condition_of_its_data_set() -> None:
    for protocol, title in (("aptv2-512", "APTv2"), ("davis-256", "DAVIS"), ("online-512-v1", "Online")):
        found = chosen("input-view", load_specs()["input-view"], planning.Choice(protocol=protocol))
        (condition,) = found.conditions
        assert (condition.title, found.dataset) == (title, protocol.partition("-")[0])
        numbers = planning.reported(found)
        assert numbers is not None and numbers.rows[-1].label == "Ours"
        assert numbers.rows[-1].cells["psnr"] == {"APTv2": 24.938, "DAVIS": 26.321, "Online": 26.206}[title]
    whole = chosen("input-view", load_specs()["input-view"], planning.Choice())
    assert [one.title for one in whole.conditions] == ["DAVIS", "Online", "APTv2"]
    assert [one.title for one in planning.own_conditions(whole)] == ["DAVIS"]


def test_records_of_an_older_protocol_are_printed_by_it_and_that_is_said(capsys: pytest.CaptureFixture[str]) -> None:
    words = ("table", "artemis", "--runs", str(RESULTS / "2026-11-23-artemis-standard"))
    assert call(*words) == 0
    out = capsys.readouterr().out
    assert "By protocol artemis-sweep-256-v2, as no row has a record of artemis-sweep-256-v4 here." in out
    assert "`artemis-sweep-256-v2`" in out and "| D-3DGS | 21.91 ± " in out
    assert call(*words, "--protocol", "artemis-sweep-256-v4") == 0
    assert "21.91" not in capsys.readouterr().out, "a version that is named stays"
