"""A run says before its fit whether its masks can be trusted, and its record and its first lines say it again."""

from pathlib import Path

import moving
import msgspec
import numpy as np
import pytest
from films import TINY, plan
from records_for_tests import record

from rewild4d.commands.verdicts import MOST, print_table_verdicts, print_verdicts
from rewild4d.contracts import Verdict
from rewild4d.datasets.video.online import Online
from rewild4d.leaderboard.records import to_json
from rewild4d.priors import choose
from rewild4d.running import runner


def test_a_run_with_masks_that_are_too_large_says_so_first(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(choose, "FOOTAGE", TINY)
    moving.frames(tmp_path / "clip")
    for number in range(12):
        mask = moving.mask(number)
        grown = np.maximum.reduce([np.roll(mask, (y, x), (0, 1)) for y in range(-5, 6) for x in range(-5, 6)])
        moving.save(tmp_path / "masks" / f"{number:05d}.png", grown)
    made = plan(Online(tmp_path / "clip", masks=tmp_path / "masks"), "clip", tmp_path / "runs")
    (record,) = runner.execute(made)
    before = capsys.readouterr().err
    assert "clip: masks: red: they are too large, or shifted" in before
    levels = {verdict.about: verdict.level for verdict in record.verdicts}
    assert levels["masks"] == "red" and {*levels} == {"masks", "prior", "result"}
    print_verdicts([record], "prior-only")
    assert capsys.readouterr().out.startswith("clip, seed 0: masks: red: they are too large, or shifted")


def test_what_is_red_comes_first_and_green_is_one_line(capsys: pytest.CaptureFixture[str]) -> None:
    green, yellow, red = (Verdict("result", level, level) for level in ("green", "yellow", "red"))
    print_verdicts([record(verdicts=[yellow]), record(seed=1, verdicts=[red])], "ours")
    assert capsys.readouterr().out == "wolf/Run, seed 1: result: red: red\nwolf/Run, seed 0: result: yellow: yellow\n\n"
    print_verdicts([record(verdicts=[green]), record(method="gart", verdicts=[red])], "ours")
    assert capsys.readouterr().out == "green: result: nothing speaks against them\n\n"
    print_verdicts([record()], "ours")
    assert capsys.readouterr().out == ""


def test_a_table_says_of_each_case_once_what_its_methods_share(capsys: pytest.CaptureFixture[str]) -> None:
    green, masks, torn = Verdict("result", "green", "a"), Verdict("masks", "yellow", "b"), Verdict("result", "red", "c")
    print_table_verdicts([record(verdicts=[masks, green]), record(method="gart", verdicts=[masks, torn]), record()])
    assert capsys.readouterr() == ("", "wolf/Run, gart, seed 0: result: red: c\nwolf/Run: masks: yellow: b\n\n")
    print_table_verdicts([record(verdicts=[green]), record(method="gart", verdicts=[green])])
    assert capsys.readouterr().err == "green: result: nothing speaks against them\n\n"
    print_table_verdicts([record(seed=seed, verdicts=[torn]) for seed in range(MOST + 2)])
    assert capsys.readouterr().err.endswith("2 more verdicts are red: see `verdicts` in the records\n\n")
    print_table_verdicts([record()])
    assert capsys.readouterr().err == ""


def test_a_record_keeps_its_verdicts() -> None:

    made = record(verdicts=[Verdict("masks", "red", "why", "do this")])
    assert msgspec.json.decode(to_json(made), type=type(made)) == made
