"""Tables from records, and from nothing else."""

import statistics
from collections import defaultdict
from collections.abc import Iterable, Sequence

from rewild4d.leaderboard.records import RunRecord

TITLES = {"psnr": "PSNR", "ssim": "SSIM", "psnr_fg": "PSNR foreground", "iou": "mask IoU"}
DIGITS = {"dB": 2, "1": 3}


def markdown(records: Sequence[RunRecord]) -> str:
    """One Markdown table per (data set, protocol): a row per method and case, and the mean where cases are several.

    A cell is the mean over seeds, with the standard deviation where there are several. Methods are averaged over cases
    only where they were run on the same set of cases; otherwise the mean row says which are missing.
    """
    groups: dict[tuple[str, str], list[RunRecord]] = defaultdict(list)
    for record in records:
        groups[record.dataset, record.protocol["name"]].append(record)
    return "\n\n".join(_table(group) for _, group in sorted(groups.items())) or "no records"


def _table(records: list[RunRecord]) -> str:
    protocol = records[0].protocol
    scores = list(protocol["scores"])
    units = {name: score.unit for record in records for name, score in record.scores.items()}
    head = ["case", "method", *(_title(name, units) for name in scores), "seeds", "fit, s"]
    rows = [head, ["---"] * 2 + ["---:"] * (len(head) - 2)]
    cases = list(dict.fromkeys(record.case for record in records))
    methods = list(dict.fromkeys((record.method, record.preset) for record in records))
    for case in cases:
        for method in methods:
            runs = [r for r in records if r.case == case and (r.method, r.preset) == method]
            if runs:
                rows.append([case, _label(method, methods), *_cells(runs, scores)])
    if len(cases) > 1:
        rows += [_mean_row(method, methods, records, cases, scores) for method in methods]
    lines = ["| " + " | ".join(row) + " |" for row in rows]
    notes = sorted({f"{r.case}, {r.method}: failed: {r.error}" for r in records if r.status != "ok"})
    caption = f"**{protocol['title']}** (`{protocol['name']}`; {_coverage(records)})"
    return "\n".join([caption, "", *lines, *(f"\n{note}" for note in notes)])


def _title(name: str, units: dict[str, str]) -> str:
    unit = units.get(name, "1")
    return TITLES.get(name, name) + (f", {unit}" if unit != "1" else "")


def _label(method: tuple[str, str], methods: Iterable[tuple[str, str]]) -> str:
    """The method, with its preset where the table holds several of it."""
    several = sum(other[0] == method[0] for other in methods) > 1
    return f"{method[0]} ({method[1]})" if several else method[0]


def _cells(runs: list[RunRecord], scores: list[str]) -> list[str]:
    good = [run for run in runs if run.status == "ok"]
    cells = []
    for name in scores:
        found = [run.scores[name] for run in good if name in run.scores]
        values = [score.value for score in found if score.value is not None]
        cells.append(_number(values, found[0].unit) if values else (found[0].note if found else "failed"))
    seeds = str(len(good)) if len(good) == len(runs) else f"{len(good)} of {len(runs)}"
    seconds = f"{statistics.fmean(run.timing.fit_seconds for run in good):.0f}" if good else "-"
    return [*cells, seeds, seconds]


def _mean_row(
    method: tuple[str, str],
    methods: list[tuple[str, str]],
    records: list[RunRecord],
    cases: list[str],
    scores: list[str],
) -> list[str]:
    """Mean over cases of the mean over seeds, or what is missing: unequal sets are not averaged."""
    own = [r for r in records if (r.method, r.preset) == method and r.status == "ok"]
    missing = [case for case in cases if case not in {r.case for r in own}]
    label = _label(method, methods)
    if missing:
        return ["**mean**", label, *[f"not computed: no result for {', '.join(missing)}"] * len(scores), "", ""]
    cells = []
    for name in scores:
        per_case = [[r.scores[name].value for r in own if r.case == case] for case in cases]
        known = [[v for v in values if v is not None] for values in per_case]
        if all(known):
            mean = statistics.fmean(statistics.fmean(values) for values in known)
            cells.append(f"{mean:.{DIGITS.get(own[0].scores[name].unit, 3)}f}")
        else:
            cells.append("not computed")
    seconds = f"{statistics.fmean(r.timing.fit_seconds for r in own):.0f}"
    return ["**mean**", label, *cells, "", seconds]


def _number(values: list[float], unit: str) -> str:
    digits = DIGITS.get(unit, 3)
    text = f"{statistics.fmean(values):.{digits}f}"
    return f"{text} ± {statistics.stdev(values):.{digits}f}" if len(values) > 1 else text


def _coverage(records: list[RunRecord]) -> str:
    """What the table's numbers lean on, averaged over its cases."""
    by_case = {record.case: record.coverage for record in records if record.coverage}
    parts = []
    for key, text in (("foreground", "of a held-out image is animal"), ("seen_surface", "of its surface ever shown")):
        values = [found[key] for found in by_case.values() if key in found]
        if values:
            parts.append(f"{100 * statistics.fmean(values):.0f} % {text}")
    return ", ".join(parts) or "coverage unknown"
