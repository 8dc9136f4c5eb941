"""Scores of sets pooled over cases: one distance over the features of all of them, from the files beside the records.

The mean over cases of KID or FVD is another number: each case alone has few samples, and FVD of few is mostly bias.
Only a method with features of every case is pooled, so that rows of one table lean on the same videos.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

from rewild4d.errors import UserError
from rewild4d.leaderboard.layout import Cell, Column, Row, Table
from rewild4d.leaderboard.records import RunRecord
from rewild4d.leaderboard.statistics import Estimate, estimate, ranks
from rewild4d.leaderboard.tables import Entrant, Frame, by_protocol, cases_of, kind_of, rests_on
from rewild4d.leaderboard.titles import TITLES, digits_of
from rewild4d.leaderboard.variants import latest, marks, variants
from rewild4d.metrics.names import KINDS
from rewild4d.metrics.samples import Distance
from rewild4d.metrics.sets import FILE, Compared, distances, pool, read_features

NAMES = {name: kind for kind, scores in KINDS.items() for name in scores}
"""Score -> the kind of sets that it is a distance of."""
Found = tuple[Path, RunRecord]


class NotPooled(Exception):
    """Why a score of a method cannot be pooled."""


def pooled_tables(found: Sequence[Found]) -> list[Table]:
    """A table per (data set, protocol) that scores sets: a row a method, all its cases pooled; see `pooled_table`.

    Args:
        found: records, each with the folder that holds it and its features.
    """
    tables = []
    for group in by_protocol([record for _, record in found]):
        protocol = group[0].protocol
        if not any(name in NAMES for name in protocol["scores"]):
            continue
        kept, remarks = latest(group)
        caption = f"`{protocol['name']}`"
        frame = Frame(protocol["name"], protocol["title"], caption, ("",), tuple(protocol["scores"]), tuple(remarks))
        entrants = [Entrant(variant.label, (variant.records,)) for variant in variants(kept)]
        tables.append(pooled_table(frame, entrants, found))
    return tables


def pooled_table(frame: Frame, entrants: Sequence[Entrant], found: Sequence[Found]) -> Table:
    """Rows are entrants, columns are scores of sets under conditions, over all cases of the condition at once.

    A cell is the mean over seeds of the pooled distance, each seed pooled on its own; where there is one seed, the 95 %
    interval of a bootstrap over cases stands in brackets. Notes give n, m and T.

    Args:
        frame: titles, conditions and scores; those that are not of sets are left out.
        entrants: rows with their records; the cases of a condition are those that any entrant was run on.
        found: the same records (and others), each with the folder that holds it and its features.

    Raises:
        UserError: no score of sets among the frame's.
    """
    names = [name for name in frame.scores if name in NAMES]
    if not names:
        raise UserError(f"table '{frame.name}': expected scores of sets to pool ({', '.join(NAMES)}), got none.")
    # By what the file holds: a row may have a copy of the record, with other marks.
    folders = {record.features: folder for folder, record in found}
    rows = []
    for entrant in entrants:
        cells: list[Cell] = []
        for index, records in enumerate(entrant.records):
            cells += _row(entrant, records, cases_of(entrants, index), names, folders)
        everything = [record for under in entrant.records for record in under]
        rows.append(Row((entrant.label,), tuple(cells), kind_of(entrant), (*entrant.notes, *marks(everything))))
    columns = tuple(Column(TITLES[name], "lower", condition, name) for condition in frame.conditions for name in names)
    title, ranked = f"{frame.title}: all cases pooled", _ranked(rows, columns)
    remarks = (*rests_on(frame, entrants, "Pooled over"), *frame.remarks)
    return Table(f"{frame.name}-pooled", title, frame.caption, ("method",), columns, ranked, remarks)


def _row(
    entrant: Entrant,
    records: Sequence[RunRecord],
    cases: Sequence[str],
    names: Sequence[str],
    folders: Mapping[str, Path],
) -> list[Cell]:
    """The cells of one row under one condition, in the order of the names."""
    if entrant.absent or not records:
        return [Cell("n/a", note=entrant.absent or "no record yet") for _ in names]
    cells: dict[str, Cell] = {}
    for kind in dict.fromkeys(NAMES[name] for name in names):
        wanted = [name for name in names if NAMES[name] == kind]
        try:
            cells |= _cells(_pooled(records, cases, kind, folders), wanted, len(cases))
        except NotPooled as error:
            cells |= {name: Cell("n/a", note=f"not computed: {error}") for name in wanted}
    return [cells[name] for name in names]


def _pooled(
    records: Sequence[RunRecord], cases: Sequence[str], kind: str, folders: Mapping[str, Path]
) -> dict[int, list[Distance]]:
    """Seed -> the distances of one kind over all cases.

    Raises:
        NotPooled: a case has no result or no features, or the cases' features do not belong together.
    """
    found: dict[int, list[Distance]] = {}
    for seed in sorted({record.seed for record in records}):
        by_case = {record.case: record for record in records if record.seed == seed}
        if missing := [case for case in cases if case not in by_case]:
            raise NotPooled(f"no result with seed {seed} for {', '.join(missing)}")
        parts = [_sets(by_case[case], kind, folders[by_case[case].features]) for case in cases]
        try:
            found[seed] = distances(pool(parts))
        except ValueError as error:
            raise NotPooled(f"{records[0].method}: {error}") from error
    return found


def _sets(record: RunRecord, kind: str, folder: Path) -> Compared:
    """The features of one run.

    Raises:
        NotPooled: there are none; the text says why.
    """
    if record.status != "ok":
        raise NotPooled(f"{record.case}, {record.method}: failed: {record.error}")
    try:
        sets = read_features(folder / FILE, record.features) if record.features else {}
    except UserError as error:
        raise NotPooled(str(error).removesuffix(".")) from error
    if kind in sets:  # also where they are too few for a distance of this case alone
        return sets[kind]
    score = record.scores.get(kind)
    if score is not None and score.value is None:
        raise NotPooled(f"{record.case}: {score.note.removeprefix('not computed: ')}")
    if not record.features:
        raise NotPooled(f"{record.case}: no features are kept beside its record; `rewild4d-bench evaluate` makes them")
    raise NotPooled(f"{record.case}: its features are not of {TITLES[kind]}")


def _cells(by_seed: dict[int, list[Distance]], names: Sequence[str], cases: int) -> dict[str, Cell]:
    """Score -> its cell."""
    cells = {}
    places = {name: list(KINDS[NAMES[name]]).index(name) for name in names}
    for name, place in places.items():
        found = {seed: each[place] for seed, each in by_seed.items()}
        first = next(iter(found.values()))
        values = {seed: each.value for seed, each in found.items() if each.value is not None}
        if len(values) < len(found):
            reason = next(each.note for each in found.values() if each.value is None)
            cells[name] = Cell("n/a", note=reason or "not computed")
            continue
        mean, digits = estimate({"pooled": values}), digits_of(name, "1")
        interval = first.interval if len(found) == 1 else None
        shown = "" if interval is None else " [" + ", ".join(f"{end:.{digits}f}" for end in interval) + "]"
        spread = "" if mean.spread is None else f"{mean.spread:.{digits}f}"
        counts = f"{TITLES[name]}: {cases} cases pooled, n = {first.n}, m = {first.m}"
        note = counts + (f", T = {first.frames}" if first.frames else "") + (f"; {first.note}" if first.note else "")
        cells[name] = Cell(f"{mean.mean:.{digits}f}{shown}", spread, "", note, mean.mean, mean.spread, interval)
    return cells


def _ranked(rows: list[Row], columns: Sequence[Column]) -> tuple[Row, ...]:
    """The rows, methods before those that compete with nobody before floors, the best of each column marked."""
    competing = [row for row in rows if row.kind != "unranked"]
    by_column = []
    for place, column in enumerate(columns):
        cells = [row.cells[place] for row in competing]
        known = [Estimate(c.value, c.deviation, 0) if c.value is not None else None for c in cells]
        by_column.append(ranks(known, "lower", digits_of(column.score, "1")))
    marked = {id(row): _marked(row, found) for row, found in zip(competing, zip(*by_column, strict=True), strict=True)}
    order = {"method": 0, "unranked": 1, "floor": 2}
    return tuple(sorted((marked.get(id(row), row) for row in rows), key=lambda row: order[row.kind]))


def _marked(row: Row, found: Sequence[str]) -> Row:
    return replace(row, cells=tuple(replace(cell, mark=mark) for cell, mark in zip(row.cells, found, strict=True)))
