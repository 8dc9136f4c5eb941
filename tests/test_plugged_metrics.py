"""Metrics of other packages: sums and counts, reasons instead of values, in records, tables, pages and data frames."""

import re
from collections.abc import Callable, Iterable
from dataclasses import replace
from pathlib import Path
from typing import Any

import msgspec
import pytest
import torch
from calling import output
from one_case import OneCase
from records_for_tests import psnr, record

from rewild4d.contracts import MetricInfo, NotComputed, Tally
from rewild4d.errors import UserError
from rewild4d.evaluation.plugged import Source, measure
from rewild4d.evaluation.protocol import find_protocol
from rewild4d.leaderboard.formats import markdown
from rewild4d.leaderboard.frame import records_frame
from rewild4d.leaderboard.records import FILE, RunRecord, read_record, write_record
from rewild4d.leaderboard.site import Part, build_site
from rewild4d.leaderboard.tables import protocol_tables
from rewild4d.metrics.score import Score
from rewild4d.priors.choose import PriorChoice
from rewild4d.priors.config import STANDARD
from rewild4d.priors.io import save_prior
from rewild4d.registry import load_method
from rewild4d.running import runner
from rewild4d.running.conformance import check_metric, tiny_case
from rewild4d.running.rescoring import score_again
from rewild4d.types import Case

INFO = MetricInfo("Ink", "Mean of the true matte over all pixels of all images", "px", "lower", "images")
Install = Callable[..., None]
PACKAGE = '''
import sys
from rewild4d.contracts import MetricInfo, NotComputed, Tally


class Ink:
    info = MetricInfo("Ink", "Mean of the true matte over all pixels of all images", "px", "lower", "images")

    def measure(self, items):
        return [Tally(float(item.truth_matte.sum()), item.truth_matte.numel()) for item in items]


class Moments:
    """Loops twice, as a metric of motion would."""

    info = MetricInfo("Moments", "Number of held-out images", "1", "", "images")

    def measure(self, items):
        assert len(list(items)) == len(list(items))
        return [len(list(items))]


class Vandal(Ink):
    """Spoils what it is given, then breaks."""

    def measure(self, items):
        for item in items:
            for tensor in (item.truth_matte, item.truth, item.prediction, item.prediction_matte):
                tensor.fill_(0.5)
        raise ZeroDivisionError("by /home/me/its/file")


class Quitter(Ink):
    def measure(self, items):
        sys.exit(3)


class Shape(Ink):
    info = MetricInfo("Shape", "Distance of centroids", "world", "lower", "points")

    def measure(self, items):
        return [float((cloud.prediction.mean(0) - cloud.truth.mean(0)).norm()) for cloud in items]


class Mute:
    info = "none"
'''
ALL = ("ink", "moments", "vandal", "quitter", "shape", "mute")
ENTRIES = [
    *(("metrics", name, f"their_package:{name.title()}") for name in ALL),
    ("metrics", "gone", "their_package:Gone"), ("metrics", "psnr", "their_package:Ink"),
]  # fmt: skip


class Toy:
    """Returns what it was made with."""

    info = INFO

    def __init__(self, *entries: Any) -> None:
        self.entries = entries

    def measure(self, items: Iterable[Any]) -> Iterable[Any]:
        return self.entries


def toy(*entries: Any, count: int = 3, absent: str = "") -> Score:
    return measure(Toy(*entries), INFO, Source(lambda: range(count), count, absent, "image"))


def test_sums_are_divided_by_counts_over_all_items() -> None:
    """The mean of the items' means would be (1 / 1 + 5 / 2) / 2."""
    found = toy(Tally(1.0, 1), None, Tally(5.0, 2))
    assert (found.value, found.count) == ((1 + 5) / (1 + 2), 1 + 2)
    assert found.per_item == [1 / 1, None, 5 / 2]
    assert found.note == "1 images left out: not defined there"
    assert (found.unit, found.better) == ("px", "lower")


def test_a_number_is_a_tally_of_one_and_a_single_entry_is_of_the_case() -> None:
    assert toy(1.0, torch.tensor(2.0), 6).value == (1 + 2 + 6) / 3
    whole = toy(Tally(7.0, 2))
    assert (whole.value, whole.count, whole.per_item) == (7 / 2, 2, [])


@pytest.mark.parametrize(
    ("entries", "sentence"),
    [
        ((1.0, 2.0), "expected an entry for each image (3) or one, got 2."),
        ((1.0, float("nan"), 2.0), "expected a finite number, a contracts.Tally or None, got nan."),
        ((1.0, "much", 2.0), "expected a finite number, a contracts.Tally or None, got much."),
        ((Tally(1.0, -1),), "got Tally(total=1.0, count=-1)."),
    ],
)
def test_what_is_no_entry_is_a_sentence(entries: tuple[Any, ...], sentence: str) -> None:
    with pytest.raises(UserError, match=re.escape(sentence)):
        toy(*entries)


def test_a_case_without_a_value_says_why() -> None:
    for found, why in (((None, Tally(0.0, 0), None), "no image in which it is defined"),):
        with pytest.raises(NotComputed, match=why):
            toy(*found)
    with pytest.raises(NotComputed, match="the data set has no geometry"):
        toy(1.0, absent="the data set has no geometry")


@pytest.fixture(scope="module")
def case() -> Case:
    return tiny_case(frames=2, views=3)


@pytest.fixture
def plan(case: Case, tmp_path: Path) -> runner.Plan:
    """The lower bound on the tiny case: nothing to fit, two images to score."""
    save_prior(case.prior, tmp_path / "prior.npz")
    protocol = msgspec.structs.replace(find_protocol("artemis", None), scores=("psnr", "iou"))
    return runner.Plan(
        dataset="artemis", reader=OneCase(case), root=tmp_path, cases=(case.clip.name,), protocol=protocol,
        entries=(runner.Entry("empty", "default", load_method("empty").Config(), (0,)),),
        prior=PriorChoice(str(tmp_path / "prior.npz"), STANDARD), device=torch.device("cpu"), out=tmp_path / "runs",
    )  # fmt: skip


def test_every_metric_is_beside_ours_and_none_costs_the_run(
    install: Install, plan: runner.Plan, case: Case, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    (before,) = runner.execute(plan)
    assert before.metrics == {} and set(before.scores) == {"psnr", "iou"}
    install(*ENTRIES, files={"their_package/__init__.py": PACKAGE})
    plan = replace(plan, out=tmp_path / "again")
    (found,) = runner.execute(plan)
    (folder,) = (path.parent for path in plan.out.rglob(FILE))
    mattes = [frame.mask for frame in case.truth.held_out]
    ink = found.scores["ink"]
    assert ink.value == pytest.approx(sum(float(m.sum()) for m in mattes) / sum(m.numel() for m in mattes))
    assert (ink.count, len(ink.per_item)) == (2 * 96 * 64, 2)
    assert (found.scores["moments"].value, found.scores["moments"].per_item) == (2.0, [])
    notes = {name: found.scores[name].note for name in ("vandal", "quitter", "shape", "mute", "gone")}
    assert notes == {
        "vandal": "not computed: ZeroDivisionError: by /home/me/its/file",
        "quitter": "not computed: SystemExit: 3",
        "shape": "not computed: the data set has no geometry",
        "mute": "not computed: metric 'mute': expected `info`, a contracts.MetricInfo, got str",
        "gone": "not computed: metric 'gone': expected an object at their_package:Gone, but module 'their_package' "
        "has no attribute 'Gone'",
    }
    assert {name: before.scores[name] for name in before.scores} == {n: found.scores[n] for n in ("psnr", "iou")}
    assert found.metrics["ink"]["package"] == "their_package" and found.metrics["ink"]["title"] == "Ink"
    assert len(found.metrics["ink"]["sources"]) == 16 and "psnr" not in found.metrics
    assert "ZeroDivisionError" in capsys.readouterr().err
    assert read_record(folder / FILE) == found

    (made,) = protocol_tables([found])
    titles = [column.title for column in made.columns]
    assert titles[:2] == ["PSNR, dB", "mask IoU"] and {"Ink, px", "Moments"} <= {*titles[2:]}
    assert "Ink: Mean of the true matte over all pixels of all images (metric of their_package unknown)." in (
        made.remarks
    )
    assert "ZeroDivisionError" in markdown(made)
    rows = records_frame(plan.out).set_index("metric")
    assert rows.loc["ink", ["unit", "better", "package"]].tolist() == ["px", "lower", "their_package unknown"]
    page = build_site([Part("runs", [(folder, found)])], tmp_path / "page").read_text()
    assert "Ink, px" in page
    run = next((tmp_path / "page" / "runs").glob("*/index.html")).read_text()
    assert "Metrics of other packages" in run and "ink.package" in run


def test_scoring_again_adds_what_was_installed_since(
    install: Install, plan: runner.Plan, case: Case, monkeypatch: pytest.MonkeyPatch
) -> None:
    (before,) = runner.execute(plan)
    install(*ENTRIES, files={"their_package/__init__.py": PACKAGE})
    monkeypatch.setattr("rewild4d.running.rescoring.reader_of", lambda *_: OneCase(case))
    (folder,) = (path.parent for path in plan.out.rglob(FILE))
    found = score_again(folder)
    assert found.scores["psnr"] == before.scores["psnr"] and found.scores["moments"].value == 2
    (same,) = runner.execute(plan)
    assert same == found


def test_list_tells_what_a_metric_is_and_whose(install: Install, capsys: pytest.CaptureFixture[str]) -> None:
    install(*ENTRIES, files={"their_package/__init__.py": PACKAGE})
    said = output(capsys, "list")
    assert (
        "  ink          Ink, px, lower is better: Mean of the true matte over all pixels of all images "
        "[their_package unknown]"
    ) in said
    assert "  psnr         cannot be used: metric 'psnr': expected a name that none of our scores has." in said
    assert "cannot be used: metric 'gone': expected an object at their_package:Gone" in said


def test_check_reports_what_a_metric_breaks(install: Install) -> None:
    install(*ENTRIES, files={"their_package/__init__.py": PACKAGE})
    for name in ("ink", "moments", "shape"):
        assert [finding.level for finding in check_metric(name)] == ["ok", "ok"], name
    (broken,) = check_metric("quitter")
    assert (broken.level, broken.message) == ("error", "SystemExit: 3")
    (mute,) = check_metric("mute")
    assert mute.message == "metric 'mute': expected `info`, a contracts.MetricInfo, got str."


def with_ink(version: str, value: float = 1.0, **changes: Any) -> RunRecord:
    about = {"title": "Ink", "definition": "A sum", "package": "theirs", "version": version, "sources": f"s{version}"}
    scores = psnr(20.0) | {"ink": Score(value, "px", "lower", 1, [value])}
    return record(scores=scores, metrics={"ink": about}, **changes)


def test_two_versions_of_a_metric_are_not_averaged() -> None:
    (made,) = protocol_tables([with_ink("1", case="a"), with_ink("2", case="b")])
    mean = made.rows[-1]
    assert (mean.cells[0].text, mean.cells[1].text) == ("20.00", "n/a")
    assert (
        mean.cells[1].note
        == "not averaged: a by theirs 1 s1 and b by theirs 2 s2; `rewild4d-bench evaluate` scores again"
    )
    (made,) = protocol_tables([with_ink("1", 1.0, case="a"), with_ink("1", 2.0, case="b")])
    assert made.rows[-1].cells[1].value == (1 + 2) / 2


def test_a_run_from_before_a_metric_was_installed_says_so() -> None:
    (made,) = protocol_tables([with_ink("1"), record(method="gart")])
    assert made.rows[1].cells[1].note == (
        "not computed: it was scored without this metric's package; `rewild4d-bench evaluate` scores it again"
    )


def test_a_record_from_before_there_were_such_metrics_is_read(tmp_path: Path) -> None:
    path = write_record(record(), tmp_path)
    text = path.read_text()
    path.write_text(re.sub(r'\n "metrics": \{\},', "", text))
    assert '"metrics"' in text and '"metrics"' not in path.read_text() and read_record(path) == record()
