"""Scores of sets pooled over cases: one distance over the features of all of them, from the files beside the records.

The mean over cases of KID or FVD is another number: each case alone has few samples, and FVD of few is mostly bias.
Only a method with features of every case is pooled, so that rows of one table lean on the same videos.
"""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from rewild4d.errors import UserError
from rewild4d.leaderboard.layout import Cell, Column, Row, Table
from rewild4d.leaderboard.records import RunRecord
from rewild4d.leaderboard.statistics import Estimate, estimate, ranks
from rewild4d.leaderboard.tables import by_protocol
from rewild4d.leaderboard.titles import TITLES, digits_of
from rewild4d.leaderboard.variants import Variant, latest, variants
from rewild4d.metrics.samples import Distance
from rewild4d.metrics.sets import FILE, KINDS, Compared, distances, pool, read_features

NAMES = {name: kind for kind, scores in KINDS.items() for name in scores}
"""Score -> the kind of sets that it is a distance of."""
Found = tuple[Path, RunRecord]


class NotPooled(Exception):
    """Why a score of a method cannot be pooled."""


def pooled_tables(found: Sequence[Found]) -> list[Table]:
    """A table per (data set, protocol) that scores sets: a row a method, all its cases pooled.

    A cell is the mean over seeds of the pooled distance, each seed pooled on its own; where there is one seed, the 95 %
    interval of a bootstrap over cases stands in brackets. Notes give n, m and T.

    Args:
        found: records, each with the folder that holds it and its features.
    """
    folders = {id(record): folder for folder, record in found}
    tables = []
    for group in by_protocol([record for _, record in found]):
        names = [name for name in group[0].protocol["scores"] if name in NAMES]
        if not names:
            continue
        kept, remarks = latest(group)
        cases = list(dict.fromkeys(record.case for record in kept))
        rows = [_row(variant, cases, names, folders) for variant in variants(kept)]
        protocol = group[0].protocol
        title = f"{protocol['title']}: all cases pooled"
        caption = f"`{protocol['name']}`; {len(cases)} cases pooled into one distance: {', '.join(cases)}"
        columns = tuple(Column(TITLES[name], "lower", "", name) for name in names)
        tables.append(
            Table(f"{protocol['name']}-pooled", title, caption, ("method",), columns, _ranked(rows, names), (*remarks,))
        )
    return tables


def _row(variant: Variant, cases: Sequence[str], names: Sequence[str], folders: dict[int, Path]) -> Row:
    cells: dict[str, Cell] = {}
    for kind in dict.fromkeys(NAMES[name] for name in names):
        wanted = [name for name in names if NAMES[name] == kind]
        try:
            cells |= _cells(_pooled(variant, cases, kind, folders), wanted, len(cases))
        except NotPooled as error:
            cells |= {name: Cell("n/a", note=f"not computed: {error}") for name in wanted}
    row_kind = "unranked" if variant.marks else "floor" if variant.is_floor else "method"
    return Row((variant.label,), tuple(cells[name] for name in names), row_kind, variant.marks)


def _pooled(variant: Variant, cases: Sequence[str], kind: str, folders: dict[int, Path]) -> dict[int, list[Distance]]:
    """Seed -> the distances of one kind over all cases.

    Raises:
        NotPooled: a case has no result or no features, or the cases' features do not belong together.
    """
    found: dict[int, list[Distance]] = {}
    for seed in sorted({record.seed for record in variant.records}):
        by_case = {record.case: record for record in variant.records if record.seed == seed}
        if missing := [case for case in cases if case not in by_case]:
            raise NotPooled(f"no result with seed {seed} for {', '.join(missing)}")
        parts = [_sets(by_case[case], kind, folders[id(by_case[case])]) for case in cases]
        try:
            found[seed] = distances(pool(parts))
        except ValueError as error:
            raise NotPooled(f"{variant.label}: {error}") from error
    return found


def _sets(record: RunRecord, kind: str, folder: Path) -> Compared:
    """The features of one run.

    Raises:
        NotPooled: there are none; the text says why.
    """
    if record.status != "ok":
        raise NotPooled(f"{record.case}, {record.method}: failed: {record.error}")
    score = record.scores.get(kind)
    if score is not None and score.value is None:
        raise NotPooled(f"{record.case}: {score.note.removeprefix('not computed: ')}")
    if not record.features:
        raise NotPooled(f"{record.case}: no features are kept beside its record; `rewild4d-bench evaluate` makes them")
    try:
        sets = read_features(folder / FILE, record.features)
    except UserError as error:
        raise NotPooled(str(error).removesuffix(".")) from error
    if kind not in sets:
        raise NotPooled(f"{record.case}: its features are not of {TITLES[kind]}")
    return sets[kind]


def _cells(by_seed: dict[int, list[Distance]], names: Sequence[str], cases: int) -> dict[str, Cell]:
    """Score -> its cell."""
    cells = {}
    places = {name: list(KINDS[NAMES[name]]).index(name) for name in names}
    for name, place in places.items():
        found = {seed: each[place] for seed, each in by_seed.items()}
        first = next(iter(found.values()))
        values = {seed: each.value for seed, each in found.items() if each.value is not None}
        if len(values) < len(found):
            cells[name] = Cell("n/a", note=first.note or "not computed")
            continue
        mean, digits = estimate({"pooled": values}), digits_of(name, "1")
        interval = first.interval if len(found) == 1 else None
        shown = "" if interval is None else " [" + ", ".join(f"{end:.{digits}f}" for end in interval) + "]"
        spread = "" if mean.spread is None else f"{mean.spread:.{digits}f}"
        counts = f"{TITLES[name]}: {cases} cases pooled, n = {first.n}, m = {first.m}"
        note = counts + (f", T = {first.frames}" if first.frames else "") + (f"; {first.note}" if first.note else "")
        cells[name] = Cell(f"{mean.mean:.{digits}f}{shown}", spread, "", note, mean.mean, mean.spread, interval)
    return cells


def _ranked(rows: list[Row], names: Sequence[str]) -> tuple[Row, ...]:
    """The rows, methods before those that compete with nobody before floors, the best of each column marked."""
    competing = [row for row in rows if row.kind != "unranked"]
    marks: dict[int, list[str]] = {id(row): [] for row in competing}
    for place, name in enumerate(names):
        cells = [row.cells[place] for row in competing]
        known = [Estimate(c.value, c.deviation, 0) if c.value is not None else None for c in cells]
        for row, mark in zip(competing, ranks(known, "lower", digits_of(name, "1")), strict=True):
            marks[id(row)].append(mark)
    shown = [_marked(row, marks[id(row)]) if id(row) in marks else row for row in rows]
    order = {"method": 0, "unranked": 1, "floor": 2}
    return tuple(sorted(shown, key=lambda row: order[row.kind]))


def _marked(row: Row, marks: list[str]) -> Row:
    return replace(row, cells=tuple(replace(cell, mark=mark) for cell, mark in zip(row.cells, marks, strict=True)))
