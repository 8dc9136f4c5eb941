"""`table`: print tables of records."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from rewild4d.config import parse_flags
from rewild4d.errors import UserError, unknown_name
from rewild4d.leaderboard.specs import find_spec

if TYPE_CHECKING:
    from rewild4d.leaderboard.layout import Table
    from rewild4d.leaderboard.records import RunRecord

DESCRIPTION = """Print the records of a folder: with a name, one of the tables in leaderboard/tables (see `list`), rows
averaged over the cases, the best bold, the second underlined; without a name, a table per protocol, case by case."""


@dataclass(frozen=True)
class Options:
    """Flags of `table`.

    Attributes:
        name: of a table; a table per protocol where it is left out.
        runs: folder of runs (what `run --out` named).
        format: md, latex (booktabs), html or csv (one line a figure, for programs).
        against: label of a row: adds the difference of all others to it, case by case, with a bootstrap interval.
        protocol: only this protocol's runs, without a version those of the newest; of a table with one condition, that
            condition.
        preset: of the runs in a named table; the table's own where it is left out.
        case: only these cases, names or patterns ("wolf/*").
        pooled: KID and FVD over all cases at once, from the features kept beside the records.
    """

    name: Annotated[tuple[str, ...], tyro.conf.Positional] = ()
    runs: Path = Path("runs")
    format: str = "md"
    against: str = ""
    protocol: str = ""
    preset: str = ""
    case: tuple[str, ...] = ()
    pooled: bool = False


def main(arguments: list[str]) -> int:
    options = parse_flags(Options, arguments, prog="rewild4d-bench table", description=DESCRIPTION)
    from rewild4d.leaderboard.formats import FORMATS

    if options.format not in FORMATS:
        raise unknown_name("format", options.format, FORMATS)
    if len(options.name) > 1:
        raise UserError(f"table: expected the name of one table, got {' '.join(options.name)}.")
    if options.against and not options.name:
        raise UserError("--against: expected the name of a table too, as in `table artemis --against ours`.")
    if options.pooled and options.against:
        raise UserError("--pooled: expected no --against with it: a pooled distance has no differences case by case.")
    tables = _named(options) if options.name else _by_protocol(options)
    nothing = "no record with features to pool" if options.pooled else "no records"
    print("\n\n".join(FORMATS[options.format](table) for table in tables) or nothing)
    return 0


def _by_protocol(options: Options) -> list[Table]:
    from rewild4d.leaderboard.pooled import pooled_tables
    from rewild4d.leaderboard.tables import protocol_tables
    from rewild4d.running import planning

    found = _found(options)
    if options.protocol:
        present = sorted({record.protocol["name"] for _, record in found})
        name = planning.known_protocol(options.protocol, present)
        if present and name not in present:
            raise UserError(f"{options.runs}: expected records of protocol {name}, got those of {', '.join(present)}.")
        found = [pair for pair in found if pair[1].protocol["name"] == name]
    return pooled_tables(found) if options.pooled else protocol_tables([record for _, record in found])


def _named(options: Options) -> list[Table]:
    from rewild4d.commands.choice import chosen, printed
    from rewild4d.leaderboard.pooled import pooled_table
    from rewild4d.leaderboard.tables import difference_table, named_table
    from rewild4d.running import planning

    name = options.name[0]
    choice = planning.Choice(options.preset, options.protocol)
    spec, found = chosen(name, find_spec(name), choice), _found(options)
    records = [record for _, record in found]
    spec, older = printed(name, spec, options.protocol, records)
    entrants, notes = planning.entrants(name, spec, records)
    notes = [*older, *notes]
    gaps = [each.label for each in entrants if not each.absent and not planning.is_complete(each, spec)]
    if gaps:
        other = f" --protocol {options.protocol}" if options.protocol else ""
        command = f"rewild4d-bench run --table {name} --preset {spec.preset}{other}"
        notes = [*notes, f"Without records: {', '.join(gaps)}; `{command}` makes what is missing."]
    frame = planning.frame(name, spec, notes)
    if options.pooled:
        return [pooled_table(frame, entrants, found)]
    tables = [named_table(frame, entrants, planning.reported(spec))]
    return [*tables, difference_table(frame, entrants, options.against)] if options.against else tables


def _found(options: Options) -> list[tuple[Path, RunRecord]]:
    """Return the records of the chosen cases, each with its folder."""
    from rewild4d.leaderboard.records import find_records
    from rewild4d.running.runner import choose_cases

    found = find_records(options.runs)
    cases = choose_cases(list(dict.fromkeys(record.case for _, record in found)), options.case)
    return [pair for pair in found if pair[1].case in cases]
