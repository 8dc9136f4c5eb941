"""Cells of tables: the mean of a score over cases and seeds, the difference to another row, or why there is none."""

from collections import defaultdict
from collections.abc import Callable, Sequence
from dataclasses import replace

from rewild4d.leaderboard.layout import Cell
from rewild4d.leaderboard.records import RunRecord
from rewild4d.leaderboard.remarks import FEW
from rewild4d.leaderboard.statistics import Cases, Estimate, estimate, paired
from rewild4d.leaderboard.titles import digits_of
from rewild4d.leaderboard.variants import version_of
from rewild4d.metrics.names import ALL, KINDS, split_name
from rewild4d.metrics.score import Score


def cell(records: Sequence[RunRecord], cases: Sequence[str], name: str, absent: str = "") -> Cell:
    """Compute mean and spread of a score over cases, or say why there is none.

    A row that was not run on some of the cases has the mean over its own, `Cell.partial`, which says so; one that
    failed on a case, or has no value there, has none. Values of unlike versions of code or weights are not averaged.

    Args:
        records: of one row under one condition.
        cases: of all rows.
        name: of the score.
        absent: why the row can have no records, or "".
    """
    wanted = [record for record in records if record.case in cases]
    good = [record for record in wanted if record.status == "ok"]
    if absent or not wanted:
        return Cell("n/a", note=absent or "no record yet")
    missing = [case for case in cases if all(record.case != case for record in good)]
    if failed := next((record for case in missing for record in wanted if record.case == case), None):
        return Cell("failed", note=f"{failed.case}, {failed.method}: failed: {failed.error}")
    values = values_of(good, name)
    if empty := next((record for record in good if record.case not in values), None):
        return Cell("n/a", note=f"not computed: {_reason(empty, name)}")
    if said := _unlike(good, name):
        return Cell("n/a", note=said)
    found = figure(estimate(values), digits_of(name, _unit(good, name)), _left_out(wanted, name))
    return _partial(found, [case for case in cases if case not in missing], len(cases)) if missing else found


def _partial(found: Cell, cases: Sequence[str], total: int) -> Cell:
    """Mark a mean that is not over all cases."""
    named = f": {', '.join(cases)}" if len(cases) <= FEW else ""
    note = "; ".join(filter(None, (f"{len(cases)} of {total} cases{named}", found.note)))
    return replace(found, note=note, partial=True)


def figure(found: Estimate, digits: int, note: str, interval: tuple[float, float] | None = None) -> Cell:
    """Print a mean with so many digits after the point, its spread, and the interval in brackets if there is one."""
    ends = " [" + ", ".join(f"{end:.{digits}f}" for end in interval) + "]" if interval else ""
    spread = "" if found.spread is None else f"{found.spread:.{digits}f}"
    return Cell(f"{found.mean:.{digits}f}{ends}", spread, "", note, found.mean, found.spread, interval)


def difference(records: Sequence[RunRecord], reference: Sequence[RunRecord], name: str, absent: str = "") -> Cell:
    """Compute the mean of the differences of the cases that both rows have, and its interval, or say why there is none.

    Args:
        records: of one row under one condition.
        reference: of the row that it is compared with, under the same.
        name: of the score.
        absent: why the row can have no records, or "".
    """
    values, others = values_of(records, name), values_of(reference, name)
    shared = [case for case in values if case in others]
    if not shared:
        return Cell("n/a", note=absent or _no_difference(records, reference, name))
    if said := _unlike([run for run in (*records, *reference) if run.case in shared], name, one_row=False):
        return Cell("n/a", note=said)
    found, digits = paired(values, others), digits_of(name, _unit(records, name))
    interval = " [" + ", ".join(_signed(end, digits) for end in found.interval) + "]" if found.interval else ""
    left = sorted(set(values) ^ set(others))
    notes = [f"over {len(shared)} cases; only one side has {', '.join(left)}"] if left else []
    notes += [_left_out([run for run in side if run.case in shared], name) for side in (records, reference)]
    note = "; ".join(dict.fromkeys(filter(None, notes)))
    return Cell(_signed(found.mean, digits) + interval, note=note, value=found.mean, interval=found.interval)


def values_of(
    records: Sequence[RunRecord], name: str, quantity: Callable[[Score], float | None] = lambda score: score.value
) -> Cases:
    """Gather by case and seed, from good records, a score's value (or another quantity of it) where there is one."""
    values: dict[str, dict[int, float]] = defaultdict(dict)
    for record in records:
        score = record.scores.get(name) if record.status == "ok" else None
        found = None if score is None else quantity(score)
        if found is not None:
            values[record.case][record.seed] = found
    return dict(values)


def _unlike(records: Sequence[RunRecord], name: str, one_row: bool = True) -> str:
    """Say that values of a score are by unlike versions of a metric, of weights or, in one row, of code; "" where they
    are not."""
    versions = {version_of(record): record.case for record in reversed(records) if record.scores.get(name)}
    if one_row and len(versions) > 1:
        listed = " and ".join(f"{case} by {said or 'unknown code'}" for said, case in sorted(versions.items()))
        return f"not averaged: {listed}"
    found: dict[str, str] = {}
    for record in records:
        score = record.scores.get(name)
        if (said := _measured_by(record, name)) and score is not None and score.value is not None:
            found.setdefault(said, record.case)
    listed = " and ".join(f"{case} by {said}" for said, case in found.items())
    return f"not averaged: {listed}; `rewild4d-bench evaluate` scores again" if len(found) > 1 else ""


def _measured_by(record: RunRecord, name: str) -> str:
    """Name what a score depends on beside our code: another package, or weights; "" where that is not known."""
    if about := record.metrics.get(name):
        return " ".join(filter(None, map(about.get, ("package", "version", "sources"))))
    titles = {title: score for scores in KINDS.values() for score, title in scores.items()}
    distances = {titles.get(one.name.partition(" [")[0]): one.digest for one in record.distances}
    digest = distances.get(name) or record.networks.get(split_name(name)[0], "")
    return f"weights {digest[:8]}" if digest else ""


def _unit(records: Sequence[RunRecord], name: str) -> str:
    """Return the unit of a score; "1" where none of the records has it."""
    return next((record.scores[name].unit for record in records if name in record.scores), "1")


def _reason(record: RunRecord, name: str) -> str:
    """Say why a good record has no value."""
    score = record.scores.get(name)
    if score is None and name in ALL:
        return f"{record.protocol['name']} does not measure it"
    if score is None:
        return "it was scored without this metric's package; `rewild4d-bench evaluate` scores it again"
    return score.note.removeprefix("not computed: ")


def _left_out(records: Sequence[RunRecord], name: str) -> str:
    """Say which runs and which items are left out of the mean; "" where none are."""
    failed = [record for record in records if record.status != "ok"]
    values = values_of(records, name)
    empty = [r for r in records if r.status == "ok" and r.seed not in values.get(r.case, {})]
    notes = [f"{len(failed)} of {len(records)} runs failed: {failed[0].error}"] if failed else []
    if empty:
        notes.append(f"{len(empty)} of {len(records)} runs without a value, left out: {_reason(empty[0], name)}")
    partial = [
        f"{r.case}: {score.note.partition('; ')[0]}"
        for r in records
        if (score := r.scores.get(name)) and score.note and score.value is not None and None in score.per_item
    ]
    return "; ".join(notes + partial[:1])


def _no_difference(records: Sequence[RunRecord], reference: Sequence[RunRecord], name: str) -> str:
    """Say why no case has a value on both sides."""
    cases = [record.case for record in records]
    common = list(dict.fromkeys(record.case for record in reference if record.case in cases))
    if not common:
        return "no case in common" if records and reference else "no record yet"
    found = (cell(side, common, name) for side in (records, reference))
    return next(each.note for each in found if each.value is None)


def _signed(value: float, digits: int) -> str:
    return f"{value:+.{digits}f}".replace("-", "−")
