"""Turn a plan into records: load, prior, fit, evaluate, write; finished runs are skipped, killed ones resume."""

import contextlib
import shutil
import sys
import traceback
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from fnmatch import fnmatchcase
from operator import itemgetter
from pathlib import Path
from typing import Any

import msgspec
import torch

from rewild4d.contracts import DatasetReader, Reconstruction, Verdict
from rewild4d.errors import DiskFull, UserError, bounded, unknown_name
from rewild4d.evaluation.coverage import coverage
from rewild4d.evaluation.networks import may_be_scored_now
from rewild4d.evaluation.protocol import Protocol
from rewild4d.files import held, not_written, remove_leftovers
from rewild4d.kernels.switch import chosen_kernels
from rewild4d.leaderboard.records import FILE, SCHEMA, RunRecord, Timing, make_run_id, read_record, write_record
from rewild4d.machine import code_of, machine, peak_memory_mib
from rewild4d.priors.choose import PriorChoice, make_prior
from rewild4d.priors.placing import known_frames, with_cameras
from rewild4d.progress import Progress
from rewild4d.rasterizer import pick_rasterizer
from rewild4d.registry import load_method
from rewild4d.running import provenance
from rewild4d.running.clock import STAMP, Clock, fit_seconds
from rewild4d.running.folders import prior_file, run_folder
from rewild4d.running.scoring import score
from rewild4d.running.workers import Workers, share_cores, this_process, usable_cores
from rewild4d.types import Case, Clip, Prior, Truth

LOST = "the process ended: killed, perhaps for memory"


@dataclass(frozen=True)
class Entry:
    """One row of a plan: a method with its settings, and the seeds to run."""

    method: str
    preset: str
    config: msgspec.Struct
    seeds: tuple[int, ...]


@dataclass(frozen=True)
class Plan:
    """Everything that decides what is run; the same plan has the same run ids.

    Attributes:
        jobs: rows at a time, each in a process of its own.
        threads: of torch in each process; our kernels use the cores that no fit needs.
        rasterizer: out of `rewild4d.rasterizer.BACKENDS`, or "auto".
    """

    dataset: str
    reader: DatasetReader
    root: Path
    cases: tuple[str, ...]
    protocol: Protocol
    entries: tuple[Entry, ...]
    prior: PriorChoice
    device: torch.device
    out: Path
    jobs: int = 1
    threads: int = 1
    rasterizer: str = "auto"


def choose_cases(names: Sequence[str], wanted: Sequence[str]) -> tuple[str, ...]:
    """Return the cases that fit any of the names or patterns ("wolf/*"); all where none is given.

    Raises:
        UserError: a name that fits no case.
    """
    for pattern in wanted:
        if not any(fnmatchcase(name, pattern) for name in names):
            raise unknown_name("case", pattern, names)
    return tuple(name for name in names if not wanted or any(fnmatchcase(name, pattern) for pattern in wanted))


def execute(plan: Plan) -> list[RunRecord]:
    """Run every part of the plan that has no finished record; return every record, in the plan's order.

    A run that fails leaves a record with its message and does not stop the others. A case that cannot be read is
    skipped and has no records.

    Raises:
        UserError: none of the cases can be read or the rasterizer cannot be used, before anything is fitted.
        DiskFull: nothing more can be written; what was begun goes on with the next call.
    """
    plan = readable(replace(plan, rasterizer=pick_rasterizer(plan.rasterizer, plan.device)))
    plan.out.mkdir(parents=True, exist_ok=True)
    parts = [(name, entry, seed) for name in plan.cases for entry in plan.entries for seed in entry.seeds]
    floors = [entry.method in plan.protocol.floors for _, entry, _ in parts]
    # Lower bounds take no time, unless sets of novel views are scored, which takes minutes for every row.
    long = len(parts) if plan.protocol.novel else floors.count(False)
    jobs = min(plan.jobs, max(len(plan.cases), long))
    threads = share_cores(plan.threads, min(jobs, floors.count(False)), plan.device)
    if jobs <= 1:
        records = []
        with this_process(threads, plan.rasterizer):
            for name in plan.cases:
                prepare(plan, name)
                records += _run_case(plan, name)
        return records
    gpus = usable_cores(plan.device) if plan.device.type == "cuda" else 0
    with Workers(jobs, threads, plan.rasterizer, gpus) as workers:
        # Every fit of a case starts from its prior, so the priors come first.
        workers.map(prepare, [(plan, name) for name in plan.cases], lambda *_: None)
        # Fits come first; lower bounds are short and fill the gaps.
        order = sorted(range(len(parts)), key=floors.__getitem__)
        made = workers.map(_run_part, [(plan, *parts[i]) for i in order], lost_part)
        return [record for _, record in sorted(zip(order, made, strict=True), key=itemgetter(0))]


def readable(plan: Plan, visit: Callable[[str, Clip, Truth], None] = lambda *_: None) -> Plan:
    """Drop the cases that cannot be read, and print notes and errors.

    Args:
        plan: what is run.
        visit: called with the name, the clip and the truth of each case that can be read.

    Raises:
        UserError: none of the cases can be read.
    """
    notes: list[str] = []
    faults: dict[str, UserError] = {}
    for name in plan.cases:
        try:
            clip, truth = plan.reader.load(name, plan.protocol.selection)
        except UserError as error:
            faults[name] = error
            continue
        notes += [f"{name}: {note}" for note in clip.notes]
        visit(name, clip, truth)
    if faults and len(faults) == len(plan.cases):
        raise next(iter(faults.values()))
    for line in (*notes, *(f"{name}: left out: {error}" for name, error in faults.items())):
        print(line, file=sys.stderr)
    return replace(plan, cases=tuple(name for name in plan.cases if name not in faults))


def list_jobs(plan: Plan) -> list["Job"]:
    """List all jobs of the plan that can be read, in its order, finished or not; nothing is run."""
    plan, found = replace(plan, rasterizer=pick_rasterizer(plan.rasterizer, plan.device)), list[Job]()
    readable(plan, lambda name, clip, truth: found.extend(jobs_of(plan, name, clip, truth)))
    return found


def prepare(plan: Plan, name: str) -> None:
    """Make the prior of a case where a fit still needs it; print its notes, and masks that cannot be trusted.

    Its errors are reported by the fits.
    """
    clip, truth = plan.reader.load(name, plan.protocol.selection)
    if not all(job.finished() for job in jobs_of(plan, name, clip, truth)):
        judge: Callable[[str], Verdict] | None = getattr(plan.reader, "judge_masks", None)
        with contextlib.suppress(UserError, FloatingPointError):
            if judge and (verdict := judge(name)).level != "green":
                print(f"{name}: {verdict}", file=sys.stderr)
            for note in _prior(plan, clip, truth).notes:
                print(f"{name}: prior: {note}", file=sys.stderr)


def _run_part(plan: Plan, name: str, entry: Entry, seed: int) -> RunRecord:
    (record,) = _run_case(part_of(plan, entry, seed), name)
    return record


def lost_part(plan: Plan, name: str, entry: Entry, seed: int, why: str = LOST) -> RunRecord:
    """Record that the process of a run died, and return its record."""
    (job,) = jobs_of(part_of(plan, entry, seed), name, *plan.reader.load(name, plan.protocol.selection))
    return job.fail(why)


def part_of(plan: Plan, entry: Entry, seed: int) -> Plan:
    """Return the part of a plan that is one method with one seed."""
    return replace(plan, entries=(replace(entry, seeds=(seed,)),))


def _run_case(plan: Plan, name: str) -> list[RunRecord]:
    clip, truth = plan.reader.load(name, plan.protocol.selection)
    return run_jobs(plan, jobs_of(plan, name, clip, truth), clip, truth)


def run_jobs(plan: Plan, jobs: list["Job"], clip: Clip, truth: Truth) -> list[RunRecord]:
    """Run the jobs of one case that have no finished record; return the records of all."""
    if all(job.finished() for job in jobs):
        return [job.record() for job in jobs]
    try:
        prior = _prior(plan, clip, truth)
        case = Case(with_cameras(known_frames(clip, prior), prior), prior, truth)
    except DiskFull:
        raise
    except (UserError, FloatingPointError) as error:
        return [job.record() if job.finished() else job.fail(str(error)) for job in jobs]
    seen = coverage(clip, truth)
    return [job.run(case, seen) for job in jobs]


def jobs_of(plan: Plan, name: str, clip: Clip, truth: Truth) -> list["Job"]:
    """List the jobs of one case, finished or not."""
    prior_id = plan.prior.identity(clip, truth)
    return [Job(plan, name, entry, seed, clip, truth, prior_id) for entry in plan.entries for seed in entry.seeds]


def _prior(plan: Plan, clip: Clip, truth: Truth) -> Prior:
    path = prior_file(plan.out, plan.prior.identity(clip, truth))
    with contextlib.closing(Progress(f"{clip.name}: prior")) as progress:
        return make_prior(plan.prior, clip, truth, path, progress)


class Job:
    """One method on one case with one seed."""

    def __init__(self, plan: Plan, name: str, entry: Entry, seed: int, clip: Clip, truth: Truth, prior_id: str):
        self.plan, self.entry, self.seed, self.clip, self.truth = plan, entry, seed, clip, truth
        self.run_id = make_run_id(
            method=entry.method, config=entry.config, clip=clip.digest, truth=truth.digest, prior=prior_id,
            protocol=plan.protocol.digest, seed=seed, code=code_of(entry.method), device=plan.device.type,
            rasterizer=plan.rasterizer, **chosen_kernels(), **provenance.inputs(entry.method, entry.config, clip.name),
        )  # fmt: skip
        run = entry.method, entry.preset, seed, self.run_id
        self.folder = run_folder(plan.out, plan.protocol.name, name, *run)
        self.title = f"{clip.name}: {entry.method}"
        self.started = datetime.now(UTC).isoformat(timespec="seconds")

    def finished(self) -> bool:
        """Return whether there is a good record; scoring that lacked a network is repeated once the network is here."""
        if not self._is_good():
            return False
        return not (self._is_fitted() and may_be_scored_now(self.record().scores))

    def record(self) -> RunRecord:
        """Read the record."""
        return read_record(self.folder / FILE)

    def run(self, case: Case, seen: dict[str, float]) -> RunRecord:
        """Return the record if finished; else fit, evaluate, draw, record. One process at a time."""
        with held(self.folder, f"{self.title}: waiting for another process that makes {self.folder.name}"):
            if self.finished():
                return self.record()
            remove_leftovers(self.folder)
            return self._run(case, seen)

    def _run(self, case: Case, seen: dict[str, float]) -> RunRecord:
        try:
            reconstruction, fit_seconds = self._fit(case)
            whole = with_cameras(self.clip, case.prior)  # also the frames that the fit was not shown
            fields, seconds = score(
                reconstruction, whole, case.truth, case.clip, protocol=self.plan.protocol, method=self.entry.method,
                prior=self.plan.prior.name, quality=case.prior.quality, reader=self.plan.reader, folder=self.folder,
                device=self.plan.device, title=self.title,
            )  # fmt: skip
            timing = self._timing(fit_seconds, seconds)
            # Before the record: a run that was killed in between is not finished, and clears up when it goes on.
            shutil.rmtree(self.folder / "work", ignore_errors=True)
            path = write_record(self._record(case, **fields, coverage=seen, timing=timing), self.folder)
        except DiskFull:  # it is no failure of the run, and its record could not be written either
            raise
        except UserError as error:
            return self.fail(str(error), case)
        except Exception as error:  # a bug or a diverged fit: the record keeps the message, the terminal the traceback
            if isinstance(error, OSError) and isinstance(fault := not_written(self.folder, error), DiskFull):
                raise fault from error
            traceback.print_exc(file=sys.stderr)
            return self.fail(f"{type(error).__name__}: {error}", case)
        return read_record(path)

    def fail(self, message: str, case: Case | None = None) -> RunRecord:
        """Record a failure, but never replace a good record."""
        message = bounded(message)  # errors of other packages may hold a whole file
        print(f"{self.title}: failed: {message}", file=sys.stderr)
        if self._is_good():
            return self.record()
        record = self._record(case, status="failed", error=message, timing=self._timing(0.0, 0.0))
        return read_record(write_record(record, self.folder))

    def _fit(self, case: Case) -> tuple[Reconstruction, float]:
        """Fit and save; a run killed while scoring loads its reconstruction instead of fitting again."""
        method = load_method(self.entry.method)
        saved = self.folder / "reconstruction"
        if not self._is_fitted():
            work = self.folder / "work"
            work.mkdir(parents=True, exist_ok=True)
            progress = Progress(f"{self.title}: fit", self.folder / "log.jsonl")
            clock = Clock(work)
            reconstruction = method.fit(
                case.clip, case.prior, config=self.entry.config, seed=self.seed, device=self.plan.device,
                log=progress, workdir=work,
            )  # fmt: skip
            progress.close()
            save_reconstruction(reconstruction, saved)
            clock.stamp(self.folder)
        return method.load(saved, self.plan.device), fit_seconds(self.folder)

    def _is_good(self) -> bool:
        return (self.folder / FILE).is_file() and self.record().status == "ok"

    def _is_fitted(self) -> bool:
        return (self.folder / "reconstruction").is_dir() and (self.folder / STAMP).is_file()

    def _timing(self, fit: float, evaluation: float) -> Timing:
        return Timing(self.started, round(fit, 2), round(evaluation, 2), round(peak_memory_mib(), 1))

    def _record(self, case: Case | None, **found: Any) -> RunRecord:
        plan = self.plan
        fields: dict[str, Any] = {
            "schema": SCHEMA, "run_id": self.run_id, "method": self.entry.method, "dataset": plan.dataset,
            "case": self.clip.name, "seed": self.seed, "preset": self.entry.preset,
            "scores": {}, "coverage": {}, "items": [], "pictures": [], "diagnostics": {},
            "config": msgspec.to_builtins(self.entry.config),
            "data": {"root": str(plan.root), "licence": self.clip.licence, "clip": self.clip.digest,
                     "truth": self.truth.digest, "surface": self.truth.source,
                     **provenance.reading(plan.reader, self.clip)},
            "prior": {"choice": plan.prior.name, "config": msgspec.to_builtins(plan.prior.settings(self.clip)),
                      **provenance.weights(plan.prior), **provenance.keypoints(plan.prior, self.clip),
                      **provenance.prior_of(case.prior if case else None),
                      **provenance.left_out(self.clip, case.clip if case else None)},
            "protocol": {"digest": plan.protocol.digest, **msgspec.to_builtins(plan.protocol)},
            "code": provenance.code(self.entry.method, self.entry.config),
            "machine": machine(plan.device, plan.rasterizer),
        }  # fmt: skip
        return RunRecord(**{**fields, **found})


def save_reconstruction(reconstruction: Reconstruction, folder: Path) -> None:
    """Save into a folder that appears only when it is complete."""
    building = folder.with_name(f".{folder.name}.part")
    shutil.rmtree(building, ignore_errors=True)
    try:
        building.mkdir(parents=True)
        reconstruction.save(building)
        shutil.rmtree(folder, ignore_errors=True)
        building.rename(folder)
    except OSError as error:
        raise not_written(folder, error) from error
    finally:
        shutil.rmtree(building, ignore_errors=True)
