"""What `status` says of a folder of runs, from its files alone."""

import os
import time
from pathlib import Path

import pytest
from calling import call, output, refusal
from records_for_tests import record

from rewild4d.files import held, is_held, write_text
from rewild4d.leaderboard.records import Timing, write_record
from rewild4d.running.remote import _json
from rewild4d.running.status import FOLDER, Live, PlanFile, Planned, Run, live_file, read_boards, summary, time_left

NAMES = ("done", "failed", "running", "stopped", "waiting")
HOUR = 3600.0


def folder_of(out: Path, name: str) -> Path:
    return out / "p-v1" / name / "ours-quick-seed0-00000000"


def runs(out: Path) -> Path:
    """Make a run of each state; the one that runs is at work as long as its folder is held."""
    for name in NAMES[:-1]:
        (folder_of(out, name) / "work").mkdir(parents=True)
    took = Timing("2026-01-01T00:00:00+00:00", HOUR - 60, 60.0, 1.0)
    write_record(record(case="done", timing=took), folder_of(out, "done"))
    write_record(record(case="failed", status="failed", error="no animal", scores={}), folder_of(out, "failed"))
    for name in ("running", "stopped"):
        (folder_of(out, name) / "log.jsonl").write_text('{"step": 10}\n{"step": 20}\n')
        checkpoint = folder_of(out, name) / "work" / "checkpoint.pt"
        checkpoint.touch()
        os.utime(checkpoint, (time.time() - 600, time.time() - 600))
    return out


def plan(out: Path, live: Live | None) -> None:
    planned = [Planned(folder_of(out, name).relative_to(out).as_posix(), name, "ours", 0) for name in NAMES]
    file = out / FOLDER / "0.plan.json"
    write_text(file, _json(PlanFile("table demo", "2026-01-01T00:00:00+00:00", "node1", planned)))
    if live:
        write_text(live_file(file), _json(live))


def test_each_state_is_told_with_its_reason(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    plan(runs(tmp_path), Live(time.time(), workers=2))
    with held(folder_of(tmp_path, "running"), "never"):
        assert call("status", tmp_path) == 1, "a run has failed"
    title, command, *lines = capsys.readouterr().out.splitlines()
    # A run takes an hour: one runs since ten minutes, one was stopped, one waits, and there are two workers.
    left = "1 h 25 min"
    assert title == f"table demo: 1 done, 1 running, 1 failed, 1 stopped, 1 waiting of 5; about {left} left"
    assert command.startswith("  planned 2026-01-01T00:00:00+00:00 on node1; 2 workers, said ")
    assert lines == [
        "running", "  running: ours, seed 0 for 10 min: step 20, checkpoint 10 min old",
        "failed", "  failed: ours, seed 0: no animal",
        "stopped", "  stopped: ours, seed 0: step 20, checkpoint 10 min old",
    ]  # fmt: skip


def test_a_command_that_fell_silent_is_told(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    since = time.time() - HOUR
    live = Live(since, workers=2, running={"p-v1/waiting/ours-quick-seed0-00000000": ("tcp://node7:1", since)})
    plan(runs(tmp_path), live)
    assert call("status", tmp_path) == 1
    title, command, *_ = capsys.readouterr().out.splitlines()
    assert title == "table demo: 1 done, 0 running, 1 failed, 2 stopped, 1 waiting of 5", "nobody is at work"
    assert command.endswith("on node1; its command was lost, said 1 h ago; the same command goes on")


def test_what_the_command_says_is_enough_where_workers_write_elsewhere(tmp_path: Path) -> None:
    live = Live(time.time(), 1, {"p-v1/waiting/ours-quick-seed0-00000000": ("tcp://node7:1", time.time() - 60)})
    plan(runs(tmp_path), live)
    (board,) = read_boards(tmp_path)
    (running,) = [run for run in board.runs if run.state == "running"]
    assert running.note == "no checkpoint yet, on tcp://node7:1" and 60 <= running.seconds < 70


def test_runs_of_no_plan_are_told_too(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    write_record(record(), folder_of(tmp_path, "wolf__Run"))
    assert output(capsys, "status", tmp_path) == "runs of no plan file: 1 done, 0 running, 0 failed, 0 waiting of 1\n"
    empty = tmp_path / "empty"
    empty.mkdir()
    assert output(capsys, "status", empty) == f"{empty}: no runs\n"


def test_long_lists_are_cut(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for number in range(3):
        write_record(record(status="failed", error="no"), folder_of(tmp_path, f"case{number}"))
    assert call("status", tmp_path, "--most", 2) == 1
    assert "  ... and 1 more (--most 0 lists all)" in capsys.readouterr().out.splitlines()
    assert call("status", tmp_path, "--most", 0) == 1
    assert "more" not in capsys.readouterr().out


def test_a_lock_is_seen_while_it_is_held(tmp_path: Path) -> None:
    pytest.importorskip("fcntl", reason="no locks of folders here")
    assert is_held(tmp_path) is False and is_held(tmp_path / "absent") is False
    with held(tmp_path, "never"):
        assert is_held(tmp_path) is True
    assert is_held(tmp_path) is False


def test_the_time_left_is_that_of_equal_methods() -> None:
    done = [
        Run("", "", method, "done", seconds=seconds) for method, seconds in (("a", 10.0), ("a", 30.0), ("b", 100.0))
    ]
    rest = [Run("", "", "a", "waiting"), Run("", "", "b", "running", seconds=40.0)]
    assert time_left(done + rest, workers=1) == (10 + 30) / 2 + 100 - 40
    assert time_left(done + rest, workers=2) == 100 - 40, "the last run is not shared out"
    unknown = Run("", "", "c", "waiting")
    assert time_left([*done, unknown], workers=1) == (10 + 30 + 100) / 3, "of all methods, where none is known"
    assert time_left(rest, workers=1) is None
    assert summary(rest, 1).endswith("1 waiting of 2; time left unknown")


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        (["/no/such/folder"], "/no/such/folder: expected a folder of runs, but there is no such folder."),
        (["a", "b"], "status: expected one folder, got a b."),
        (["--most", "-1"], "--most: expected a number of at least 0, got -1."),
    ],
)
def test_what_status_refuses(words: list[str], sentence: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert refusal(capsys, "status", *words) == f"rewild4d-bench: {sentence}\n"


def test_damaged_plans_and_records_are_sentences(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    write_record(record(), folder_of(tmp_path, "good"))
    (folder_of(tmp_path, "good") / "record.json").write_text("{")
    assert call("status", tmp_path) == 1
    assert "record.json: expected a run record of schema 1, but" in capsys.readouterr().out
    plan(tmp_path, None)
    (tmp_path / FOLDER / "0.plan.json").write_text("[]")
    assert "0.plan.json: expected the plan of a command, but" in refusal(capsys, "status", tmp_path)
