"""Records of several versions of code, weights or protocols are never averaged; doubled lower bounds are one row."""

from typing import Any

import msgspec
from records_for_tests import PROTOCOL, psnr, record, spec, texts

from rewild4d.config import load_preset
from rewild4d.leaderboard.layout import Table
from rewild4d.leaderboard.records import RunRecord, Timing
from rewild4d.leaderboard.specs import Line
from rewild4d.leaderboard.tables import Entrant, Frame, difference_table, named_table, protocol_tables, standings
from rewild4d.registry import load_config
from rewild4d.running import planning

FRAME = Frame("t", "Title", "", ("",), ("psnr",))
NEW, OLD = {"sources": "11111111aaaa"}, {"sources": "22222222bbbb"}


def on(case: str, value: float, **changes: Any) -> RunRecord:
    return record(case=case, scores=psnr(value), run_id=f"{case}-{value}", **changes)


def rows(made: Table) -> dict[tuple[str, ...], str]:
    return {row.stubs: row.cells[0].text for row in made.rows}


def test_runs_by_two_versions_of_the_code_are_rows_of_their_own() -> None:
    (made,) = protocol_tables([on("a", 10.0, code=NEW), on("b", 30.0, code=NEW), on("c", 90.0, code=OLD)])
    assert rows(made) == {
        ("a", "ours [code 11111111]"): "10.00", ("b", "ours [code 11111111]"): "30.00",
        ("c", "ours [code 22222222]"): "90.00",
        ("mean", "ours [code 11111111]"): f"{(10 + 30) / 2:.2f}", ("mean", "ours [code 22222222]"): "90.00",
    }  # fmt: skip
    assert [row.cells[1].text for row in made.rows[-2:]] == ["2 of 3 cases", "1 of 3 cases"]
    assert "Runs of 2 versions of the code; no mean is over two of them." in made.remarks
    assert made.notes == ("2 of 3 cases: a, b", "1 of 3 cases: c")


def test_methods_of_one_version_each_stay_as_they_are() -> None:
    found = [on("a", 10.0, code=NEW), on("b", 30.0, code=NEW)]
    found += [on("a", 11.0, method="gart", code=OLD), on("b", 31.0, method="gart", code=OLD)]
    (made,) = standings(found)
    assert texts(made) == {"ours": ("20.00", "", "second"), "gart": ("21.00", "", "best")}


def test_seeds_by_two_versions_are_not_averaged_either() -> None:
    (made,) = protocol_tables([on("a", 10.0, code=NEW), on("a", 30.0, seed=1, code=OLD)])
    assert rows(made) == {("a", "ours [code 11111111]"): "10.00", ("a", "ours [code 22222222]"): "30.00"}


def test_a_packages_code_and_the_weights_of_a_learned_prior_count_too() -> None:
    for one, other in (
        ({"code": {**NEW, "method": "x" * 16}}, {"code": {**NEW, "method": "y" * 16}}),
        ({"code": {**NEW, "program_digest": "x" * 16}}, {"code": {**NEW, "program_digest": "y" * 16}}),
        ({"code": NEW, "prior": {"weights": "x" * 16}}, {"code": NEW, "prior": {"weights": "y" * 16}}),
    ):
        (made,) = standings([on("a", 10.0, **one), on("b", 30.0, **other)])
        assert len(made.rows) == 2 and {row.cells[0].text for row in made.rows} == {"10.00", "30.00"}
        assert all("xxxxxxxx" in row.stubs[0] or "yyyyyyyy" in row.stubs[0] for row in made.rows)


def test_a_row_that_was_gathered_by_hand_is_refused() -> None:
    both = (on("a", 10.0, code=NEW), on("b", 30.0, code=OLD))
    (row,) = named_table(FRAME, [Entrant("ours", (both,))]).rows
    assert (row.cells[0].text, row.cells[0].value) == ("n/a", None)
    assert row.cells[0].note == "not averaged: a by code 11111111 and b by code 22222222"
    (row,) = named_table(FRAME, [Entrant("ours", ((on("a", 10.0), on("b", 30.0, networks={"psnr": "x"})),))]).rows
    assert row.cells[0].value == (10 + 30) / 2, "a record from before digests were kept is like any other"


def test_scores_by_unlike_weights_are_neither_averaged_nor_subtracted() -> None:
    mine = on("a", 10.0, networks={"psnr": "1111111111"}), on("b", 30.0, networks={"psnr": "2222222222"})
    note = "not averaged: a by weights 11111111 and b by weights 22222222; `rewild4d-bench evaluate` scores again"
    (row,) = named_table(FRAME, [Entrant("ours", (mine,))]).rows
    assert (row.cells[0].text, row.cells[0].note) == ("n/a", note)
    theirs = on("a", 5.0, method="gart", networks={"psnr": "2222222222"})
    one, other = Entrant("ours", (mine[:1],)), Entrant("gart", ((theirs,),))
    (row,) = difference_table(FRAME, [one, other], "gart").rows
    assert row.cells[0].note == note.replace("b by", "a by")
    same = Entrant("gart", ((on("a", 5.0, method="gart", networks={"psnr": "1111111111"}, code=OLD),),))
    (row,) = difference_table(FRAME, [one, same], "gart").rows
    assert row.cells[0].value == 10 - 5


def test_a_protocol_that_changed_under_its_name_is_left_out() -> None:
    def at(day: int, case: str, digest: str) -> RunRecord:
        timing = Timing(f"2026-01-{day:02d}T00:00:00+00:00", 1.0, 1.0, 1.0)
        return on(case, float(day), protocol={**PROTOCOL, "digest": digest}, timing=timing)

    (made,) = protocol_tables([at(2, "a", "new"), at(1, "b", "old")])
    assert rows(made) == {("a", "ours"): "2.00"}
    assert made.remarks == ("p-v1: records of b by another protocol of that name left out.",)


def test_a_lower_bound_that_was_run_beside_several_presets_is_one_row() -> None:
    def prior(effort: str) -> dict[str, Any]:
        return {"prior": {"choice": "template", "config": {"effort": effort}}}

    empty = [on("a", 5.0, method="empty", preset=preset, **prior(preset)) for preset in ("default", "quick")]
    (made,) = protocol_tables([record(case="a"), *empty])
    assert rows(made) == {("a", "ours"): "20.00", ("a", "empty"): "5.00"}
    (made,) = protocol_tables([record(case="a"), *empty, on("b", 7.0, method="empty", **prior("standard"))])
    assert rows(made)[("mean", "empty")] == f"{(5 + 7) / 2:.2f}"
    floors = {**PROTOCOL, "floors": ["prior-only"]}
    of_prior = [on("a", 9.0, method="prior-only", preset=p, protocol=floors, **prior("x")) for p in ("d", "q")]
    assert len(protocol_tables(of_prior)[0].rows) == 1
    of_prior.append(on("a", 8.0, method="prior-only", preset="q", protocol=floors, **prior("y")))
    assert len(protocol_tables(of_prior)[0].rows) == 2, "another prior is another lower bound"


def test_of_doubled_lower_bounds_the_version_with_most_cases_stays() -> None:
    later = Timing("2026-02-01T00:00:00+00:00", 1.0, 1.0, 1.0)
    found = [on(case, 5.0, method="empty", code=OLD) for case in ("a", "b")]
    found.append(on("a", 5.0, method="empty", code=NEW, timing=later, prior={"choice": "rig"}))
    (made,) = protocol_tables([on("a", 20.0, code=NEW), on("b", 20.0, code=NEW), *found])
    assert {stubs[1] for stubs in rows(made)} == {"ours", "empty"} and rows(made)["mean", "empty"] == "5.00"


def test_a_named_table_splits_its_rows() -> None:
    config = load_preset("gart", load_config("gart"), "quick")
    protocol = {**PROTOCOL, "name": planning.newest_protocol("artemis-sweep-128")}
    given = {"method": "gart", "config": msgspec.to_builtins(config), "protocol": protocol,
             "prior": {"choice": "template"}}  # fmt: skip
    found = [on("a", 10.0, code=NEW, **given), on("b", 30.0, code=OLD, **given)]
    asked = planning.with_choice("demo", spec([Line(label="GART", method="gart")]), planning.Choice())
    entrants, _ = planning.entrants("demo", asked, found)
    assert [one.label for one in entrants] == ["GART [code 11111111]", "GART [code 22222222]"]
    entrants, _ = planning.entrants("demo", asked, [on("a", 10.0, code=NEW, **given), on("b", 30.0, code=NEW, **given)])
    assert [one.label for one in entrants] == ["GART"]
