"""Hold each claim of the paper's tables on Artemis against records of the reproduction study (reproduction.md).

python docs/experiments/verdicts.py results/2026-11-26-reproduction [MORE FOLDERS]

prints a Markdown table for each condition of the tables `reproduction*` that has records there. A cell holds what the
paper's method has less what a row has, the 95 % interval of a bootstrap over cases and seeds, and a verdict. "Seen":
the interval is on the paper's side of zero. "Opposite": it is on the other side. "Not seen": it holds zero. With fewer
than `FEW` pairs of fits there is no verdict: an interval over two cases is the two cases.
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
FEW = 3


def claims(score: str) -> dict[str, float]:
    """Return by row what the paper's method has less the row, in the paper, of a score that it printed."""
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


def cell(entrant: Entrant, own: Entrant, condition: int, score: str) -> str:
    """Compare one row under one condition with the paper's method, by one score."""
    label, digits = entrant.label.replace(" (20 bones)", ""), digits_of(score, "dB" if score == "psnr" else "1")
    values = [values_of(each.records[condition], score) for each in (own, entrant)]
    if not set(values[0]) & set(values[1]):
        return "not run"
    found = paired(*values)
    low, high = found.interval or (found.mean, found.mean)
    said = f"{found.mean:+.{digits}f} ({low:+.{digits}f} to {high:+.{digits}f})"
    sign = 1 if better_of(score, {}) == "higher" else -1
    if sum(min(len(values[0][case]), len(values[1][case])) for case in set(values[0]) & set(values[1])) < FEW:
        return said
    return f"{said} **{verdict(low, high, claims(score).get(label) or sign)}**"


def reported(label: str) -> str:
    """Return the paper's difference in PSNR of a row."""
    value = claims("psnr").get(label.replace(" (20 bones)", ""))
    return f"{value:+.2f}" if value is not None else "pictures: worse" if label in SHAPE else "n/a"


def lines(name: str, records: Sequence[RunRecord]) -> list[str]:
    """Make the tables of one named table, one a condition; none where the paper's method has no record."""
    full, _ = printed(name, chosen(name, load_specs()[name], planning.Choice()), "", records)
    entrants, _ = planning.entrants(name, full, records)
    entrants = entrants[: len(full.rows)]
    own = next(entrant for entrant in entrants if entrant.label == REFERENCE)
    made: list[str] = []
    for index, condition in enumerate(full.conditions):
        cases = values_of(own.records[index], full.scores[0]) if own.records[index] else {}
        if not cases:
            continue
        fits, title = sum(map(len, cases.values())), " ".join(filter(None, (full.title, condition.title)))
        made += [f"\n{title}, `{condition.protocol}`, {len(cases)} cases, {fits} fits a row:\n"]
        made += [f"| `ours` less | paper, PSNR | {' | '.join(TITLES[score] for score in full.scores)} |"]
        made += ["|---|---:|" + "---|" * len(full.scores)]
        for entrant in entrants:
            if entrant is not own:
                found = " | ".join(cell(entrant, own, index, score) for score in full.scores)
                made.append(f"| {entrant.label} | {reported(entrant.label)} | {found} |")
    return made


def main(words: list[str]) -> int:
    if not words or not all(Path(word).is_dir() for word in words):
        print(__doc__, file=sys.stderr)
        return 2
    for word in words:
        records = [record for _, record in find_records(Path(word))]
        names = (name for name in load_specs() if name.startswith("reproduction"))
        print("\n".join(text for name in names for text in lines(name, records)))
    return 0


if __name__ == "__main__":
    raise SystemExit(main(sys.argv[1:]))
