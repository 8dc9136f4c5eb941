"""`leaderboard build`: the records of a folder as a static page."""

from dataclasses import dataclass, replace
from pathlib import Path

from rewild4d import planning
from rewild4d.config import parse_flags
from rewild4d.errors import UserError, unknown_name
from rewild4d.leaderboard.layout import Table
from rewild4d.leaderboard.records import RunRecord, find_records
from rewild4d.leaderboard.site import build_site
from rewild4d.leaderboard.specs import load_specs
from rewild4d.leaderboard.tables import named_table

DESCRIPTION = """Make a static page from records alone: a sortable table per protocol, the named tables that have
records, and a page per run with its settings, provenance, curves over time and pictures. It opens from the disk."""


@dataclass(frozen=True)
class Options:
    """Flags of `leaderboard build`.

    Attributes:
        runs: folders of runs (what `run --out` named), pictures beside the records.
        out: the page's folder: new, empty, or an earlier page, which is replaced.
        preset: of the runs in the named tables; each table's own where it is left out.
    """

    runs: tuple[Path, ...] = (Path("runs"),)
    out: Path = Path("leaderboard-page")
    preset: str = ""


def main(arguments: list[str]) -> int:
    if arguments[:1] in (["-h"], ["--help"]) or not arguments:
        print("usage: rewild4d-bench leaderboard build --runs DIR --out DIR      (leaderboard build --help tells more)")
        return 0 if arguments else 2
    if arguments[0] != "build":
        raise unknown_name("leaderboard command", arguments[0], ["build"])
    options = parse_flags(Options, arguments[1:], prog="rewild4d-bench leaderboard build", description=DESCRIPTION)
    found = [pair for folder in options.runs for pair in find_records(folder)]
    if not found:
        raise UserError(f"{' '.join(map(str, options.runs))}: expected run records, found none.")
    print(build_site(found, options.out.absolute(), _named([record for _, record in found], options.preset)))
    return 0


def _named(records: list[RunRecord], preset: str) -> list[Table]:
    """The named tables of which at least one row that is no floor has a record."""
    tables = []
    for name, spec in load_specs().items():
        full = planning.with_choice(name, spec, planning.Choice(preset=preset))
        rows, remarks = planning.entrants(name, full, records)
        if any(any(under) for row in rows[: len(full.rows)] for under in row.records):
            frame = replace(planning.frame(name, full), remarks=tuple(remarks))
            tables.append(named_table(frame, rows, planning.reported(full)))
    return tables
