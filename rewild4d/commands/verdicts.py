"""Print what cannot be trusted in some runs, red before yellow."""

import sys
from collections.abc import Sequence
from typing import TextIO

from rewild4d.contracts import Verdict
from rewild4d.leaderboard.records import RunRecord

MOST = 20
"""Lines of one level under a table; the records have the rest."""


def print_verdicts(records: Sequence[RunRecord], method: str) -> None:
    """Print the verdicts on the runs of one method, and one line where nothing speaks against them."""
    own = [record for record in records if record.method == method and record.verdicts]
    lines = {
        level: [f"{r.case}, seed {r.seed}: {verdict}" for r in own for verdict in r.verdicts if verdict.level == level]
        for level in ("red", "yellow")
    }
    for line in dict.fromkeys((*lines["red"], *lines["yellow"])):
        print(line)
    _print_green(own, any(lines.values()), sys.stdout)


def print_table_verdicts(records: Sequence[RunRecord]) -> None:
    """Print the verdicts on the runs of a table to stderr, so that what is piped is the table.

    Those on masks and on the prior, which methods share, are printed once a case.
    """
    own = [record for record in records if record.verdicts]
    for level in ("red", "yellow"):
        lines = list(dict.fromkeys(_line(r, verdict) for r in own for verdict in r.verdicts if verdict.level == level))
        for line in lines[:MOST]:
            print(line, file=sys.stderr)
        if len(lines) > MOST:
            print(f"{len(lines) - MOST} more verdicts are {level}: see `verdicts` in the records", file=sys.stderr)
    _print_green(own, any(verdict.level != "green" for record in own for verdict in record.verdicts), sys.stderr)


def _line(record: RunRecord, verdict: Verdict) -> str:
    who = f", {record.method}, seed {record.seed}" if verdict.about == "result" else ""
    return f"{record.case}{who}: {verdict}"


def _print_green(own: Sequence[RunRecord], faults: bool, file: TextIO) -> None:
    if own and not faults:
        about = ", ".join(dict.fromkeys(verdict.about for record in own for verdict in record.verdicts))
        print(f"green: {about}: nothing speaks against them", file=file)
    if own:
        print(file=file)
