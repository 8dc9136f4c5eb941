"""Run plans on a Dask cluster: the client hands out a run for each worker, and records are all that counts.

Nothing waits inside of Dask: a client that ends leaves nothing behind but the runs that workers are at, and the same
command goes on from the records.
"""

import importlib.util
import socket
import sys
import time
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any

import msgspec

from rewild4d.errors import UserError, reason
from rewild4d.files import atomic, digest, write_text
from rewild4d.leaderboard.records import FILE, RunRecord, read_record
from rewild4d.running.cluster import Site, check_site, connected
from rewild4d.running.parts import Made, Part, Terms, here, keep_files, list_parts, make_part, make_prior
from rewild4d.running.runner import Plan, lost_part
from rewild4d.running.status import FOLDER, Live, PlanFile, Planned, Run, live_file, look, summary

if TYPE_CHECKING:
    from distributed import Client, Future

TOLD = 2.0
"""Seconds between two looks at the workers."""
QUIET = 30.0
"""Seconds between two lines of progress where they are not shown in a terminal."""


def execute_remotely(plans: Sequence[Plan], site: Site, title: str) -> list[RunRecord]:
    """Run every part of the plans that has no finished record; return every record, in the plans' order.

    A run that fails leaves a record with its message and is not tried again; one whose worker was lost goes on with
    another worker, a bounded number of times.

    Args:
        plans: with one folder of runs.
        site: where to run.
        title: of the plans, for people.

    Raises:
        UserError: no case can be read, the cluster cannot be used or is lost, or a worker has other code or data.
        DiskFull: nothing more can be written, here or by a worker.
    """
    check_site(site)
    listed = [part for plan in plans for part in list_parts(plan)]
    parts = list({part.folder: part for part in listed}.values())
    missing = [part for part in parts if not part.is_done]
    if missing:
        report = Report(parts, title)
        try:
            with connected(site, len(missing)) as client:
                if link := _dashboard(client):
                    print(f"dashboard: {link}", file=sys.stderr)
                Crew(client, here(site.records, report.file), report).make(missing)
            report.end()
        finally:
            report.close()
    return [read_record(part.folder / FILE) for part in listed]


def _dashboard(client: "Client") -> str:
    """Return the address of Dask's page; "" where bokeh, which draws it, is absent."""
    return client.dashboard_link if importlib.util.find_spec("bokeh") else ""


@dataclass
class Report:
    """What people see of a plan: one line here, and files for `status`.

    Attributes:
        parts: all runs of the plan, finished or not.
        title: of the plan.
    """

    parts: list[Part]
    title: str
    running: dict[str, tuple[str, float]] = field(default_factory=dict)
    priors: int = 0
    workers: int = 0
    runs: dict[str, Run] = field(default_factory=dict)
    said: float = 0.0

    def __post_init__(self) -> None:
        out = self.parts[0].plan.out
        planned = [Planned(part.place, part.case, part.entry.method, part.seed) for part in self.parts]
        name = digest(*(one.folder for one in planned))[:12]
        self.file = out / FOLDER / f"{name}.plan.json"
        started = datetime.now(UTC).isoformat(timespec="seconds")
        write_text(self.file, _json(PlanFile(self.title, started, socket.gethostname(), planned)))
        self.runs = {one.folder: _known(look(out, one, None)) for one in planned}
        self.began = {part.place for part in self.parts if not part.is_done}
        self._write("")

    def ended(self, part: Part, record: RunRecord) -> None:
        """Take note of a run that has a record."""
        old, seconds = self.runs[part.place], record.timing.fit_seconds + record.timing.evaluate_seconds
        state = "done" if record.status == "ok" else "failed"
        self.runs[part.place] = replace(old, state=state, note=record.error, seconds=seconds)  # type: ignore[arg-type]

    def tell(self, running: dict[str, tuple[str, float]], priors: int, workers: int) -> None:
        """Say how it goes: write it for `status`, and print one line.

        Args:
            running: folder of each run that a worker makes -> (its address, since when).
            priors: how many are being made.
            workers: how many there are.
        """
        self.running, self.priors, self.workers = running, priors, workers
        self._write("")
        terminal = sys.stderr.isatty()
        if terminal or time.monotonic() - self.said > QUIET:
            self.said = time.monotonic()
            start, end = ("\r\033[K", "") if terminal else ("", "\n")
            print(f"{start}{self.line()}", end=end, file=sys.stderr, flush=True)

    def line(self) -> str:
        """Return the line of progress."""
        now = time.time()
        shown = [
            replace(run, state="running", seconds=now - self.running[place][1]) if place in self.running else run
            for place, run in self.runs.items()
        ]
        now_at = f"; {self.priors} priors being fitted" if self.priors else ""
        return f"{self.title}: {summary(shown, self.workers)}{now_at if self.workers else '; waiting for a worker'}"

    def end(self) -> None:
        """Print the line of progress for the last time."""
        self.running, start = {}, "\r\033[K" if sys.stderr.isatty() else ""
        print(f"{start}{self.title}: {summary(list(self.runs.values()), self.workers)}", file=sys.stderr)

    def close(self) -> None:
        """Write how the command ended."""
        self.running = {}
        left = any(self.runs[place].state in ("waiting", "stopped") for place in self.began)
        self._write("stopped" if left else "finished")

    def _write(self, ended: str) -> None:
        write_text(live_file(self.file), _json(Live(time.time(), self.workers, self.running, ended)))


def _known(run: Run) -> Run:
    """Take a run that this command will make for one that waits."""
    return run if run.state == "done" else replace(run, state="waiting", note="", seconds=0.0)


def _json(value: msgspec.Struct) -> str:
    return msgspec.json.format(msgspec.json.encode(value), indent=1).decode() + "\n"


class Crew:
    """The workers of a cluster, each of which has one run at a time."""

    def __init__(self, client: "Client", terms: Terms, report: Report) -> None:
        self.client, self.terms, self.report = client, terms, report
        self.flight: dict[Future, tuple[Part, bool, float]] = {}  # a run or (True) its case's prior, since when
        self.priors: set[Path] = set()  # made, or tried
        self.workers = 0

    def make(self, missing: Sequence[Part]) -> None:
        """Make all runs: priors first, which the fits need; then fits; lower bounds are short and fill the gaps."""
        from distributed import CancelledError, wait

        waiting = deque(sorted(missing, key=lambda part: part.is_floor))
        wanted = deque({part.prior: part for part in waiting if part.plan.prior.is_made}.values())
        needed = {part.prior for part in wanted}
        looked = -TOLD
        try:
            while waiting or self.flight:
                if time.monotonic() - looked > TOLD:
                    self._look()
                    looked = time.monotonic()
                while len(self.flight) < max(1, self.workers) and (task := self._next(wanted, waiting, needed)):
                    self._submit(*task)
                try:
                    with self.client.as_current():
                        ended = wait(list(self.flight), timeout=1, return_when="FIRST_COMPLETED").done
                except TimeoutError:
                    continue
                except CancelledError as error:
                    raise _gone(self.client) from error
                for future in ended:
                    self._take(future, *self.flight.pop(future)[:2])
        finally:
            self.client.cancel(list(self.flight))

    def _next(self, wanted: deque[Part], waiting: deque[Part], needed: set[Path]) -> tuple[Part, bool] | None:
        """Return the next thing to make, with whether it is the prior of that run's case; None where all must wait."""
        while wanted:
            part = wanted.popleft()
            if not part.prior.is_file():
                return part, True
            self.priors.add(part.prior)
        for index, part in enumerate(waiting):
            if part.prior in self.priors or part.prior not in needed:
                del waiting[index]
                return part, False
        return None

    def _submit(self, part: Part, is_prior: bool) -> None:
        future: Future[Any]
        mark = digest(str(part.plan.out), self.terms.records)[:4]
        if is_prior:
            key: tuple[str, ...] = "prior", part.case, f"{part.prior.stem[:8]}-{mark}"
            future = self.client.submit(make_prior, part, self.terms, key=key, pure=False)
        else:
            kept = self.terms.records == "returned" and part.plan.prior.is_made and part.prior.is_file()
            prior = part.prior.read_bytes() if kept else None
            key = part.entry.method, part.case, f"seed {part.seed}", f"{part.run_id[:8]}-{mark}"
            future = self.client.submit(make_part, part, self.terms, prior, key=key, pure=False)
        self.flight[future] = part, is_prior, time.time()

    def _take(self, future: "Future", part: Part, is_prior: bool) -> None:
        """Take what a worker has made, or what became of it."""
        from distributed import KilledWorker

        if future.status == "finished":
            self._keep(part, is_prior, future.result())
            return
        if future.status != "error":
            raise _gone(self.client)
        error: Any = future.exception()
        if isinstance(error, KilledWorker):
            self._lose(part, is_prior, error)
        elif isinstance(error, ImportError):
            raise UserError(f"a worker cannot import what this run needs: {reason(error)}; install the same there.")
        else:
            raise error

    def _keep(self, part: Part, is_prior: bool, found: Any) -> None:
        if is_prior:
            if found is not None:
                with atomic(part.prior) as file:
                    file.write_bytes(found)
            self.priors.add(part.prior)
            return
        made: Made = found
        keep_files(part, made)
        self.report.ended(part, made.record)

    def _lose(self, part: Part, is_prior: bool, error: Any) -> None:
        """Record that a run's workers were lost; a prior is tried once more by each of its fits."""
        if is_prior:
            self.priors.add(part.prior)
            return
        times = getattr(error, "allowed_failures", 0) + 1
        why = f"its worker was lost {times} times: killed, perhaps for memory or by a limit of its job"
        self.report.ended(part, lost_part(part.plan, part.case, part.entry, part.seed, why))

    def _look(self) -> None:
        """Count the workers, and tell what they are at."""
        try:
            self.workers = len(self.client.nthreads())
            at = {key: worker for worker, keys in self.client.processing().items() for key in keys}
        except (OSError, TimeoutError, ValueError) as error:
            raise _gone(self.client) from error
        running = {
            part.place: (at[future.key], since)
            for future, (part, is_prior, since) in self.flight.items()
            if not is_prior and future.key in at
        }
        self.report.tell(running, sum(is_prior for _, is_prior, _ in self.flight.values()), self.workers)


def _gone(client: "Client") -> UserError:
    address = getattr(client.scheduler, "address", "")
    return UserError(f"scheduler {address}: it is gone, with what its workers were at; the same command goes on.")
