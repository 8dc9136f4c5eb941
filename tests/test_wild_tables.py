"""The tables of videos in the wild: which cases and protocols they plan, what they say where data has none."""

from pathlib import Path

import cv2
import msgspec
import numpy as np
import pytest
from records_for_tests import record

from rewild4d import cli, planning
from rewild4d.commands import run_table
from rewild4d.commands.choice import cases_of, chosen
from rewild4d.datasets.davis import known_sequences
from rewild4d.leaderboard.records import Score, write_record
from rewild4d.leaderboard.specs import load_specs
from rewild4d.planning import Choice
from rewild4d.protocol import load_protocols

DAVIS = Path("/work/shared/data/davis")
NAMES = ("input-view", "novel-view")


@pytest.fixture(autouse=True)
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("REWILD4D_CACHE", str(tmp_path / "cache"))


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


def call(*words: str) -> int:
    with pytest.raises(SystemExit) as stop:
        cli.main(list(words))
    return int(stop.value.code or 0)


@pytest.mark.parametrize("name", NAMES)
def test_both_tables_take_the_eight_animals_of_davis(name: str) -> None:
    (condition,) = load_specs()[name].conditions
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
    assert err.strip() == "table 'input-view': the data has no bear, dog, dog-agility, elephant, goat, rhino"
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


@pytest.mark.skipif(not DAVIS.is_dir(), reason=f"no DAVIS sequences in {DAVIS}")
@pytest.mark.parametrize("name", NAMES)
def test_the_real_sequences_can_be_planned(name: str, tmp_path: Path) -> None:
    options = run_table.Options(table=name, data=DAVIS, out=tmp_path / "runs", protocol="davis-256", seeds=(0,))
    spec = chosen(name, load_specs()[name], Choice(protocol="davis-256"))
    (plan,) = run_table.make_plans(options, spec)
    assert plan.cases == ("camel", "cows")


def test_distances_that_were_not_computed_say_why(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """One run fills both tables; what the networks' weights are missing for is n/a, with the reason below."""
    spec = chosen("novel-view", load_specs()["novel-view"], Choice())
    entry = planning.row_entry("novel-view", spec.rows[-1], spec, (0,))
    scores = {
        "psnr": Score(21.0, "dB", "higher", 1, [21.0]),
        "kid_v": Score(0.125, "1", "lower", 128, [], "n = 128, m = 40"),
        "fvd_f": Score(None, "1", "lower", 0, [], "not computed: weights missing"),
    }
    protocol = {**msgspec.to_builtins(load_protocols()["davis-512-v2"]), "digest": "d"}
    made = record(
        dataset="davis", case="camel", config=msgspec.to_builtins(entry.config), preset="standard", scores=scores,
        protocol=protocol, prior={"choice": "template"},
    )  # fmt: skip
    write_record(made, tmp_path / "runs" / "one")
    shown = {}
    for name in NAMES:
        assert call("table", name, "--runs", str(tmp_path / "runs")) == 0
        shown[name] = next(line for line in capsys.readouterr().out.splitlines() if line.startswith("| Ours"))
    assert shown["input-view"].startswith("| Ours | 21.00 |")
    assert shown["novel-view"] == "| Ours | 0.1250 | n/a [2] | n/a [3] |"
