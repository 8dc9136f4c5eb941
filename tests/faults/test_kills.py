"""A run that is killed at every stage, one after the other, ends in the result of an undisturbed one."""

import os
from pathlib import Path

import pytest
from kill_drill import SETTINGS, STAGES, Drill, differences, draw, durations, make_data

pytestmark = pytest.mark.skipif(not hasattr(os, "killpg"), reason="Windows has no groups of processes")


def test_killed_at_every_stage_it_ends_as_if_undisturbed(tmp_path: Path) -> None:
    drill = Drill(make_data(tmp_path / "tiger"), tmp_path, (*SETTINGS, "--prior", "coarse:0.1"))
    known = durations(drill.start("whole"))
    assert all(known.values()), f"every stage is met: {known}"
    whole = drill.result("whole")
    assert sum(name.endswith("record.json") for name in whole) == 3 * 3, "three methods in runs, collection and page"
    for moment in draw(known, len(STAGES), seed=1):
        stage, _, seconds = moment
        said = drill.start("killed", (stage, 0, min(seconds, known[stage][0] / 2)))
        assert said[-1][0] == f"begin {stage}"
    drill.start("killed")
    assert differences(whole, drill.result("killed")) == []
