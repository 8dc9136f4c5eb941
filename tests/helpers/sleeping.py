"""A data set, a method and a scoring that take next to no time, for what hands runs to many workers.

Installed for the processes of a test by `install`, as another package would be, through entry points.
"""

import json
import os
import time
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import msgspec
import torch

from rewild4d.contracts import Log, MethodInfo, Selection
from rewild4d.errors import UserError
from rewild4d.evaluation.protocol import find_protocol
from rewild4d.files import digest
from rewild4d.metrics.score import Score
from rewild4d.priors.choose import PriorChoice
from rewild4d.priors.config import STANDARD
from rewild4d.priors.io import save_prior
from rewild4d.running import runner
from rewild4d.running.conformance import tiny_case
from rewild4d.types import Case, Clip, Prior, Truth

STEP = 0.05
"""Seconds of one step; a checkpoint is written after each."""
TOLD = "told.txt"
PROTOCOL = """
name = "crowd-32-v1"
dataset = "crowd"
title = "Crowd"
description = "Many runs that take no time."
default = true
background = 1.0
scores = ["psnr"]
floors = []

[selection]
cameras = "sweep"
size = 32
framing = "full"
"""
ENTRIES = """
[rewild4d.methods]
sleeper = sleeping:Sleeper

[rewild4d.datasets]
crowd = sleeping:Crowd

[rewild4d.protocols]
crowd = crowd_protocols
"""


def install(folder: Path, cases: int) -> Path:
    """Write the entry points into a folder for the path, and a data set of so many cases; return the data set."""
    about = folder / "sleeping-1.0.dist-info"
    about.mkdir(parents=True)
    (about / "METADATA").write_text("Metadata-Version: 2.1\nName: sleeping\nVersion: 1.0\n")
    (about / "entry_points.txt").write_text(ENTRIES)
    (folder / "crowd_protocols").mkdir()
    (folder / "crowd_protocols" / "__init__.py").write_text("")
    (folder / "crowd_protocols" / "crowd.toml").write_text(PROTOCOL)
    data = folder / "crowd"
    data.mkdir()
    (data / "cases.txt").write_text(str(cases))
    save_prior(_case().prior, data / "prior.npz")
    return data


@cache
def _case() -> Case:
    return tiny_case(frames=2, width=32, height=24, views=3)


class Crowd:
    """Many cases with the same pictures."""

    licence = "CC0 1.0"

    def __init__(self, root: Path) -> None:
        if not (root / "cases.txt").is_file():
            raise UserError(f"{root}: expected a crowd, but there is none.")
        self.root = root

    def cases(self, selection: Selection) -> list[str]:
        return [f"crowd/{number:03d}" for number in range(int((self.root / "cases.txt").read_text()))]

    def load(self, case: str, selection: Selection) -> tuple[Clip, Truth]:
        if not (self.root / "cases.txt").is_file():
            raise UserError(f"{self.root}: expected a crowd, but it is gone.")
        return replace(_case().clip, name=case, digest=digest(case)), _case().truth

    def check(self) -> list[Any]:
        return []


class Nap(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Settings of the stub.

    Attributes:
        steps: of a fit.
        broken: cases whose fit fails.
        deadly: cases whose fit kills its process at the first step.
    """

    steps: int = 2
    broken: tuple[str, ...] = ()
    deadly: tuple[str, ...] = ()


class Asleep:
    """A reconstruction without Gaussians."""

    def save(self, folder: Path) -> None:
        (folder / "asleep.txt").write_text("zzz")


class Sleeper:
    """Sleeps, and writes down in the folder of all runs when a fit begins and ends, and from which step it goes on."""

    info = MethodInfo("Sleeper", "", "MIT", uses_prior=False)
    Config = Nap

    def fit(
        self, clip: Clip, prior: Prior, *, config: Any, seed: int, device: torch.device, log: Log, workdir: Path | None
    ) -> Asleep:
        assert workdir is not None
        runner.score = _score
        checkpoint = workdir / "checkpoint.pt"
        begin = int(checkpoint.read_text()) if checkpoint.is_file() else 0
        file = workdir.parents[3] / TOLD
        tell(file, f"begin {clip.name} {seed} {begin}")
        for step in range(begin, config.steps):
            time.sleep(STEP)
            if clip.name in config.deadly:
                os.kill(os.getpid(), 9)
            if clip.name in config.broken:
                raise UserError(f"{clip.name}: expected a quiet night, got none.")
            part = checkpoint.with_suffix(".new")
            part.write_text(str(step + 1))
            part.replace(checkpoint)
            log(step + 1, config.steps, {"loss": 1.0})
        tell(file, f"end {clip.name} {seed} {config.steps}")
        return Asleep()

    def load(self, folder: Path, device: torch.device) -> Asleep:
        return Asleep()


def tell(file: Path, line: str) -> None:
    """Append a line, whole."""
    handle = os.open(file, os.O_WRONLY | os.O_APPEND | os.O_CREAT)
    try:
        os.write(handle, f"{line} {os.getpid()}\n".encode())
    finally:
        os.close(handle)


def told(out: Path) -> list[list[str]]:
    """Return the words of each line: what, case, seed, step, process."""
    file = out / TOLD
    return [line.split() for line in file.read_text().splitlines()] if file.is_file() else []


def crowd_plan(data: Path, out: Path, config: Nap | None = None, seeds: tuple[int, ...] = (0,)) -> runner.Plan:
    """Return a plan of all cases of a crowd, whose priors are made."""
    reader, protocol = Crowd(data), find_protocol("crowd", None)
    plan = runner.Plan(
        dataset="crowd", reader=reader, root=data, cases=tuple(reader.cases(protocol.selection)), protocol=protocol,
        entries=(runner.Entry("sleeper", "quick", config or Nap(), seeds),), prior=PriorChoice("coarse:0.5", STANDARD),
        device=torch.device("cpu"), out=out,
    )  # fmt: skip
    (out / "priors").mkdir(parents=True, exist_ok=True)
    for case in plan.cases:
        identity = plan.prior.identity(*reader.load(case, protocol.selection))
        (out / "priors" / f"{identity}.npz").write_bytes((data / "prior.npz").read_bytes())
    return plan


def _score(*_: Any, folder: Path, **__: Any) -> tuple[dict[str, Any], float]:
    """Score without looking, in the place of `runner.score`."""
    (folder / "comparison.txt").write_text(json.dumps("a picture"))
    score = Score(value=20.0, unit="dB", better="higher", count=1, per_item=[20.0], note="")
    return {"status": "ok", "error": "", "pictures": [], "items": ["0"], "scores": {"psnr": score},
            "diagnostics": {}, "verdicts": []}, 0.0  # fmt: skip
