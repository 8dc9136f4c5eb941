"""Records: round trip, strict reading, and tables that refuse to average what cannot be averaged."""

import math
import re
from pathlib import Path
from typing import Any

import pytest
from records_for_tests import PROTOCOL, psnr, record

from rewild4d.errors import UserError
from rewild4d.evaluation.image_scores import summarize
from rewild4d.leaderboard.records import find_records, make_run_id, read_record, to_json, write_record
from rewild4d.leaderboard.tables import markdown
from rewild4d.metrics.score import Score


def test_round_trip(tmp_path: Path) -> None:
    assert read_record(write_record(record(), tmp_path)) == record()
    assert [path.name for path in tmp_path.iterdir()] == ["record.json"]


def test_reading_is_strict(tmp_path: Path) -> None:
    path = tmp_path / "record.json"
    path.write_text(to_json(record()).replace('"seed": 0', '"seed": "zero"'))
    with pytest.raises(
        UserError, match=r"record.json: expected a run record of schema 1, but Expected `int`, got `str`"
    ):
        read_record(path)
    path.write_text(to_json(record(schema=9)))
    with pytest.raises(UserError, match="expected a run record of schema 1, got schema 9"):
        read_record(path)
    path.write_text(to_json(record())[:50])
    with pytest.raises(UserError, match="record.json: expected a run record"):
        read_record(path)
    with pytest.raises(UserError, match="no such file"):
        read_record(tmp_path / "other.json")
    path.write_bytes(b'{"case": "\xff"}')
    with pytest.raises(
        UserError, match="expected a run record of schema 1, but byte 0xff at position 10 is no UTF-8 text"
    ):
        read_record(path)
    path.write_text(to_json(record(config={"a": "DEEP"})).replace('"DEEP"', "[" * 9999 + "]" * 9999))
    with pytest.raises(UserError, match="expected a run record of schema 1, but"):
        read_record(path)


@pytest.mark.parametrize("name", ["name", "title", "scores"])
def test_a_protocol_has_what_tables_ask_of_it(tmp_path: Path, name: str) -> None:
    protocol = {key: value for key, value in PROTOCOL.items() if key != name}
    path = write_record(record(protocol=protocol), tmp_path)
    sentence = f"record.json: expected the protocol of a run, but in `protocol`: .*missing required field `{name}`"
    with pytest.raises(UserError, match=sentence):
        read_record(path)
    write_record(record(protocol={**PROTOCOL, name: 5}), tmp_path)
    with pytest.raises(UserError, match=rf"in `protocol`: Expected `\w+`, got `int` - at `\$.{name}`"):
        read_record(path)


@pytest.mark.parametrize(
    ("changes", "place"),
    [
        ({"prior": {"choice": 5}}, r"`prior`: Expected `str`, got `int` - at `\$.choice`"),
        ({"protocol": {**PROTOCOL, "selection": 7}}, r"`protocol`: Expected `object`, got `int` - at `\$.selection`"),
    ],
)
def test_prior_and_selection_are_what_tables_take_them_for(tmp_path: Path, changes: dict, place: str) -> None:  # type: ignore[type-arg]
    with pytest.raises(UserError, match=f"record.json: expected the .* of a run, but in {place}"):
        read_record(write_record(record(**changes), tmp_path))


def test_a_folder_is_no_record(tmp_path: Path) -> None:
    (tmp_path / "run" / "record.json").mkdir(parents=True)
    with pytest.raises(UserError, match="record.json: expected a regular file, got something else"):
        find_records(tmp_path)


def test_run_id_depends_on_every_part() -> None:
    ids = {make_run_id(seed=0, method="a"), make_run_id(seed=1, method="a"), make_run_id(seed=0, method="b")}
    assert len(ids) == 3
    assert make_run_id(method="a", seed=0) in ids, "the order of the parts does not count"


def test_table_shows_mean_and_spread_over_seeds() -> None:
    table = markdown([record(seed=seed, scores=psnr(value)) for seed, value in enumerate((19.0, 20.0, 21.0))])
    assert "| wolf/Run | ours | 20.00 ± 1.00 | 3 | 60 |" in table


def test_a_mean_over_fewer_cases_than_others_have_says_so() -> None:
    full = [record(case=case, scores=psnr(value)) for case, value in (("a/x", 10.0), ("b/x", 30.0))]
    assert "| **mean** | ours | 20.00 |" in markdown(full)
    partial = [*full, record(method="gart", case="a/x", scores=psnr(12.0))]
    assert "| **mean** | gart | 12.00 [1] | 1 of 2 cases | - |" in markdown(partial)
    assert "[1] 1 of 2 cases: a/x" in markdown(partial)


def test_a_failure_is_a_row() -> None:
    table = markdown([record(), record(method="gart", status="failed", error="it diverged", scores={})])
    assert "| wolf/Run | gart | failed [1] | 0 of 1 | - |" in table
    assert "wolf/Run, gart: failed: it diverged" in table


def test_a_score_without_a_value_says_why() -> None:
    assert summarize("psnr_fg", [None, None]).note == "not computed: no image in which it is defined"
    assert summarize("psnr", []).note == "not computed: no image"
    some = summarize("psnr", [10.0, None, 100.0])
    assert (some.value, some.count) == ((10.0 + 100.0) / 2, 2)
    assert some.note == "1 images left out: not defined there; 1 identical images counted as 100 dB"


@pytest.mark.parametrize(
    ("changes", "place"),
    [
        ({"scores": psnr(math.nan)}, "nan at scores.psnr.value"),
        ({"scores": {"psnr": Score(1.0, "dB", "higher", 2, [1.0, math.inf])}}, "inf at scores.psnr.per_item[1]"),
        ({"diagnostics": {"motion": [{"turn": -math.inf}]}}, "-inf at diagnostics.motion[0].turn"),
        ({"coverage": {"foreground": math.nan}}, "nan at coverage.foreground"),
    ],
)
def test_not_finite_is_never_written(tmp_path: Path, changes: dict[str, Any], place: str) -> None:
    with pytest.raises(ValueError, match="expected finite numbers in the record of a run, got " + re.escape(place)):
        write_record(record(**changes), tmp_path)
    assert not list(tmp_path.iterdir())
