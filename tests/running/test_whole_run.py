"""The main command on a small Artemis folder: JSON only on standard output, killed in the middle, and resumed."""

import json
import os
import shutil
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from rewild4d.datasets.builtin import synthetic
from rewild4d.datasets.rigs.studio import render_artemis

SETTINGS = ["--iterations", "120", "--warmup.iterations", "0", "--canonical.samples", "600"]
SETTINGS += ["--checkpoint-every", "20", "--image-size", "96", "--skinning.resolution", "12"]


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A few frames of a built-in animal."""
    root = tmp_path_factory.mktemp("data")
    walk = synthetic.build("tiger")[0]
    walk = replace(walk, bones=walk.bones[:8])
    return render_artemis([walk], root / "tiger", views=3, width=96, height=64, progress=None)


def command(folder: Path, out: Path, *more: str) -> list[str]:
    start = [sys.executable, "-c", "from rewild4d.cli import main; main()"]
    wanted = ["run", "--data", str(folder), "--protocol", "artemis-sweep-128-v1", "--out", str(out)]
    return [*start, *wanted, "--json", "--prior", "template:quadruped", *SETTINGS, *more]


def run(folder: Path, out: Path) -> list[dict[str, Any]]:
    done = subprocess.run(command(folder, out), capture_output=True, text=True)
    assert done.returncode == 0, done.stderr[-2000:]
    records = json.loads(done.stdout)
    for record in records:
        del record["timing"]
    return records


def kill_in_the_fit(folder: Path, out: Path) -> int:
    """Start the run, and kill -9 it once a checkpoint of the fit is there; returns the steps it had logged."""
    process = subprocess.Popen(command(folder, out), stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    deadline = time.monotonic() + 120
    while time.monotonic() < deadline and process.poll() is None:
        if next(out.rglob("ours-*/work/checkpoint.pt"), None):
            break
        time.sleep(0.02)
    assert process.poll() is None, "the run ended before it could be killed"
    os.kill(process.pid, signal.SIGKILL)
    process.wait()
    log = next(out.rglob("ours-*/log.jsonl")).read_text().splitlines()
    return json.loads(log[-1])["step"] if log else 0


def test_a_killed_run_resumes_to_the_same_record(folder: Path, tmp_path: Path) -> None:
    records = run(folder, tmp_path / "whole")
    assert [record["method"] for record in records] == ["empty", "prior-only", "ours"]
    assert all(record["status"] == "ok" for record in records)
    assert all(record["scores"]["psnr"]["count"] == 2 * 8 for record in records)

    shutil.copytree(tmp_path / "whole" / "priors", tmp_path / "killed" / "priors")
    assert kill_in_the_fit(folder, tmp_path / "killed") < 120
    assert not list((tmp_path / "killed").rglob("ours-*/record.json"))
    assert run(folder, tmp_path / "killed") == records
    assert not list((tmp_path / "killed").rglob("ours-*/work")), "a finished run leaves no checkpoint"
