"""Sentences below a table: over which cases its means are, and what is known of the spread over seeds."""

from collections.abc import Collection, Iterable, Sequence

from rewild4d.leaderboard.records import RunRecord
from rewild4d.leaderboard.variants import grouped

FEW = 12
"""More cases than these are counted, not named."""


def cases_said(words: str, titles: Sequence[str], cases: Sequence[Sequence[str]]) -> str:
    """Say how many cases the figures are over, and which; "" where there is no record.

    Args:
        words: that the sentence starts with.
        titles: of the conditions.
        cases: names under each of them; told one by one only where they differ.
    """
    found = [(title, names) for title, names in zip(titles, cases, strict=True) if names]
    if len({frozenset(names) for _, names in found}) == 1:
        found = [("", found[0][1])]
    named = sum(len(names) for _, names in found) <= FEW
    parts = [
        f"{len(names)} case{'s' * (len(names) > 1)}"
        + (f" ({title})" if title else "")
        + (f": {', '.join(names)}" if named else "")
        for title, names in found
    ]
    return f"{words} {'; '.join(parts)}." if parts else ""


def seeds_said(groups: Sequence[Sequence[RunRecord]]) -> str:
    """Say what is known of the spread over seeds; "" where there is no result.

    Args:
        groups: the records behind each mean that competes as a method.
    """
    good = [[run for run in group if run.status == "ok"] for group in groups]
    known = [_has_spread(group) for group in good if group]
    unknown = "nothing is known of the spread over seeds: bold only orders the means."
    if not known:
        return ""
    if all(known):
        return "± is the spread over seeds."
    if any(known):
        return f"± is the spread over seeds; where a row has none, {unknown}"
    if all(len({run.seed for run in group}) <= 1 for group in groups):
        return f"Every row has one seed, so that {unknown}"
    return f"No row has two seeds on all of its cases, so that {unknown}"


def _has_spread(good: Sequence[RunRecord]) -> bool:
    """Tell whether two seeds have a result on every case, as `statistics.estimate` needs for a spread."""
    by_case = grouped(good, lambda run: run.case).values()
    return len(set.intersection(*({run.seed for run in runs} for runs in by_case))) > 1


def definitions_said(records: Iterable[RunRecord], scores: Collection[str]) -> list[str]:
    """Say what the scores of other packages' metrics are and whose, a sentence for each that has said it.

    Args:
        records: of a table.
        scores: of its columns.
    """
    said: dict[tuple[str, str], dict[str, None]] = {}
    for record in records:
        for name, about in record.metrics.items():
            if name in scores and about.get("definition"):
                package = " ".join(filter(None, (about.get("package"), about.get("version"))))
                said.setdefault((about.get("title", name), about["definition"].rstrip(".")), {})[package] = None
    return [f"{title}: {text} (metric of {', '.join(packages)})." for (title, text), packages in said.items()]
