"""How long a fit took, over its stops."""

import os
import time
from pathlib import Path

import pytest

from rewild4d.errors import UserError
from rewild4d.running import clock
from rewild4d.running.clock import CHECKPOINT, STAMP, Clock, fit_seconds


def saved(work: Path, at: float) -> None:
    """Leave a checkpoint that was written at a moment."""
    (work / CHECKPOINT).touch()
    os.utime(work / CHECKPOINT, (at, at))


def test_what_a_checkpoint_saved_counts_and_what_was_lost_does_not(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    now = 1000.0
    monkeypatch.setattr(time, "time", lambda: now)
    monkeypatch.setattr(time, "perf_counter", lambda: now)
    Clock(tmp_path)
    saved(tmp_path, 1000 + 40)
    now = 5000.0  # killed at some later time
    again = Clock(tmp_path)
    assert again.before == 40
    now = 5010.0
    assert again.seconds() == 40 + 10
    third = Clock(tmp_path)  # killed before another checkpoint: its ten seconds are done again
    assert third.before == 40
    saved(tmp_path, 5010 + 25)
    fourth = Clock(tmp_path)
    now = 5011.0
    fourth.stamp(tmp_path)
    assert fit_seconds(tmp_path) == 40 + 25 + 1


@pytest.mark.parametrize("text", ["", "{}", "[]", '{"seconds": "x", "started": 1}', "{"])
def test_a_damaged_clock_starts_at_zero(tmp_path: Path, text: str) -> None:
    (tmp_path / clock.CLOCK).write_text(text)
    saved(tmp_path, time.time())
    assert Clock(tmp_path).before == 0


def test_a_clock_without_a_checkpoint_starts_at_zero(tmp_path: Path) -> None:
    Clock(tmp_path)
    assert Clock(tmp_path).before == 0


def test_stamps_are_read_under_both_names_and_damaged_ones_are_refused(tmp_path: Path) -> None:
    (tmp_path / STAMP).write_text('{"seconds_since_last_start": 3.5}')
    assert fit_seconds(tmp_path) == 3.5
    (tmp_path / STAMP).write_text("{}")
    with pytest.raises(UserError, match="expected the time of a finished fit, got a damaged file"):
        fit_seconds(tmp_path)
