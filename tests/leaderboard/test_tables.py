"""Tables: means, spreads and ranks by hand, notes, refusals, and what the four writers make of them."""

import csv
import io
import math
import re
from dataclasses import replace
from html.parser import HTMLParser

import msgspec
import numpy as np
import pytest
from records_for_tests import PROTOCOL, lower, psnr, record, runs, texts

from rewild4d.errors import UserError
from rewild4d.leaderboard.formats import FORMATS, html, latex, markdown, tidy_csv
from rewild4d.leaderboard.layout import Table
from rewild4d.leaderboard.records import RunRecord
from rewild4d.leaderboard.specs import Reported, ReportedRow
from rewild4d.leaderboard.statistics import Estimate, estimate, paired, ranks
from rewild4d.leaderboard.tables import Entrant, Frame, difference_table, named_table, protocol_tables

FRAME = Frame("t", "Title", "How to read it", ("",), ("psnr",))


def table(**rows: tuple[RunRecord, ...]) -> Table:
    return named_table(FRAME, [Entrant(label, (found,)) for label, found in rows.items()])


def test_mean_and_spread_by_hand() -> None:
    found = estimate({"a": {0: 10.0, 1: 12.0}, "b": {0: 20.0, 1: 26.0}})
    assert found.mean == ((10 + 12) / 2 + (20 + 26) / 2) / 2
    assert found.spread == pytest.approx(np.std([(10 + 20) / 2, (12 + 26) / 2], ddof=1))
    assert estimate({"a": {0: 10.0, 1: 20.0}, "b": {0: 30.0}}) == Estimate((15 + 30) / 2, None, 1)


def test_ranks_mind_the_spread() -> None:
    def marks(*pairs: tuple[float, float | None] | None, better: str = "higher") -> list[str]:
        return ranks([Estimate(*pair, 3) if pair else None for pair in pairs], better, 2)

    assert marks((20, 0.1), (21, 0.1), (19, 0.1)) == ["second", "best", ""]
    assert marks((20, 0.1), (21, 0.1), (19, 0.1), better="lower") == ["second", "", "best"]
    # A lead of 0.05 within a spread of 0.1: nobody is best.
    assert marks((20.00, 0.1), (20.05, 0.02), (19, 0.1)) == ["second", "second", ""]
    # The second and the third are not told apart either.
    assert marks((25, 0.1), (20.0, 0.3), (19.8, 0.1), (18, 0.1)) == ["best", "second", "second", ""]
    # What prints alike is alike, also without a spread.
    assert marks((20.001, None), (20.002, None)) == ["second", "second"]
    assert marks((20.0, None), None, (19.0, None)) == ["best", "", "second"]
    assert marks((20.0, None)) == [""], "one competitor beats nobody"
    assert marks(None, None) == ["", ""]


def test_a_paired_difference_beats_the_spread_of_cases() -> None:
    """Cases differ by 10 dB, methods by 1 dB on every one of them: the interval holds 1 and not 0."""
    one = {case: {0: base + 1.0} for case, base in (("a", 10.0), ("b", 20.0), ("c", 30.0))}
    other = {case: {0: base} for case, base in (("a", 10.0), ("b", 20.0), ("c", 30.0))}
    assert paired(one, other).mean == 1.0
    assert paired(one, other).interval == (1.0, 1.0)
    back = paired(other, one)
    assert (back.mean, back.interval, back.cases) == (-1.0, (-1.0, -1.0), 3)


def test_the_bootstrap_is_that_of_the_mean() -> None:
    """For many cases the interval is the normal one: 1.96 standard errors either way."""
    noise = np.random.default_rng(1).normal(2.0, 1.0, 400)
    one = {str(i): {0: float(value)} for i, value in enumerate(noise)}
    other = {str(i): {0: 0.0} for i in range(400)}
    low, high = paired(one, other).interval or (math.nan, math.nan)
    error = noise.std(ddof=1) / math.sqrt(400)
    assert low == pytest.approx(noise.mean() - 1.96 * error, abs=0.15 * error)
    assert high == pytest.approx(noise.mean() + 1.96 * error, abs=0.15 * error)


def test_seeds_are_drawn_anew_for_every_drawn_case() -> None:
    """Cases that are alike, seeds at -1 and 1: a drawn case is a mean of two draws, of variance 1 / 2, whichever case
    it is, so that the mean over 100 of them has the variance 1 / 200."""
    one = {str(case): {0: -1.0, 1: 1.0} for case in range(100)}
    other = {str(case): {0: 0.0} for case in range(100)}
    low, high = paired(one, other).interval or (math.nan, math.nan)
    assert (low, high) == pytest.approx((-1.96 * math.sqrt(1 / 200), 1.96 * math.sqrt(1 / 200)), rel=0.06)


def test_a_single_case_has_an_interval_from_its_seeds_only() -> None:
    assert paired({"a": {0: 3.0}}, {"a": {0: 1.0}}).interval is None
    low, high = paired({"a": {0: 3.0, 1: 5.0}}, {"a": {0: 1.0}}).interval or (math.nan, math.nan)
    assert (low, high) == (3.0 - 1.0, 5.0 - 1.0)
    with pytest.raises(ValueError, match="expected at least one case in common, got none"):
        paired({"a": {0: 1.0}}, {"b": {0: 1.0}})


def test_best_bold_and_second_underlined() -> None:
    made = table(ours=runs({"a": [20.0, 20.2]}), gart=runs({"a": [15.0, 15.2]}), d3dgs=runs({"a": [18.0, 18.2]}))
    spread = f"{np.std([0, 0.2], ddof=1):.2f}"
    assert texts(made) == {
        "ours": ("20.10", spread, "best"), "gart": ("15.10", spread, ""), "d3dgs": ("18.10", spread, "second"),
    }  # fmt: skip
    assert r"ours & \textbf{20.10} {\scriptsize $\pm$ 0.14} \\" in latex(made)
    assert r"d3dgs & \underline{18.10}" in latex(made)
    assert '<td data-value="20.1"><b>20.10</b> <small>± 0.14</small></td>' in html(made)
    assert "| ours | **20.10** ± 0.14 |" in markdown(made)


def test_less_is_better_where_the_record_says_so() -> None:
    made = table(ours=(record(scores=lower(0.3)),), gart=(record(scores=lower(0.2)),))
    assert texts(made)["gart"][2] == "best"
    assert made.columns[0].better == "lower"
    assert "PSNR ↓" in markdown(made)


def test_a_row_on_fewer_cases_says_so_and_is_not_ranked() -> None:
    made = table(
        ours=runs({"a": [10.0], "b": [30.0]}), gart=runs({"a": [40.0]}), d3dgs=runs({"a": [10.0], "b": [20.0]})
    )
    assert texts(made) == {"ours": ("20.00", "", "best"), "gart": ("40.00", "", ""), "d3dgs": ("15.00", "", "second")}
    assert made.notes == ("1 of 2 cases: a",)
    assert "| gart | 40.00 [1] |" in markdown(made) and "[1] 1 of 2 cases: a" in markdown(made)
    assert r"gart & 40.00\textsuperscript{1}" in latex(made)
    many = {str(case): [1.0] for case in range(20)}
    made = table(ours=runs({**many, "one more": [1.0]}), gart=runs(many))
    assert made.notes == ("20 of 21 cases",), "more cases than can be read are counted"


def test_what_has_no_number_says_why() -> None:
    failed = record(status="failed", error="it diverged", scores={})
    later = record(scores=psnr(None, "not computed: weights missing, run: rewild4d-bench weights fetch"))
    other = record(scores={}, protocol=PROTOCOL)
    made = named_table(FRAME, [
        Entrant("failed", ((failed,),)), Entrant("without", ((later,),)), Entrant("unmeasured", ((other,),)),
        Entrant("nobody", ((),)), Entrant("unknown", ((),), absent="unknown method 'x'."),
        Entrant("fine", ((record(),),)),
    ])  # fmt: skip
    assert [row.cells[0].text for row in made.rows] == ["failed", "n/a", "n/a", "n/a", "n/a", "20.00"]
    assert made.notes == (
        "wolf/Run, ours: failed: it diverged",
        "not computed: weights missing, run: rewild4d-bench weights fetch",
        "not computed: p-v1 does not measure it",
        "no record yet",
        "unknown method 'x'.",
    )


def test_a_condition_without_any_record_has_no_columns_and_is_named() -> None:
    frame = replace(FRAME, conditions=("fixed", "sweep", "random"))
    one, other = runs({"a": [20.0]}), runs({"a": [22.0]})
    entrants = [Entrant("ours", ((), one, ())), Entrant("gart", ((), other, ()))]
    for made in (named_table(frame, entrants), difference_table(frame, entrants, "ours")):
        assert [column.group for column in made.columns] == ["sweep"] * len(FRAME.scores)
        assert "Without any record, and so without columns: fixed; random." in made.remarks
    nothing = named_table(frame, [Entrant("ours", ((), (), ()))])
    assert len(nothing.columns) == 3 * len(FRAME.scores), "before anything was run it shows what there will be"


def test_a_failed_seed_is_told_and_does_not_count() -> None:
    some = (*runs({"a": [20.0, 22.0]}), record(case="a", seed=2, status="failed", error="it diverged", scores={}))
    made = table(ours=some)
    assert made.rows[0].cells[0].text == "21.00"
    assert made.notes == ("1 of 3 runs failed: it diverged",)


def test_rows_with_an_advantage_are_marked_and_not_ranked() -> None:
    mark = "upper bound: rotated to the best input-view PSNR"
    made = table(ours=runs({"a": [20.0]}), rotated=runs({"a": [30.0]}, marks=[mark]), gart=runs({"a": [10.0]}))
    assert {label: found[2] for label, found in texts(made).items()} == {
        "ours": "best",
        "gart": "second",
        "rotated": "",
    }
    assert made.notes == (mark,)
    assert "| rotated [1] | 30.00 |" in markdown(made)


def test_reported_rows_are_marked_and_never_ranked() -> None:
    reported = Reported(source="Paper, its table", note="Loose.", rows=(
        ReportedRow(label="Ours", cells={"psnr": 99.0}), ReportedRow(label="GART", cells={"psnr": None}),
        ReportedRow(label="None", cells={}),
    ))  # fmt: skip
    made = named_table(FRAME, [Entrant("ours", (runs({"a": [20.0]}),)), Entrant("g", (runs({"a": [10.0]}),))], reported)
    assert texts(made) == {
        "ours": ("20.00", "", "best"), "g": ("10.00", "", "second"), "Ours (reported)": ("99.000", "", ""),
        "GART (reported)": ("—", "", ""), "None (reported)": ("", "", ""),
    }  # fmt: skip
    assert made.remarks[-1] == "Reported: Paper, its table. Loose."
    assert latex(made).count(r"\midrule") == 2, "a rule before the methods, one before what was reported"


def test_lower_bounds_are_never_ranked_and_stand_apart() -> None:
    """Nor are those that are better than every method."""
    floor = tuple(msgspec.structs.replace(run, method="prior-only") for run in runs({"a": [30.0]}))
    floor = tuple(msgspec.structs.replace(run, protocol=run.protocol | {"floors": ["prior-only"]}) for run in floor)
    marked = tuple(msgspec.structs.replace(run, marks=["saw more"]) for run in runs({"a": [25.0]}))
    rows = [
        Entrant("prior-only", (floor,)), Entrant("seen", (marked,)), Entrant("ours", (runs({"a": [20.0]}),)),
        Entrant("gart", (runs({"a": [10.0]}),)),
    ]  # fmt: skip
    reported = Reported(source="Paper", note="", rows=(ReportedRow(label="Ours", cells={"psnr": 50.0}),))
    made = named_table(FRAME, rows, reported)
    order = [("ours", "best"), ("gart", "second"), ("seen", ""), ("prior-only", ""), ("Ours (reported)", "")]
    assert [(row.stubs[0], row.cells[0].mark) for row in made.rows] == order
    assert latex(made).count(r"\midrule") == 4, "before each of the four kinds"
    assert "**30.00**" not in markdown(made) and "<b>30.00</b>" not in html(made)
    found = difference_table(FRAME, rows, "ours")
    assert {row.stubs[0]: row.cells[0].mark for row in found.rows} == {"gart": "", "seen": "", "prior-only": ""}


def test_case_by_case_rules_stand_between_cases_and_rows_have_one_order() -> None:
    both = {"a": [20.0], "b": [21.0]}
    floor = [
        msgspec.structs.replace(run, method="prior-only", protocol=run.protocol | {"floors": ["prior-only"]})
        for run in runs(both)
    ]
    (made,) = protocol_tables([*floor, *runs(both)])
    assert [row.stubs for row in made.rows] == [
        (case, method) for case in ("a", "b", "mean") for method in ("ours", "prior-only")
    ]
    assert latex(made).count(r"\midrule") == 3
    assert made.caption.startswith("Protocol `") and made.caption.endswith(".")


def test_differences_to_a_row() -> None:
    rows = [Entrant("Ours", (runs({"a": [20.0], "b": [30.0]}),)), Entrant("gart", (runs({"a": [18.0], "b": [29.0]}),))]
    made = difference_table(FRAME, rows, "ours")
    assert [row.stubs for row in made.rows] == [("gart",)]
    assert made.rows[0].cells[0].text == "−1.50 [−2.00, −1.00]"
    partly = difference_table(FRAME, [rows[0], Entrant("gart", (runs({"a": [18.0]}),))], "ours").rows[0].cells[0]
    assert (partly.text, partly.note) == ("−2.00", "over 1 cases; only one side has b")
    with pytest.raises(UserError, match="unknown row 'our'. Did you mean 'Ours'"):
        difference_table(FRAME, rows, "our")


def test_conditions_are_column_groups_with_their_own_cases() -> None:
    frame = replace(FRAME, conditions=("fixed", "sweep"))
    made = named_table(frame, [Entrant("ours", (runs({"a@side": [10.0]}), runs({"a": [20.0]})))])
    assert [cell.text for cell in made.rows[0].cells] == ["10.00", "20.00"]
    assert r"\multicolumn{1}{c}{fixed} & \multicolumn{1}{c}{sweep} \\" in latex(made)
    assert r"\cmidrule(lr){2-2} \cmidrule(lr){3-3}" in latex(made)
    assert "| method | fixed PSNR, dB ↑ | sweep PSNR, dB ↑ |" in markdown(made)


def test_csv_has_a_line_a_figure() -> None:
    made = table(**{"a, b": runs({"a": [20.0, 21.0]})})
    (line,) = csv.DictReader(io.StringIO(tidy_csv(made)))
    assert (line["method"], line["score"], line["better"], line["condition"]) == ("a, b", "psnr", "higher", "")
    assert float(line["value"]) == 20.5
    assert float(line["spread"]) == pytest.approx(math.sqrt(0.5))
    difference = difference_table(FRAME, [Entrant("x", (runs({"a": [1.0], "b": [3.0]}),)),
                                          Entrant("y", (runs({"a": [1.0], "b": [2.0]}),))], "y")  # fmt: skip
    (line,) = csv.DictReader(io.StringIO(tidy_csv(difference)))
    assert (float(line["value"]), float(line["low"]), float(line["high"])) == (0.5, 0.0, 1.0)


class Cells(HTMLParser):
    """Counts what it meets, and fails on tags that are not closed in order."""

    def __init__(self) -> None:
        super().__init__()
        self.open: list[str] = []
        self.widths: list[int] = []

    def handle_starttag(self, tag: str, attrs: object) -> None:
        self.open.append(tag)
        if tag == "tr":
            self.widths.append(0)
        self.widths[-1:] = [self.widths[-1] + (tag in ("td", "th"))] if self.widths else []

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag


def test_every_format_survives_odd_names() -> None:
    """Names of people's methods and folders: signs that mean something to Markdown, LaTeX or HTML."""
    odd = r"a|b_c & 100 % <x> #1 {\y} $z$ ~^"
    made = table(**{odd: runs({"a": [20.0]}), "plain": runs({"a": [10.0]})})
    assert r"| a\|b_c & 100 %" in markdown(made)
    assert "the ``single'' one" in latex(named_table(replace(FRAME, caption='the "single" one'), []))
    escaped = r"a|b\_c \& 100 \% $<$x$>$ \#1 \{\textbackslash{}y\} \$z\$ \textasciitilde{}\textasciicircum{}"
    assert escaped in latex(made)
    reader = Cells()
    reader.feed(html(made))
    assert not reader.open and set(reader.widths) == {2}
    assert set(FORMATS) == {"md", "latex", "html", "csv"}


def test_latex_has_only_booktabs_and_equal_columns() -> None:
    made = latex(table(ours=runs({"a": [20.0]}), gart=runs({"b": [20.0]})))
    body = [line for line in made.splitlines() if line.endswith(r"\\")]
    assert {line.count("&") for line in body} == {1}
    assert made.index(r"\toprule") < made.index(r"\midrule") < made.index(r"\bottomrule")
    assert made.startswith(r"\begin{table}") and made.endswith(r"\end{table}")


def test_a_line_stands_before_every_condition() -> None:
    frame = replace(FRAME, conditions=("fixed", "sweep"), scores=("psnr", "iou"))
    made = html(named_table(frame, [Entrant("ours", (runs({"a": [10.0]}), runs({"a": [20.0]})))]))
    (over, heads, cells) = re.findall("<tr.*?</tr>", made)
    assert re.findall(r'class="edge" colspan="2">(\w+)<', over) == ["fixed", "sweep"]
    assert re.findall("<(?:td|th)([^>]*)>", cells) == [
        "", ' class="edge" data-value="10"', "", ' class="edge" data-value="20"', "",
    ]  # fmt: skip
    assert heads.count('class="edge"') == 2
    assert "edge" not in html(table(ours=runs({"a": [10.0]})))
