"""Two commands that make the same run: the second waits, says so, and takes what the first has made."""

import sys
from pathlib import Path
from threading import Event, Thread
from typing import Any

import msgspec
import pytest
import torch
from listening import Errors
from one_case import OneCase

from rewild4d.baselines.prior_only import PriorOnly, PriorOnlyConfig
from rewild4d.evaluation.protocol import find_protocol
from rewild4d.leaderboard.records import RunRecord
from rewild4d.priors.choose import PriorChoice
from rewild4d.priors.config import STANDARD
from rewild4d.priors.io import save_prior
from rewild4d.running import runner
from rewild4d.running.conformance import tiny_case

pytest.importorskip("fcntl", reason="no locks of folders here")


def test_the_second_waits_for_the_first(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    case = tiny_case(frames=3)
    save_prior(case.prior, tmp_path / "prior.npz")
    plan = runner.Plan(
        dataset="artemis", reader=OneCase(case), root=tmp_path, cases=(case.clip.name,),
        protocol=msgspec.structs.replace(find_protocol("artemis", None), scores=("psnr", "iou")),
        entries=(runner.Entry("prior-only", "quick", PriorOnlyConfig(gaussians=500), (0,)),),
        prior=PriorChoice(str(tmp_path / "prior.npz"), STANDARD), device=torch.device("cpu"), out=tmp_path / "runs",
    )  # fmt: skip
    fitting, waiting, made, fits = Event(), Event(), list[list[RunRecord]](), []
    fit = PriorOnly.fit

    def slow(*given: Any, **named: Any) -> Any:
        fits.append(1)
        fitting.set()
        assert waiting.wait(60)
        return fit(*given, **named)

    errors = Errors("waiting for another process that makes prior-only-quick-seed0-")
    monkeypatch.setattr(sys, "stderr", errors)
    monkeypatch.setattr(PriorOnly, "fit", slow)
    first, second = (Thread(target=lambda: made.append(runner.execute(plan))) for _ in range(2))
    first.start()
    assert fitting.wait(60)
    second.start()
    said = errors.said.wait(60)
    waiting.set()
    first.join()
    second.join()
    assert said and len(fits) == 1 and made[0] == made[1] and made[0][0].status == "ok"
