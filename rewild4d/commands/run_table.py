"""`run --table NAME`: plan what a table needs, run what is missing, print it."""

from __future__ import annotations

import itertools
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import msgspec

from rewild4d.commands.options import RunFlags
from rewild4d.commands.shared import (
    check_executor,
    check_numbers,
    choose_prior,
    exit_code,
    lower_bounds,
    open_dataset,
    plan_fields,
    run_plans,
)
from rewild4d.config import parse_flags
from rewild4d.contracts import DatasetReader
from rewild4d.errors import UserError
from rewild4d.evaluation.protocol import Protocol, find_protocol
from rewild4d.leaderboard.specs import Spec, find_spec, load_specs
from rewild4d.registry import require_name

if TYPE_CHECKING:
    from rewild4d.leaderboard.layout import Table
    from rewild4d.leaderboard.records import RunRecord
    from rewild4d.running.runner import Entry, Plan

DESCRIPTION = """Fit what a table of leaderboard/tables (see `list`) needs and has no record for yet, on every case, and
print it. Finished runs are skipped and a killed one resumes."""


@dataclass(frozen=True, kw_only=True)
class TableChoice:
    """Flags that only `run --table` has.

    Attributes:
        table: name of the table (see `list`).
        case: names or patterns of cases ("wolf/Run", "wolf/*"); all of the table where it is left out.
        protocol: instead of the table's, where it has one condition; one of another data set selects that data set.
        preset: settings and length of the fits: quick, standard or paper; the table's where it is left out.
        seeds: one run for each; the table's where they are left out.
        plan: print what would be run, and run nothing.
    """

    table: str
    case: tuple[str, ...] = ()
    protocol: str = ""
    preset: str = ""
    seeds: tuple[int, ...] = ()
    plan: bool = False


@dataclass(frozen=True, kw_only=True)
class Options(RunFlags, TableChoice):
    """Flags of `run --table`."""


def main(arguments: list[str]) -> int:
    """Run the command; 0 where every run has scores, 1 where one failed, 2 where a case cannot be read."""
    index = arguments.index("--table") if "--table" in arguments else None
    if index is not None and (index + 1 == len(arguments) or arguments[index + 1].startswith("--")):
        if "--help" not in arguments:
            raise UserError(f"--table: expected the name of a table, got none; available: {', '.join(load_specs())}.")
        arguments = ["--help"]
    options = parse_flags(Options, arguments, prog="rewild4d-bench run", description=DESCRIPTION)
    check_executor(options)
    found = find_spec(options.table)
    from rewild4d.commands.choice import chosen
    from rewild4d.commands.verdicts import print_table_verdicts
    from rewild4d.leaderboard.formats import markdown
    from rewild4d.leaderboard.records import to_json
    from rewild4d.running import planning

    spec = chosen(options.table, found, planning.Choice(options.preset, options.protocol))
    plans = make_plans(options, spec)
    for other in [one for one in spec.conditions if one not in planning.own_conditions(spec)]:
        command = f"rewild4d-bench run --table {options.table} --protocol {other.protocol}"
        print(f"not run here: {other.title}, on data of its own: `{command}`", file=sys.stderr)
    if options.plan:
        labels = {_key(planning.row_entry(options.table, row, spec, ())): row.label for row in reversed(spec.rows)}
        for plan in plans:
            _print_plan(plan, labels)
        return 0
    records = run_plans(plans, options, f"table {options.table}")
    if options.json:
        print("[" + ",\n".join(map(to_json, records)) + "]")
    else:
        print_table_verdicts(records)
        print(markdown(_table(options, spec, records)))
        print(f"\nrecords: {options.out}", file=sys.stderr)
    return exit_code(plans, records)


def make_plans(options: Options, spec: Spec) -> list[Plan]:
    """Return a plan for each protocol and prior of the table that has any of the cases which were asked for.

    Raises:
        UserError: a case that no condition has, an unknown name, or a folder that is not there or cannot be written.
    """
    check_numbers(options)
    require_name("datasets", spec.dataset)
    from rewild4d.running import planning
    from rewild4d.running.runner import Plan, choose_cases

    protocols = {one.protocol: find_protocol(spec.dataset, one.protocol) for one in planning.own_conditions(spec)}
    entries = planning.entries(options.table, spec, tuple(dict.fromkeys(options.seeds or spec.seeds)))
    chosen = plan_fields(options)
    root, reader = open_dataset(spec.dataset, options.data, options)
    found = {
        (name, prior): _cases(options, reader, protocols[name], patterns)
        for (name, prior), patterns in planning.cases_of_conditions(spec).items()
    }
    wanted = choose_cases(list(dict.fromkeys(itertools.chain(*found.values()))), options.case)
    plans = []
    for (name, prior), known in found.items():
        protocol, cases = protocols[name], tuple(case for case in known if case in wanted)
        if not cases:
            continue
        floors = lower_bounds(protocol, [entry.method for entry in entries])
        plans.append(
            Plan(
                dataset=spec.dataset, reader=reader, root=root, cases=cases, protocol=protocol,
                entries=(*floors, *entries), prior=choose_prior(prior, spec.preset, reader), **chosen,
            )
        )  # fmt: skip
    return plans


def _cases(options: Options, reader: DatasetReader, protocol: Protocol, patterns: Sequence[str]) -> tuple[str, ...]:
    """Return the cases of the table that the data has; where the table names none, the default cases of the data."""
    from rewild4d.commands.choice import cases_of

    preferred = getattr(reader, "default_cases", None)
    free = not patterns and not options.case
    names = preferred(protocol.selection) if preferred and free else reader.cases(protocol.selection)
    found, note = cases_of(options.table, names, patterns)
    if note:
        print(note, file=sys.stderr)
    return found


def _table(options: Options, spec: Spec, records: list[RunRecord]) -> Table:
    from rewild4d.leaderboard.tables import named_table
    from rewild4d.running import planning

    rows, notes = planning.entrants(options.table, spec, records)
    return named_table(planning.frame(options.table, spec, notes), rows, planning.reported(spec))


def _print_plan(plan: Plan, labels: dict[str, str]) -> None:
    """Print a line for each run: whether it has a good record, its row, its folder."""
    from rewild4d.running.runner import list_jobs

    for job in list_jobs(plan):
        label = labels.get(_key(job.entry), job.entry.method)
        print("done   " if job.finished() else "missing", f"{label:<20} {job.folder}")


def _key(entry: Entry) -> str:
    return f"{entry.method} {msgspec.json.encode(entry.config, order='deterministic').decode()}"
