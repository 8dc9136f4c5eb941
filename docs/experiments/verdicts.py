"""Hold each claim of the paper's tables on Artemis against records of the reproduction study (reproduction.md).

python docs/experiments/verdicts.py results/2026-11-26-reproduction

prints a Markdown table for each of the tables `reproduction*` that has records there: what the paper's method has less
what a row has, in the paper and here with the 95 % interval of a bootstrap over cases and seeds, and a verdict. "Seen":
the interval is on the paper's side of zero. "Opposite": it is on the other side. "Not seen": it holds zero. "Not run":
there is no pair of records.
"""

import sys
from collections.abc import Sequence
from pathlib import Path

from rewild4d.commands.choice import chosen, printed
from rewild4d.leaderboard.cells import values_of
from rewild4d.leaderboard.records import RunRecord, find_records
from rewild4d.leaderboard.specs import load_reported, load_specs
from rewild4d.leaderboard.statistics import paired
from rewild4d.leaderboard.tables import Entrant
from rewild4d.leaderboard.titles import TITLES, better_of, digits_of
from rewild4d.running import planning

REFERENCE = "Ours"
SHAPE = {"w/o compact": -1, "w/o smooth": -1}
"""Rows that the paper shows in pictures alone, as worse: its sign in every score."""


def claims(score: str) -> dict[str, float]:
    """Return by row what the paper's method has less the row, in the paper; of a score that it did not print, +1 or -1
    where it shows the row to be worse."""
    found: dict[str, float] = {}
    for name in ("ablation", "artemis"):
        cells = {row.label: row.cells.get(score) for row in load_reported(name).rows}
        own = next((value for label, value in cells.items() if label in ("Full", "Ours")), None)
        for label, value in cells.items():
            if own is not None and value is not None and label not in ("Full", "Ours"):
                found[label] = own - value
    return found


def verdict(low: float, high: float, sign: float) -> str:
    """Name the side of zero that an interval is on, seen from the paper's sign."""
    if low <= 0 <= high:
        return "not seen"
    return "seen" if (low > 0) == (sign > 0) else "opposite"


def line(entrant: Entrant, own: Entrant, condition: int, score: str, digits: int) -> str:
    """Compare one row under one condition with the paper's method."""
    label = entrant.label.replace(" (20 bones)", "")
    values = [values_of(each.records[condition], score) for each in (own, entrant)]
    title, reported = TITLES[score], claims(score).get(label)
    sign = 1 if better_of(score, {}) == "higher" else -1
    said = "worse, in pictures" if reported is None else f"{reported:+.{max(3, digits)}f}"
    said = "—" if reported is None and label not in SHAPE else said
    if not set(values[0]) & set(values[1]):
        return f"| {entrant.label} | {title} | {said} | | not run |"
    found = paired(*values)
    low, high = found.interval or (found.mean, found.mean)
    here = f"{found.mean:+.{digits}f} ({low:+.{digits}f} to {high:+.{digits}f}; {found.cases} cases)"
    if found.interval is None:
        return f"| {entrant.label} | {title} | {said} | {here} | one seed |"
    return f"| {entrant.label} | {title} | {said} | {here} | {verdict(low, high, reported or sign)} |"


def lines(name: str, records: Sequence[RunRecord]) -> list[str]:
    """Make the tables of one named table, one a condition; none where the paper's method has no record."""
    full, _ = printed(name, chosen(name, load_specs()[name], planning.Choice()), "", records)
    entrants, _ = planning.entrants(name, full, records)
    entrants = entrants[: len(full.rows)]
    own = next(entrant for entrant in entrants if entrant.label == REFERENCE)
    made: list[str] = []
    for index, condition in enumerate(full.conditions):
        if not own.records[index]:
            continue
        made += [f"\n{' '.join(filter(None, (full.title, condition.title)))}, `{condition.protocol}`:\n"]
        made += ["| row | score | paper | here (95 % interval) | verdict |", "|---|---|---:|---:|---|"]
        for entrant in entrants:
            for score in full.scores if entrant is not own else ():
                made.append(line(entrant, own, index, score, digits_of(score, "dB" if score == "psnr" else "1")))
    return made


def main(words: list[str]) -> int:
    if len(words) != 1 or not Path(words[0]).is_dir():
        print(__doc__, file=sys.stderr)
        return 2
    records = [record for _, record in find_records(Path(words[0]))]
    print("\n".join(text for name in load_specs() if name.startswith("reproduction") for text in lines(name, records)))
    return 0


if __name__ == "__main__":
    raise SystemExit(main(sys.argv[1:]))
