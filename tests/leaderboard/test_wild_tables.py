"""The tables of videos in the wild: which cases and protocols they plan, what they say where data has none."""

import csv
import io
import shutil
from pathlib import Path
from typing import Any

import cv2
import msgspec
import numpy as np
import pytest
from calling import call
from records_for_tests import record

from rewild4d.commands import run_table
from rewild4d.commands.choice import cases_of, chosen
from rewild4d.datasets.video.davis import known_sequences
from rewild4d.evaluation.protocol import load_protocols
from rewild4d.leaderboard.records import RunRecord, find_records, write_record
from rewild4d.leaderboard.specs import load_specs
from rewild4d.leaderboard.tables import markdown
from rewild4d.metrics.score import Score
from rewild4d.priors.config import FOOTAGE, QUICK, STANDARD, PriorConfig
from rewild4d.running import planning
from rewild4d.running.planning import Choice

pytestmark = pytest.mark.usefixtures("cache")

NAMES = ("input-view", "novel-view")
COMMITTED = Path(__file__).resolve().parents[2] / "results" / "2026-11-23-davis-standard"


def davis(root: Path, *sequences: str) -> Path:
    """A DAVIS folder of eight small frames a sequence: a dark block walks to the right."""
    for sequence in sequences:
        for index in range(8):
            image, mask = np.full((48, 80, 3), 200, np.uint8), np.zeros((48, 80), np.uint8)
            for picture, value in ((image, 60), (mask, 255)):
                picture[14:34, 10 + 3 * index : 40 + 3 * index] = value
            for kind, suffix, picture in (("JPEGImages", "jpg", image), ("Annotations", "png", mask)):
                path = root / kind / "480p" / sequence / f"{index:05d}.{suffix}"
                path.parent.mkdir(parents=True, exist_ok=True)
                cv2.imwrite(str(path), picture)
    return root


def run_of(protocol: str, case: str, prior: PriorConfig, preset: str = "standard", **changes: Any) -> RunRecord:
    """A run of `ours` as the runner records it: all settings, those of the prior's fit among them."""
    spec = chosen("novel-view", load_specs()["novel-view"], Choice(preset))
    config = msgspec.to_builtins(planning.row_entry("novel-view", spec.rows[-1], spec, (0,)).config)
    found = load_protocols()[protocol]
    return record(
        dataset=found.dataset, case=case, config=config, preset=preset,
        protocol={**msgspec.to_builtins(found), "digest": "d"},
        prior={"choice": "template", "config": msgspec.to_builtins(prior)}, **changes,
    )  # fmt: skip


@pytest.mark.parametrize("name", NAMES)
def test_both_tables_take_the_eight_animals_of_davis(name: str) -> None:
    condition = load_specs()[name].conditions[0]
    eight = tuple(sequence for sequence, facts in known_sequences().items() if facts.get("eight"))
    assert condition.cases == eight and len(eight) == 8


@pytest.mark.parametrize(
    ("name", "scores"), [("input-view", ("psnr", "ssim", "lpips_alex")), ("novel-view", ("kid_v", "fvd_f", "fvd_diag"))]
)
def test_both_tables_read_the_same_runs(name: str, scores: tuple[str, ...]) -> None:
    spec = chosen(name, load_specs()[name], Choice())
    assert (spec.dataset, spec.conditions[0].protocol, spec.scores) == ("davis", "davis-512-v2", scores)
    protocol = load_protocols()["davis-512-v2"]
    assert set(scores) <= set(protocol.scores) and protocol.default
    assert (protocol.selection.split, protocol.selection.framing, protocol.selection.size) == (5, "crop", 512)


def test_only_the_cases_that_the_data_has_are_planned(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    root = davis(tmp_path / "DAVIS", "camel", "cows", "boat")
    words = ("--table", "input-view", "--data", str(root), "--out", str(tmp_path / "runs"), "--seeds", "0", "--plan")
    assert call("run", *words) == 0
    out, err = capsys.readouterr()
    missing, *elsewhere = err.splitlines()
    assert missing == "table 'input-view': the data has no bear, dog, dog-agility, elephant, goat, rhino"
    assert elsewhere == [
        f"not run here: {title}, on data of its own: `rewild4d-bench run --table input-view --protocol {name}-512-v2`"
        for title, name in (("Online", "online"), ("APTv2", "aptv2"))
    ]
    lines = out.splitlines()
    assert {Path(line.split()[-1]).parent.relative_to(tmp_path / "runs").as_posix() for line in lines} == {
        "davis-512-v2/camel", "davis-512-v2/cows",
    }  # fmt: skip
    labels = ["empty", "prior-only", *(row.label for row in load_specs()["input-view"].rows)]
    assert [line[8:28].strip() for line in lines] == labels * 2
    assert call("run", *words, "--case", "cows") == 0
    assert {Path(line.split()[-1]).parent.name for line in capsys.readouterr().out.splitlines()} == {"cows"}


def test_data_without_any_of_the_cases_is_one_sentence(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    root = davis(tmp_path / "DAVIS", "boat", "bus")
    assert call("run", "--table", "novel-view", "--data", str(root), "--out", str(tmp_path / "runs"), "--plan") == 2
    out, err = capsys.readouterr()
    sentence = (
        "table 'novel-view': expected data with cases among bear, camel, cows, dog, dog-agility, elephant, goat, "
        "rhino, got boat, bus."
    )
    assert (out, sentence in err, len(err.strip().splitlines())) == ("", True, 1)


def test_the_cases_of_a_table() -> None:
    known = ("horse/Run", "wolf/Run", "wolf/Walk")
    assert cases_of("t", known, ()) == (known, "")
    assert cases_of("t", known, ("wolf/*",)) == (known[1:], "")
    assert cases_of("t", known, ("wolf/Walk", "*/Run", "cow/*")) == (known, "table 't': the data has no cow/*")


@pytest.mark.parametrize(
    ("protocol", "dataset"), [("aptv2-512", "aptv2"), ("online-256", "online"), ("artemis-orbit-256", "artemis")]
)
def test_a_protocol_of_another_data_set_brings_that_data_set(protocol: str, dataset: str) -> None:
    spec = chosen("novel-view", load_specs()["novel-view"], Choice(protocol=protocol))
    (condition,) = spec.conditions
    assert (spec.dataset, condition.protocol, condition.cases) == (dataset, f"{protocol}-v2", ())
    assert set(spec.scores) <= set(load_protocols()[condition.protocol].scores)
    other = chosen("novel-view", load_specs()["novel-view"], Choice(protocol="davis-256"))
    assert other.conditions[0].cases[0] == "bear"


def test_a_video_of_ones_own_can_fill_the_table(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    root = davis(tmp_path / "DAVIS", "camel")
    frames, masks = (root / kind / "480p" / "camel" for kind in ("JPEGImages", "Annotations"))
    words = ("--table", "input-view", "--protocol", "online-512", "--video", str(frames), "--masks", str(masks))
    assert call("run", *words, "--fps", "10", "--out", str(tmp_path / "runs"), "--seeds", "0", "--plan") == 0
    assert "online-512-v2" in capsys.readouterr().out
    assert call("run", *words[:4], "--data", str(root), "--out", str(tmp_path / "runs"), "--plan") == 2
    assert call("run", "--table", "artemis", "--masks", str(masks), "--out", str(tmp_path / "runs"), "--plan") == 2
    assert "--masks: the data set 'artemis' does not take it" in capsys.readouterr().err


@pytest.mark.parametrize("name", NAMES)
def test_the_real_sequences_can_be_planned(name: str, tmp_path: Path, davis: Path) -> None:
    options = run_table.Options(table=name, data=davis, out=tmp_path / "runs", protocol="davis-256", seeds=(0,))
    spec = chosen(name, load_specs()[name], Choice(protocol="davis-256"))
    (plan,) = run_table.make_plans(options, spec)
    assert plan.cases == ("camel", "cows")


def test_distances_that_were_not_computed_say_why(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """One run fills both tables; what the networks' weights are missing for is n/a, with the reason below."""
    scores = {
        "psnr": Score(21.0, "dB", "higher", 1, [21.0]),
        "kid_v": Score(0.125, "1", "lower", 128, [], "n = 128, m = 40"),
        "fvd_f": Score(None, "1", "lower", 0, [], "not computed: weights missing"),
    }
    write_record(run_of("davis-512-v2", "camel", FOOTAGE, scores=scores), tmp_path / "runs" / "one")
    shown = {}
    for name in NAMES:
        assert call("table", name, "--runs", str(tmp_path / "runs")) == 0
        shown[name] = next(line for line in capsys.readouterr().out.splitlines() if line.startswith("| Ours"))
    assert shown["input-view"].startswith("| Ours | 21.00 |")
    assert shown["novel-view"].startswith("| Ours | 0.1250 | n/a [2] | n/a [3] |")


@pytest.mark.parametrize(
    ("table", "protocol", "case", "preset", "fitting"),
    [
        ("input-view", "davis-512-v2", "camel", "standard", FOOTAGE),
        ("input-view", "davis-512-v2", "camel", "quick", FOOTAGE),
        ("artemis", "artemis-sweep-256-v4", "wolf/Run", "standard", STANDARD),
        ("artemis", "artemis-sweep-256-v4", "wolf/Run", "quick", QUICK),
    ],
)
def test_a_row_takes_only_runs_whose_prior_was_fitted_as_the_tables_is(
    table: str, protocol: str, case: str, preset: str, fitting: PriorConfig
) -> None:
    """Footage without cameras has one fit for all presets, and under known cameras that fit is another prior."""
    spec = chosen(table, load_specs()[table], Choice(preset))
    other = msgspec.structs.replace(fitting, yaw_starts=fitting.yaw_starts + 1)
    for tried in (FOOTAGE, STANDARD, QUICK, other):
        rows, _ = planning.entrants(table, spec, [run_of(protocol, case, tried, preset)])
        ours = next(row for row in rows if row.label == "Ours")
        assert bool(ours.records[0]) == (tried is fitting)


def test_the_committed_records_fill_both_tables(capsys: pytest.CaptureFixture[str]) -> None:
    """Every row has a figure: the mean of what the two records say of camel and of cows."""
    scores = {(made.method, made.case): made.scores for _, made in find_records(COMMITTED)}
    for name in NAMES:
        spec = load_specs()[name]
        assert call("table", name, "--runs", str(COMMITTED), "--format", "csv") == 0
        lines = list(csv.DictReader(io.StringIO(capsys.readouterr().out)))
        found = {(line["method"], line["score"]): line["value"] for line in lines if line["condition"] == "DAVIS"}
        for row in spec.rows:
            for score in spec.scores:
                camel, cows = (scores[row.method, case][score].value or 0.0 for case in ("camel", "cows"))
                assert float(found[row.label, score]) == pytest.approx((camel + cows) / 2)
        if name == "input-view":
            assert f"{float(found['Ours', 'psnr']):.2f}" == "25.63", "26.41 and 24.85, as the notes on them say"


def test_pooling_without_features_says_so(capsys: pytest.CaptureFixture[str]) -> None:
    assert call("table", "novel-view", "--pooled", "--runs", str(COMMITTED)) == 0
    out = capsys.readouterr().out
    assert "Pooled over 2 cases: camel, cows." in out and "expected the features of a run, but there is no such" in out


def test_cases_that_are_missing_are_told(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    rest = "Missing: there is no record here of bear, dog, dog-agility, elephant, goat, rhino, which the table's file"
    for case in ("camel", "cows"):
        write_record(run_of("davis-512-v2", case, FOOTAGE, run_id=case), tmp_path / case)
    assert call("table", "input-view", "--runs", str(tmp_path)) == 0
    out = capsys.readouterr().out
    assert "Mean over 2 cases: camel, cows." in out and rest in out
    assert call("table", "input-view", "--runs", str(tmp_path), "--case", "cows") == 0
    out = capsys.readouterr().out
    assert "Mean over 1 case: cows." in out and "of bear, camel, dog," in out
    assert call("table", "artemis", "--runs", str(tmp_path)) == 0
    assert "Missing" not in capsys.readouterr().out, "that table is for whatever the data has"


def test_the_page_has_both_tables(tmp_path: Path) -> None:
    page = tmp_path / "page"
    assert call("leaderboard", "build", "--runs", str(COMMITTED), "--out", str(page)) == 0
    text = (page / "index.html").read_text()
    for name in NAMES:
        assert f'<table id="{name}">' in text and f'<table id="{name}-difference">' in text


def test_a_table_whose_rows_are_all_one_run_is_not_on_the_page(tmp_path: Path) -> None:
    """`Ours` and `w/o Symm. Enc.` have the same settings in preset `standard`."""
    page, runs = tmp_path / "page", tmp_path / "runs"
    artemis = COMMITTED.with_name("2026-11-23-artemis-standard")
    for folder in artemis.glob("*/*/*-seed0-*"):
        shutil.copytree(folder, runs / folder.relative_to(artemis))
    assert call("leaderboard", "build", "--runs", str(runs), "--out", str(page)) == 0
    text = (page / "index.html").read_text()
    assert '<table id="artemis">' in text and '<table id="ablation">' not in text


def test_distances_that_a_short_clip_cannot_have_are_no_columns() -> None:
    why = "not computed: 16 images expected, got 4"

    def made(method: str, kid: float | None) -> RunRecord:
        scores = {"psnr": Score(20.0, "dB", "higher", 1), "kid_v": Score(kid, "1", "lower", 4, note="" if kid else why)}
        return record(method=method, scores=scores, protocol={"name": "p", "title": "P", "scores": ["psnr", "kid_v"]})

    shown = markdown([made("ours", None), made("gart", None)])
    assert "| case | method | PSNR, dB ↑ | seeds |" in shown and f"KID-16V: {why}" in shown
    shown = markdown([made("ours", 0.25), made("gart", None)])
    assert "| PSNR, dB ↑ | KID-16V ↓ |" in shown and "0.2500" in shown and "n/a" in shown
