"""What a table says of its own means: over which cases they are, how many seeds stand behind them."""

from dataclasses import replace

import pytest
from records_for_tests import record, runs

from rewild4d.leaderboard.formats import FORMATS
from rewild4d.leaderboard.records import RunRecord
from rewild4d.leaderboard.remarks import FEW, cases_said, seeds_said
from rewild4d.leaderboard.tables import Entrant, Frame, difference_table, named_table, standings

FRAME = Frame("t", "Title", "How to read it", ("",), ("psnr",))
UNKNOWN = "nothing is known of the spread over seeds: bold only orders the means."


@pytest.mark.parametrize(
    ("cases", "sentence"),
    [
        ([["a"]], "Mean over 1 case: a."),
        ([["b", "a"]], "Mean over 2 cases: b, a."),
        ([["a", "b"], ["b", "a"]], "Mean over 2 cases: a, b."),
        ([["a", "b"], []], "Mean over 2 cases: a, b."),
        ([["a", "b"], ["a"]], "Mean over 2 cases (one): a, b; 1 case (two): a."),
        ([[str(number) for number in range(FEW + 1)]], f"Mean over {FEW + 1} cases."),
        ([["a"] * FEW, ["b"]], f"Mean over {FEW} cases (one); 1 case (two)."),
        ([[]], ""),
    ],
)
def test_cases_are_counted_and_named_where_they_are_few(cases: list[list[str]], sentence: str) -> None:
    titles = ["one", "two"] if len(cases) > 1 else [""]
    assert cases_said("Mean over", titles, cases) == sentence


@pytest.mark.parametrize(
    ("groups", "sentence"),
    [
        ([runs({"a": [1.0], "b": [2.0]})], f"Every row has one seed, so that {UNKNOWN}"),
        ([runs({"a": [1.0, 2.0], "b": [3.0, 4.0]})], "± is the spread over seeds."),
        ([runs({"a": [1.0, 2.0], "b": [3.0]})], f"No row has two seeds on all of its cases, so that {UNKNOWN}"),
        (
            [runs({"a": [1.0, 2.0]}), runs({"a": [1.0]})],
            f"± is the spread over seeds; where a row has none, {UNKNOWN}",
        ),
        ([runs({"a": [1.0]}), ()], f"Every row has one seed, so that {UNKNOWN}"),
        ([(record(status="failed", error="it diverged", scores={}),), ()], ""),
        ([], ""),
    ],
)
def test_seeds_that_give_no_spread_are_told(groups: list[tuple[RunRecord, ...]], sentence: str) -> None:
    assert seeds_said(groups) == sentence


def test_a_floor_has_one_seed_by_its_nature() -> None:
    """Bold in a table of three seeds and one floor is by the spread; a table of floors has no methods to speak of."""
    several, floor = (
        Entrant("ours", (runs({"a": [1.0, 2.0, 3.0]}),)),
        Entrant("e", (runs({"a": [0.0]}, method="empty"),)),
    )
    assert named_table(FRAME, [several, floor]).remarks == ("Mean over 1 case: a.", "± is the spread over seeds.")
    assert named_table(FRAME, [floor]).remarks == ("Mean over 1 case: a.",)
    assert named_table(FRAME, [Entrant("nobody", ((),))]).remarks == ()


def test_both_sentences_stand_in_every_format_for_people() -> None:
    made = named_table(replace(FRAME, remarks=("More.",)), [Entrant("ours", (runs({"a": [1.0], "b": [2.0]}),))])
    assert made.remarks == ("Mean over 2 cases: a, b.", f"Every row has one seed, so that {UNKNOWN}", "More.")
    for name in ("md", "latex", "html"):
        text = FORMATS[name](made)
        assert "Mean over 2 cases: a, b." in text and "Every row has one seed" in text
    (page,) = standings(runs({"a": [1.0], "b": [2.0]}))
    assert page.remarks[:2] == made.remarks[:2]


def test_a_difference_says_what_its_interval_was_drawn_from() -> None:
    one, other = Entrant("ours", (runs({"a": [1.0], "b": [2.0]}),)), Entrant("gart", (runs({"a": [0.0], "b": [0.0]}),))
    made = difference_table(FRAME, [one, other], "ours")
    assert "of a bootstrap over cases alone, as every row has one seed." in made.caption
    assert made.remarks == ("Mean over 2 cases: a, b.",)
    several = Entrant("d3dgs", (runs({"a": [0.0, 1.0], "b": [0.0, 1.0]}),))
    assert "of a bootstrap over cases and seeds." in difference_table(FRAME, [one, several], "ours").caption
