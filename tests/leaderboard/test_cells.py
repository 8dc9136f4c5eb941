"""Figures that leave something out or are not there: the table says what and why, whatever the order of the records."""

from dataclasses import replace

from records_for_tests import PROTOCOL, psnr, record

from rewild4d.leaderboard.formats import html, latex, markdown, tidy_csv
from rewild4d.leaderboard.layout import Cell, Column, Row, Table
from rewild4d.leaderboard.records import RunRecord
from rewild4d.leaderboard.tables import Entrant, Frame, difference_table, named_table, protocol_tables
from rewild4d.metrics.score import Score

FRAME = Frame("t", "Title", "", ("",), ("psnr",))
NOTHING = psnr(None, "not computed: the prediction has no points")


def seeds(*values: float | None, **changes: object) -> tuple[RunRecord, ...]:
    """Runs on one case, a seed a value."""
    scores = [NOTHING if value is None else psnr(value) for value in values]
    return tuple(record(seed=seed, scores=found, **changes) for seed, found in enumerate(scores))


def difference(one: Entrant, other: Entrant, frame: Frame = FRAME) -> Cell:
    return difference_table(frame, [one, other], other.label).rows[0].cells[0]


def test_a_seed_without_a_value_is_told() -> None:
    (made,) = protocol_tables(seeds(20.0, None, 22.0))
    found, count = made.rows[0].cells[:2]
    reason = "1 of 3 runs without a value, left out: the prediction has no points"
    assert (found.value, found.note, count.text) == ((20.0 + 22.0) / 2, reason, "3")
    both = (*seeds(20.0, None), record(seed=2, status="failed", error="it diverged", scores={}))
    note = "1 of 3 runs failed: it diverged; " + reason
    assert named_table(FRAME, [Entrant("ours", (both,))]).rows[0].cells[0].note == note
    other = Entrant("gart", (seeds(10.0, 11.0),))
    assert difference(Entrant("ours", (seeds(20.0, None, 22.0),)), other).note == reason
    assert difference(other, Entrant("ours", (seeds(20.0, None, 22.0),))).note == reason


def test_items_that_a_mean_is_without_are_told() -> None:
    """Images whose truth shows no animal have no foreground."""
    score = Score(20.0, "dB", "higher", 2, [20.0, None, 20.0], "1 images left out: not defined there; 1 identical")
    made = named_table(FRAME, [Entrant("ours", ((record(scores={"psnr": score}),),))])
    assert made.rows[0].cells[0].note == "wolf/Run: 1 images left out: not defined there"


def test_a_difference_that_is_not_there_says_why() -> None:
    ours, empty = Entrant("ours", (seeds(20.0),)), Entrant("empty", (seeds(None),))
    reason = "not computed: the prediction has no points"
    for pair in ((ours, empty), (empty, ours)):
        assert (difference(*pair).text, difference(*pair).note) == ("n/a", reason)
    assert difference(ours, empty, replace(FRAME, scores=("iou",))).note == "not computed: p-v1 does not measure it"
    assert difference(ours, Entrant("gart", (seeds(10.0, case="cow/Run"),))).note == "no case in common"
    assert difference(Entrant("gart", ((),)), ours).note == "no record yet"
    assert difference(Entrant("gart", ((),), "unknown method 'x'."), ours).note == "unknown method 'x'."
    broken = record(status="failed", error="it diverged", scores={})
    made = difference(Entrant("ours", ((broken,),)), Entrant("gart", (seeds(10.0),)))
    assert (made.text, made.note) == ("n/a", "wolf/Run, ours: failed: it diverged")


def shape(method: str, case: str, value: float | None, floor: float, seed: int = 0) -> RunRecord:
    protocol = {**PROTOCOL, "scores": ["chamfer_relative", "fscore_1"]}
    scores = {
        "chamfer_relative": Score(value, "1", "lower", 1, [value], "", floor),
        "fscore_1": Score(0.5, "1", "higher", 1, [0.5], "", 1.0),
    }
    return record(method=method, case=case, seed=seed, protocol=protocol, scores=scores)


def test_the_sampling_floor_belongs_to_a_row() -> None:
    found = [
        shape("empty", "a", None, 0.001),  # no points: the floor of another number of them
        shape("ours", "a", 0.02, 0.004), shape("ours", "a", 0.02, 0.006, seed=1), shape("ours", "b", 0.02, 0.009),
        shape("gart", "a", 0.02, 0.003), shape("gart", "b", 0.02, 0.004),
        shape("d3dgs", "a", 0.02, 0.005), shape("d3dgs", "b", 0.02, 0.005),
    ]  # fmt: skip
    low, high = (0.003 + 0.004) / 2, ((0.004 + 0.006) / 2 + 0.009) / 2
    sentence = (
        "A second sampling of the true surface by as many points as a row has, which is what a perfect shape gets: "
        f"CD / diagonal {low:.4f} (gart) to {high:.4f} (ours), F@1 % 1.000."
    )
    for records in (found, found[::-1], found[3:] + found[:3]):
        assert protocol_tables(records)[0].remarks == (sentence,)


def test_a_row_that_sums_up_is_bold_where_a_format_has_bold_titles() -> None:
    (made,) = protocol_tables([record(case=case) for case in ("a", "mean")])
    assert "| **mean** | ours | 20.00 |" in markdown(made) and "| mean | ours | 20.00 |" in markdown(made)
    assert r"\textbf{mean} & ours & 20.00" in latex(made) and "\nmean & ours" in latex(made)
    assert "*" not in html(made) + tidy_csv(made) and html(made).count("<td>mean</td>") == 2
    row = Row(("one",), (Cell("1"),), notes=("why",), summary=True)
    assert "| **one** [1] | 1 |" in markdown(Table("t", "T", "", ("",), (Column("x"),), (row,)))
