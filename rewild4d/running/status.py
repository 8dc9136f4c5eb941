"""Tell what a folder of runs holds and what is being made there, from its files alone."""

import json
import time
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import msgspec

from rewild4d.errors import UserError
from rewild4d.files import is_held
from rewild4d.foreign.texts import read_json
from rewild4d.leaderboard.records import FILE, RunRecord, read_record
from rewild4d.ours.checkpoint import NAME as CHECKPOINT
from rewild4d.running.clock import CLOCK, STAMP

FOLDER = "plans"
"""Below the folder of all runs: a file for each plan, and what its command said last."""
SILENT = 120.0
"""Seconds after which a command that says nothing is taken for ended."""
IDLE = 900.0
"""Seconds after which a run whose files do not change is taken for stopped, where its lock says nothing."""
State = Literal["done", "running", "failed", "stopped", "waiting"]
STATES: tuple[State, ...] = ("done", "running", "failed", "stopped", "waiting")


class Planned(msgspec.Struct, frozen=True):
    """One run of a plan; ``folder`` is relative to that of all runs."""

    folder: str
    case: str
    method: str
    seed: int


class PlanFile(msgspec.Struct, frozen=True):
    """What a command on several machines has planned.

    Attributes:
        title: what it runs ("table artemis").
        started: UTC, ISO 8601.
        host: on which it was given.
        runs: all that it needs, finished or not.
    """

    title: str
    started: str
    host: str
    runs: list[Planned]


class Live(msgspec.Struct, frozen=True):
    """What the command of a plan said last.

    Attributes:
        seen: when, in seconds since 1970.
        workers: how many it had.
        running: folder of each run that a worker makes -> (address of the worker, since when).
        ended: how the command ended; "" while it goes on.
    """

    seen: float
    workers: int
    running: dict[str, tuple[str, float]] = {}
    ended: str = ""

    @property
    def is_fresh(self) -> bool:
        """Tell whether the command goes on."""
        return not self.ended and time.time() - self.seen < SILENT


@dataclass(frozen=True)
class Run:
    """State of one run.

    Attributes:
        folder: relative to the folder of all runs.
        title: case, method and seed.
        method: its name.
        state: what it is at; "stopped" was begun, and nobody goes on with it.
        note: why it failed, or how far it is.
        seconds: that fit and scoring took; of one that runs, since it was started.
    """

    folder: str
    title: str
    method: str
    state: State
    note: str = ""
    seconds: float = 0.0


@dataclass(frozen=True)
class Board:
    """A plan with the states of its runs.

    Attributes:
        plan: None for runs of no plan file.
        live: None where its command said nothing.
        runs: in the plan's order.
    """

    plan: PlanFile | None
    live: Live | None
    runs: tuple[Run, ...]


def read_boards(out: Path) -> list[Board]:
    """Return the plans of a folder of runs, the newest first, then its runs that no plan names.

    Raises:
        UserError: no such folder, or a plan file that is damaged.
    """
    if not out.is_dir():
        raise UserError(f"{out}: expected a folder of runs, but there is no such folder.")
    boards, known = [], set[str]()
    for file in (out / FOLDER).glob("*.plan.json"):
        plan, live = read_json(file, "the plan of a command", PlanFile), _read_live(live_file(file))
        boards.append(Board(plan, live, tuple(look(out, planned, live) for planned in plan.runs)))
        known |= {planned.folder for planned in plan.runs}
    boards.sort(key=lambda board: board.plan.started if board.plan else "", reverse=True)
    begun = {path.parent.relative_to(out).as_posix() for name in (FILE, "work") for path in out.glob(f"*/*/*/{name}")}
    rest = tuple(look(out, _unplanned(place), None) for place in sorted(begun - known))
    return [*boards, Board(None, None, rest)] if rest else boards


def live_file(plan_file: Path) -> Path:
    """Return the file beside a plan file in which its command says how it goes."""
    return plan_file.with_name(plan_file.name.replace(".plan.json", ".live.json"))


def _read_live(file: Path) -> Live | None:
    return read_json(file, "what a command says of its plan", Live) if file.is_file() else None


def _unplanned(place: str) -> Planned:
    """Take case, method and seed from a run's folder: "protocol/case/method-preset-seed0-1a2b3c4d"."""
    _, case, name = place.split("/")
    method, _, seed = name.rpartition("-")[0].rpartition("-seed")
    return Planned(place, case.replace("__", "/"), method or name, int(seed) if seed.isdecimal() else 0)


def look(out: Path, planned: Planned, live: Live | None) -> Run:
    """Return the state of one run.

    Args:
        out: folder of all runs.
        planned: which run.
        live: what the command of its plan said last.
    """
    folder, title = out / planned.folder, f"{planned.case}: {planned.method}, seed {planned.seed}"

    def run(state: State, note: str = "", seconds: float = 0.0) -> Run:
        return Run(planned.folder, title, planned.method, state, note, seconds)

    record: RunRecord | None = None
    if (folder / FILE).is_file():
        try:
            record = read_record(folder / FILE)
        except UserError as error:
            return run("failed", str(error))
    if record is not None and record.status == "ok":
        return run("done", seconds=record.timing.fit_seconds + record.timing.evaluate_seconds)
    said = live.running.get(planned.folder) if live and live.is_fresh else None
    if said or _is_at_work(folder):
        worker, since = said or ("", _started(folder))
        where = [f"on {worker}"] if worker else []
        return run("running", ", ".join([*_progress(folder), *where]), max(0.0, time.time() - since))
    if record is not None:
        return run("failed", record.error)
    if (folder / "work").is_dir() or (folder / "reconstruction").is_dir():
        return run("stopped", ", ".join(_progress(folder)))
    return run("waiting")


def _is_at_work(folder: Path) -> bool:
    """Tell whether a process makes a run: it holds the folder or, where locks say nothing, its files change."""
    held = is_held(folder)
    return held if held is not None else time.time() - max(_times(folder), default=0.0) < IDLE


def _times(folder: Path) -> list[float]:
    found = []
    for path in (*folder.glob("*"), *folder.glob("work/*")):
        try:
            found.append(path.stat().st_mtime)
        except OSError:  # it was moved in between
            continue
    return found


def _started(folder: Path) -> float:
    try:
        return float(read_json(folder / "work" / CLOCK, "when a fit was started")["started"])
    except (UserError, ValueError, KeyError, TypeError):
        return min(_times(folder), default=time.time())


def _progress(folder: Path) -> list[str]:
    """Say how far a run is: the last step that it logged, the age of its checkpoint."""
    if (folder / STAMP).is_file():
        return ["fitted, being scored"]
    found = []
    try:
        step = json.loads((folder / "log.jsonl").read_bytes().splitlines()[-1])["step"]
        found.append(f"step {int(step)}")
    except (OSError, ValueError, LookupError, TypeError):
        pass
    try:
        age = time.time() - (folder / "work" / CHECKPOINT).stat().st_mtime
        found.append(f"checkpoint {spoken(age)} old")
    except OSError:
        found.append("no checkpoint yet")
    return found


def summary(runs: Sequence[Run], workers: int) -> str:
    """Return one line: how many runs are at what, and the time that is left with so many workers, if there are any."""
    counts = Counter(run.state for run in runs)
    parts = [f"{counts[state]} {state}" for state in STATES if counts[state] or state != "stopped"]
    line = f"{', '.join(parts)} of {len(runs)}"
    if workers < 1 or not counts["running"] + counts["waiting"] + counts["stopped"]:
        return line
    left = time_left(runs, workers)
    return f"{line}; {'time left unknown' if left is None else f'about {spoken(left)} left'}"


def time_left(runs: Iterable[Run], workers: int) -> float | None:
    """Estimate the seconds until nothing is left: each run takes as long as those of its method took on average.

    Args:
        runs: of a plan.
        workers: runs at a time, 1 or more.

    Returns:
        None where no run has ended yet.
    """
    runs = list(runs)
    spent: dict[str, list[float]] = {}
    for run in runs:
        if run.state == "done":
            spent.setdefault(run.method, []).append(run.seconds)
    if not spent:
        return None
    whole = [_mean(spent, run.method) for run in runs if run.state in ("waiting", "stopped")]
    begun = [max(0.0, _mean(spent, run.method) - run.seconds) for run in runs if run.state == "running"]
    return max(sum((*whole, *begun)) / workers, max(begun, default=0.0))


def _mean(spent: Mapping[str, list[float]], method: str) -> float:
    found = spent.get(method) or [seconds for each in spent.values() for seconds in each]
    return sum(found) / len(found)


def spoken(seconds: float) -> str:
    """Return a duration as it is said.

    Examples:
        >>> spoken(59.4), spoken(600), spoken(3 * 3600 + 20 * 60), spoken(50 * 3600)
        ('59 s', '10 min', '3 h 20 min', '50 h')
    """
    if seconds < 90:
        return f"{seconds:.0f} s"
    minutes = round(seconds / 60)
    if minutes < 60:
        return f"{minutes} min"
    hours, minutes = divmod(minutes, 60)
    return f"{hours} h {minutes} min" if minutes and hours < 24 else f"{hours} h"
