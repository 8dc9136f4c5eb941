"""`leaderboard`: collect records for a repository, submit and verify them, and build a static page from them."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from rewild4d.commands.shared import call_subcommand, check_timeout, require_writable
from rewild4d.config import parse_flags
from rewild4d.errors import UserError
from rewild4d.leaderboard.specs import load_specs

if TYPE_CHECKING:
    from rewild4d.leaderboard.layout import Table
    from rewild4d.leaderboard.records import RunRecord

USAGE = """usage: rewild4d-bench leaderboard build|collect --runs DIR --out DIR
       rewild4d-bench leaderboard submit RUNS... --out BUNDLE.zip
       rewild4d-bench leaderboard verify BUNDLE.zip [--data FOLDER]
       rewild4d-bench leaderboard add BUNDLE.zip --results FOLDER [--data FOLDER]
(leaderboard build --help lists the options of build)"""
BUILD = """Make a static page from records alone: a sortable table per protocol, the named tables that have records, and
a page per run with its settings, provenance, curves over time and pictures. Every folder of runs is a part of its own,
and its cases are averaged with no others. It opens from the disk."""
COLLECT = """Gather from folders of runs what a repository should keep and `leaderboard build` and `table` need: the
latest record of every run, without absolute paths, and for the first seed of every row a small comparison picture and
orbit."""

REFERENCE = "Ours"
"""Row that all others of its table are compared with on the page."""


@dataclass(frozen=True)
class BuildOptions:
    """Flags of `leaderboard build`.

    Attributes:
        runs: folders of runs (what `run --out` or `leaderboard collect --out` named), pictures beside the records.
        out: folder of the page: new, empty, or an earlier page, which is replaced.
        preset: of the runs in the named tables; each table's own where it is left out.
        timeout: seconds that ffmpeg may take to read one film.
        reports: publish the pages that `report` wrote beside records. They have a script of their own: only for runs
            that come from no stranger.
    """

    runs: tuple[Path, ...] = (Path("runs"),)
    out: Path = Path("leaderboard-page")
    preset: str = ""
    timeout: float = 120.0
    reports: bool = False


@dataclass(frozen=True)
class CollectOptions:
    """Flags of `leaderboard collect`.

    Attributes:
        out: folder of the collection: new, empty, or an earlier collection, which is replaced.
        runs: folders of runs (what `run --out` named).
        title: heading of this part of the page; the name of the folder where it is left out.
        pictures: keep those of open data (their licence allows redistribution), all or none.
        limit_mb: largest size of all files together, MB.
        timeout: seconds that ffmpeg may take to read one film and to make it smaller.
    """

    out: Path
    runs: tuple[Path, ...] = (Path("runs"),)
    title: str = ""
    pictures: Literal["open", "all", "none"] = "open"
    limit_mb: float = 15.0
    timeout: float = 120.0


def main(arguments: list[str]) -> int:
    from rewild4d.commands import submission

    commands = {"build": build, "collect": collect_runs, "submit": submission.submit, "verify": submission.verify,
                "add": submission.add}  # fmt: skip
    return call_subcommand(arguments, USAGE, "leaderboard command", commands)


def build(arguments: list[str]) -> int:
    options = parse_flags(BuildOptions, arguments, prog="rewild4d-bench leaderboard build", description=BUILD)
    check_timeout(options.timeout)
    from rewild4d.leaderboard.collect import title_of
    from rewild4d.leaderboard.records import find_records
    from rewild4d.leaderboard.site import Part, build_site
    from rewild4d.leaderboard.submission import SUBMISSION

    parts = []
    for folder in options.runs:
        found = find_records(folder)
        tables = _named([record for _, record in found], options.preset)
        parts.append(Part(title_of(folder), found, tables, given=(folder / SUBMISSION).is_file()))
    parts = [part for part in parts if part.found]
    _require_records(options.runs, parts)
    print(build_site(parts, options.out.absolute(), timeout=options.timeout, reports=options.reports))
    return 0


def collect_runs(arguments: list[str]) -> int:
    options = parse_flags(CollectOptions, arguments, prog="rewild4d-bench leaderboard collect", description=COLLECT)
    check_timeout(options.timeout)
    from rewild4d.leaderboard.collect import collect
    from rewild4d.leaderboard.records import find_records

    found = [pair for folder in options.runs for pair in find_records(folder)]
    _require_records(options.runs, found)
    out = options.out.absolute()
    require_writable(out.parent)
    made = collect(
        found, out, title=options.title or out.name, pictures=options.pictures, limit=options.limit_mb * 1e6,
        timeout=options.timeout,
    )  # fmt: skip
    for note in made.remarks:
        print(note, file=sys.stderr)
    print(f"{made.runs} runs, {made.pictured} of them with pictures, {made.size / 1e6:.1f} MB: {options.out}")
    return 0


def _require_records(folders: tuple[Path, ...], found: Sequence[object]) -> None:
    if not found:
        raise UserError(f"{' '.join(map(str, folders))}: expected run records, found none.")


def _named(records: list[RunRecord], preset: str) -> list[tuple[Table, ...]]:
    """Make the named tables in which two rows other than lower bounds have different records under every condition on
    the table's own data set, each with the differences to `REFERENCE`."""
    from rewild4d.commands.choice import chosen, printed
    from rewild4d.leaderboard.tables import difference_table, named_table
    from rewild4d.running import planning

    tables: list[tuple[Table, ...]] = []
    for name, spec in load_specs().items():
        full, older = printed(name, chosen(name, spec, planning.Choice(preset=preset)), "", records)
        rows, notes = planning.entrants(name, full, records)
        notes = [*older, *notes]
        whole = [row for row in rows[: len(full.rows)] if planning.is_complete(row, full)]
        if len({frozenset(record.run_id for under in row.records for record in under) for row in whole}) < 2:
            continue
        frame = planning.frame(name, full, notes)
        table = named_table(frame, rows, planning.reported(full))
        compared = any(row.label == REFERENCE for row in whole)
        tables.append((table, difference_table(frame, rows, REFERENCE)) if compared else (table,))
    return tables
