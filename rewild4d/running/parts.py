"""Cut plans into runs that any machine can make, and make one of them on a worker."""

import contextlib
import os
import shutil
import socket
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Literal

from rewild4d.errors import DiskFull, UserError
from rewild4d.files import atomic, digest, not_written
from rewild4d.kernels.switch import choose_kernels, kernel_mode
from rewild4d.leaderboard.records import FILE, RunRecord, read_record
from rewild4d.machine import code_of, pick_device
from rewild4d.progress import hide_bars
from rewild4d.rasterizer import pick_rasterizer
from rewild4d.running.folders import prior_file
from rewild4d.running.runner import Entry, Job, Plan, jobs_of, part_of, prepare, readable, run_jobs
from rewild4d.running.workers import Threads, this_process
from rewild4d.types import Clip, Truth

Records = Literal["shared", "returned"]
"""Where workers write: into the client's folder on a shared file system, or into their own, for the client to fetch."""
_one = threading.Lock()
"""Held by the fit of this process: a worker of several threads makes one at a time."""


class Unfit(UserError):
    """A worker cannot make what was planned: its code, its data or its device is another."""


@dataclass(frozen=True)
class Part:
    """One run of a plan, with all that a worker needs to make it.

    Attributes:
        plan: of this run alone: one case, one method, one seed; its `out` is the client's.
        run_id: that the worker has to find too.
        folder: of the run, on the client.
        prior: file that the case's prior is kept in, on the client.
        code: `machine.code_of` the method, on the client.
        is_done: whether there was a good record when it was planned.
    """

    plan: Plan
    run_id: str
    folder: Path
    prior: Path
    code: dict[str, str]
    is_done: bool

    @property
    def case(self) -> str:
        """Return the name of its case."""
        return self.plan.cases[0]

    @property
    def entry(self) -> Entry:
        """Return its method and settings."""
        return self.plan.entries[0]

    @property
    def seed(self) -> int:
        """Return its seed."""
        return self.entry.seeds[0]

    @property
    def is_floor(self) -> bool:
        """Tell whether it is a lower bound, which takes no time."""
        return self.entry.method in self.plan.protocol.floors

    @cached_property
    def place(self) -> str:
        """Return its folder relative to the folder of all runs."""
        return self.folder.relative_to(self.plan.out).as_posix()


@dataclass(frozen=True)
class Terms:
    """What all parts of one command have in common.

    Attributes:
        records: where workers write.
        plan_file: in the client's folder of runs: a worker that does not see it does not share that folder.
        kernels: `--kernels` of the client.
        folder: in which the command was given; names of files that are not absolute are meant from there.
    """

    records: Records
    plan_file: Path
    kernels: str
    folder: Path


@dataclass(frozen=True)
class Made:
    """A run that a worker has made: its record and, where the folder is not shared, its files by relative name."""

    record: RunRecord
    files: dict[str, bytes]


def list_parts(plan: Plan) -> list[Part]:
    """List all runs of a plan that can be read, in its order, finished or not; each case is loaded once.

    Raises:
        UserError: none of the cases can be read.
    """
    found: list[Part] = []

    def visit(name: str, clip: Clip, truth: Truth) -> None:
        prior = prior_file(plan.out, plan.prior.identity(clip, truth))
        for job in jobs_of(plan, name, clip, truth):
            alone = replace(part_of(plan, job.entry, job.seed), cases=(name,))
            found.append(Part(alone, job.run_id, job.folder, prior, code_of(job.entry.method), job.finished()))

    readable(plan, visit)
    return found


def make_prior(part: Part, terms: Terms) -> bytes | None:
    """Make the prior of a part's case on a worker; return its file where the folder is not shared and it has one."""
    with _settled(part, terms) as plan:
        _job(part, plan)
        prepare(plan, part.case)
        file = plan.out / "priors" / part.prior.name
        return file.read_bytes() if terms.records == "returned" and file.is_file() else None


def make_part(part: Part, terms: Terms, prior: bytes | None = None) -> Made:
    """Make a run on a worker, or go on where an earlier worker was; a fit that fails is a record too.

    Args:
        part: the run.
        terms: what all runs have in common.
        prior: file of the case's prior, where the folder is not shared and the client has it.

    Raises:
        Unfit: this worker has other code, data or devices.
        DiskFull: nothing more can be written here.
    """
    with _settled(part, terms) as plan:
        if prior is not None:
            with atomic(plan.out / "priors" / part.prior.name) as file:
                file.write_bytes(prior)
        job, clip, truth = _job(part, plan)
        (record,) = run_jobs(plan, [job], clip, truth)
        return Made(record, _taken(job.folder) if terms.records == "returned" else {})


@contextmanager
def _settled(part: Part, terms: Terms) -> Iterator[Plan]:
    """Set up this process as a worker of one part, alone, and give the plan with the folder that it writes into."""
    with _one, contextlib.chdir(terms.folder) if terms.folder.is_dir() else contextlib.nullcontext():
        hide_bars()
        choose_kernels(terms.kernels)
        plan = part.plan
        try:
            pick_device(str(plan.device))
            pick_rasterizer(plan.rasterizer, plan.device)
        except UserError as error:
            raise _unfit(str(error)) from error
        if (own := code_of(part.entry.method)) != part.code:
            raise _unfit(f"expected the code of the command that plans ({_said(part.code)}), got {_said(own)}.")
        if terms.records == "returned":
            from distributed import get_worker

            plan = replace(plan, out=scratch_folder(Path(get_worker().local_directory), plan.out))
        elif not terms.plan_file.is_file():
            raise _unfit(f"{terms.plan_file}: the folder of runs is not shared with it; try --records returned.")
        with this_process(Threads(plan.threads, plan.threads), plan.rasterizer):
            yield plan


def _job(part: Part, plan: Plan) -> tuple[Job, Clip, Truth]:
    """Load the data of a part, and make sure that it is the planned run."""
    try:
        clip, truth = plan.reader.load(part.case, plan.protocol.selection)
    except DiskFull:
        raise
    except UserError as error:  # the client has read it
        raise _unfit(str(error)) from error
    (job,) = jobs_of(plan, part.case, clip, truth)
    if job.run_id != part.run_id:
        raise _unfit(
            f"expected {part.case}, {part.entry.method}, seed {part.seed} to be run {part.run_id}, got {job.run_id}: "
            "its data, or a file that the method or the prior reads, is another."
        )
    return job, clip, truth


def _unfit(message: str) -> Unfit:
    return Unfit(f"worker on {socket.gethostname()}: {message}")


def _said(code: dict[str, str]) -> str:
    return ", ".join(f"{name} {value}" for name, value in code.items())


def scratch_folder(worker: Path, out: Path) -> Path:
    """Return where a worker keeps the folder of runs of a client: beside Dask's own folder (--local-directory), so that
    a run that was begun goes on with another worker of this machine."""
    return worker.parent / f"rewild4d-{os.getuid() if hasattr(os, 'getuid') else 'runs'}" / digest(str(out))[:12]


def _taken(folder: Path) -> dict[str, bytes]:
    """Read a finished run's files, but for checkpoints, and remove its folder."""
    files = {path.relative_to(folder).as_posix(): path.read_bytes() for path in folder.rglob("*") if path.is_file()}
    shutil.rmtree(folder, ignore_errors=True)
    return {name: content for name, content in files.items() if not name.startswith("work/")}


def keep_files(part: Part, made: Made) -> None:
    """Write what a worker brought back: the run's folder changes in one step, and a failure replaces no good record."""
    building = part.folder.with_name(f".{part.folder.name}.part")
    if not made.files or (made.record.status != "ok" and _is_good(part)):
        return
    shutil.rmtree(building, ignore_errors=True)
    try:
        for name, content in made.files.items():
            path = building / name
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_bytes(content)
        shutil.rmtree(part.folder, ignore_errors=True)
        building.rename(part.folder)
    except OSError as error:
        raise not_written(part.folder, error) from error
    finally:
        shutil.rmtree(building, ignore_errors=True)


def _is_good(part: Part) -> bool:
    file = part.folder / FILE
    return file.is_file() and read_record(file).status == "ok"


def here(records: Records, plan_file: Path) -> Terms:
    """Return the terms of a command of this process."""
    return Terms(records, plan_file, kernel_mode(), Path.cwd())
