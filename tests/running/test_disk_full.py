"""A disk that fills up: one sentence, exit status 2, nothing half-written, and the same command goes on afterwards."""

import errno
import json
import os
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import msgspec
import pytest
import torch
from one_case import OneCase
from records_for_tests import still
from small_files import largest_file
from toys import TINY

from rewild4d import files, progress
from rewild4d.errors import DiskFull
from rewild4d.evaluation.protocol import find_protocol
from rewild4d.priors.choose import PriorChoice
from rewild4d.priors.config import STANDARD
from rewild4d.priors.io import save_prior
from rewild4d.running import runner
from rewild4d.running.conformance import tiny_case
from rewild4d.visualize import pictures

pytestmark = pytest.mark.usefixtures("one_thread")


@pytest.fixture(scope="module")
def plan(tmp_path_factory: pytest.TempPathFactory) -> runner.Plan:
    root = tmp_path_factory.mktemp("full")
    case = tiny_case(frames=3)
    save_prior(case.prior, root / "prior.npz")
    return runner.Plan(
        dataset="artemis", reader=OneCase(case), root=root, cases=(case.clip.name,),
        protocol=msgspec.structs.replace(find_protocol("artemis", None), scores=("psnr", "iou")),
        entries=(runner.Entry("ours", "quick", TINY, (0,)),),
        prior=PriorChoice(str(root / "prior.npz"), STANDARD), device=torch.device("cpu"), out=root / "whole",
    )  # fmt: skip


@pytest.fixture(scope="module")
def whole(plan: runner.Plan) -> runner.RunRecord:
    (record,) = runner.execute(plan)
    assert record.status == "ok", record.error
    return record


def left(folder: Path) -> list[str]:
    return sorted(str(path.relative_to(folder)) for path in folder.rglob("*") if path.is_file())


def filling(call: Callable[..., Any], place: str, after: int) -> Callable[..., Any]:
    """The same function, but after some calls about a place there is no room for another."""
    calls = iter(range(after))

    def full(*given: Any, **named: Any) -> Any:
        about = " ".join(str(getattr(each, "name", each)) for each in given if not isinstance(each, dict))
        if place in about and next(calls, None) is None:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        return call(*given, **named)

    return full


@pytest.mark.parametrize(
    ("module", "name", "place", "after"),
    [
        (torch, "save", "checkpoint", 1),
        (progress, "_append", "log.jsonl", 2),
        (torch, "save", "reconstruction", 0),
        (pictures.imageio, "imwrite", "orbit", 0),
        (pictures.imageio, "get_writer", "orbit", 0),
        (files.os, "replace", "fit.json", 0),
        (files.os, "replace", "record.json", 0),
    ],
)
def test_a_full_disk_is_one_sentence_and_the_next_run_goes_on(
    plan: runner.Plan, whole: runner.RunRecord, tmp_path: Path, monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str], module: Any, name: str, place: str, after: int,
) -> None:  # fmt: skip
    plan = replace(plan, out=tmp_path / "runs")
    with monkeypatch.context() as patch, pytest.raises(DiskFull) as error:
        patch.setattr(module, name, filling(getattr(module, name), place, after))
        runner.execute(plan)
    assert str(error.value).endswith(": could not be written: No space left on device.")
    assert place == "log.jsonl" or place in str(error.value)
    assert "Traceback" not in capsys.readouterr().err
    assert not list(plan.out.rglob("record.json"))
    assert not [path for path in left(plan.out) if ".part" in path], "nothing half-written"
    for log in plan.out.rglob("log.jsonl"):
        assert all(json.loads(line) for line in log.read_text().splitlines())
    (again,) = runner.execute(plan)
    assert still(again) == still(whole)
    assert left(plan.out) == left(plan.root / "whole")


def test_half_a_line_of_a_log_is_taken_back(tmp_path: Path) -> None:
    log = progress.Progress("a fit", tmp_path / "log.jsonl")
    log(1, 9, {"loss": 1.0})
    before = (tmp_path / "log.jsonl").read_text()
    with largest_file(len(before) + 5), pytest.raises(OSError, match="No space left"):
        log(2, 9, {"loss": 2.0})
    log.close()
    assert (tmp_path / "log.jsonl").read_text() == before
