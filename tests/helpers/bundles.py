"""Tiny runs of `ours` on two cases, bundles of them, and bundles that somebody has changed."""

import hashlib
import json
import tempfile
import zipfile
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch
from toys import TINY

from rewild4d.contracts import Selection
from rewild4d.evaluation.protocol import find_protocol
from rewild4d.files import digest
from rewild4d.leaderboard.bundle import write_bundle
from rewild4d.leaderboard.records import FILE
from rewild4d.leaderboard.submission import SUBMISSION
from rewild4d.priors.choose import PriorChoice
from rewild4d.priors.config import STANDARD
from rewild4d.priors.io import save_prior
from rewild4d.running import runner
from rewild4d.running.conformance import tiny_case
from rewild4d.types import Clip, Truth

PROTOCOL = "artemis-sweep-128-v1"
WHO = ("--name", "Jane Doe", "--licence", "CC BY 4.0", "--title", "Two walks", "--date", "2026-11-28")
Change = Callable[[Path], None]


class TwoCases:
    """A reader of the tiny case under two names."""

    options = ()

    def __init__(self, root: Path | None = None) -> None:
        self.case = tiny_case(frames=3)

    def cases(self, selection: Selection) -> list[str]:
        return ["tiny/trot", "tiny/walk"]

    def load(self, case: str, selection: Selection) -> tuple[Clip, Truth]:
        return replace(self.case.clip, name=case, digest=digest(case, self.case.clip.digest)), self.case.truth

    def check(self) -> list[Any]:
        return []


def tiny_runs(folder: Path) -> Path:
    """Run `ours` on both cases, and return the folder of the runs; one of them keeps its film."""
    reader = TwoCases()
    save_prior(reader.case.prior, folder / "prior.npz")
    runner.execute(
        runner.Plan(
            dataset="artemis", reader=reader, root=folder, cases=("tiny/trot", "tiny/walk"),
            protocol=find_protocol("artemis", PROTOCOL),
            entries=(runner.Entry("ours", "quick", TINY, (0,)),),
            prior=PriorChoice(str(folder / "prior.npz"), STANDARD), device=torch.device("cpu"), out=folder / "runs",
        )
    )  # fmt: skip
    for film in folder.rglob("orbit.mp4"):  # to decode one takes longer than all else that is checked
        if film.parent != run_folder(folder / "runs"):
            film.unlink()
    return folder / "runs"


def changed(bundle: Path, out: Path, change: Change, redone: bool = False) -> Path:
    """Change the files of a bundle; ``redone`` makes its digests and its list of runs anew, as a forger would."""
    with tempfile.TemporaryDirectory() as scratch:
        folder = Path(scratch)
        with zipfile.ZipFile(bundle) as archive:
            archive.extractall(folder)
        change(folder)
        if redone:
            redo(folder)
        write_bundle(folder, out)
    return out


def redo(folder: Path) -> None:
    """Make `submission.json` anew from the files that are there."""
    said = json.loads((folder / SUBMISSION).read_text())
    files = sorted(path for path in folder.rglob("*") if path.is_file() and path.name != SUBMISSION)
    said["files"] = {
        path.relative_to(folder).as_posix(): hashlib.sha256(path.read_bytes()).hexdigest() for path in files
    }
    runs = {run["folder"]: run for run in said["runs"]}
    said["runs"] = []
    for path in (path for path in files if path.name == FILE):
        record, place = json.loads(path.read_text()), path.parent.relative_to(folder).as_posix()
        run = runs[place] | {name: record[name] for name in ("run_id", "case", "method", "seed")}
        run |= {"protocol": record["protocol"]["name"]}
        run["digests"] |= {"protocol": record["protocol"]["digest"]}
        said["runs"].append(run)
    (folder / SUBMISSION).write_text(json.dumps(said))


def run_folder(folder: Path, case: str = "walk") -> Path:
    """Folder of a run, in an unpacked bundle or a folder of runs."""
    return next(folder.glob(f"*/tiny__{case}/ours-*"))


def in_record(**fields: Any) -> Change:
    """A change of fields of the record of `ours` on tiny/walk; a function changes what is there."""

    def change(folder: Path) -> None:
        path = run_folder(folder) / FILE
        record = json.loads(path.read_text())
        for name, value in fields.items():
            record[name] = value(record[name]) if callable(value) else value
        path.write_text(json.dumps(record))

    return change
