"""`table`: what was found, from records alone."""

from dataclasses import dataclass
from pathlib import Path

from rewild4d.config import parse_flags
from rewild4d.leaderboard.records import read_records
from rewild4d.leaderboard.tables import markdown


@dataclass(frozen=True)
class Options:
    """Flags of `table`.

    Attributes:
        runs: folder of runs (what `run --out` named).
        protocol: only this protocol's runs.
        case: only these cases.
    """

    runs: Path = Path("runs")
    protocol: str | None = None
    case: tuple[str, ...] = ()


def main(arguments: list[str]) -> int:
    options = parse_flags(
        Options, arguments, prog="rewild4d-bench table", description="Print Markdown tables of the records in a folder."
    )
    records = [
        record
        for record in read_records(options.runs)
        if options.protocol in (None, record.protocol["name"]) and (not options.case or record.case in options.case)
    ]
    print(markdown(records))
    return 0
