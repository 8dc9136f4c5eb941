"""`status`: say what a folder of runs holds and what is being made there."""

from __future__ import annotations

import time
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import tyro

from rewild4d.config import parse_flags
from rewild4d.errors import UserError

if TYPE_CHECKING:
    from rewild4d.running.status import Board, Run

DESCRIPTION = """Say which runs of a folder are done, running, failed and why, stopped or waiting, and how long the rest
takes: from the files alone, so that it works in another shell and on another machine. What waits is known of plans made
with --executor dask, which write it down; `run --table NAME --plan` lists the others."""


@dataclass(frozen=True)
class Options:
    """Flags of `status`.

    Attributes:
        folder: of runs (what `run --out` named); runs where it is left out.
        most: of each kind at most so many runs are listed; 0 lists all.
    """

    folder: tyro.conf.Positional[tuple[Path, ...]] = ()
    most: int = 20


def main(arguments: list[str]) -> int:
    """Run the command; 0 where no run has failed, 1 where one has."""
    options = parse_flags(Options, arguments, prog="rewild4d-bench status", description=DESCRIPTION)
    if len(options.folder) > 1:
        raise UserError(f"status: expected one folder, got {' '.join(map(str, options.folder))}.")
    if options.most < 0:
        raise UserError(f"--most: expected a number of at least 0, got {options.most}.")
    from rewild4d.running.status import read_boards

    folder = options.folder[0] if options.folder else Path("runs")
    boards = read_boards(folder)
    print("\n\n".join(_said(board, options.most) for board in boards) or f"{folder}: no runs")
    return 1 if any(run.state == "failed" for board in boards for run in board.runs) else 0


def _said(board: Board, most: int) -> str:
    from rewild4d.running.status import STATES, summary

    workers = sum(run.state == "running" for run in board.runs)
    if board.live and board.live.is_fresh:
        workers = max(workers, board.live.workers)
    title = board.plan.title if board.plan else "runs of no plan file"
    lines = [f"{title}: {summary(board.runs, workers)}", *_command(board)]
    for state in STATES[1:-1]:
        found = [run for run in board.runs if run.state == state]
        shown = found[: most or None]
        lines += [state, *(f"  {_line(run)}" for run in shown)] if found else []
        lines += [f"  ... and {len(found) - len(shown)} more (--most 0 lists all)"] if len(found) > len(shown) else []
    return "\n".join(lines)


def _command(board: Board) -> list[str]:
    """Say whether the command of a plan goes on."""
    from rewild4d.running.status import spoken

    if board.plan is None:
        return []
    planned = f"  planned {board.plan.started} on {board.plan.host}"
    if board.live is None:
        return [planned]
    seen = f"said {spoken(max(0.0, time.time() - board.live.seen))} ago"
    if board.live.is_fresh:
        return [f"{planned}; {board.live.workers} workers, {seen}"]
    how = board.live.ended or "its command was lost"
    unfinished = any(run.state in ("waiting", "stopped", "failed") for run in board.runs)
    return [f"{planned}; {how}, {seen}" + ("; the same command goes on" if unfinished else "")]


def _line(run: Run) -> str:
    from rewild4d.running.status import spoken

    since = f" for {spoken(run.seconds)}" if run.state == "running" else ""
    return f"{run.title}{since}: {run.note}" if run.note else f"{run.title}{since}"
