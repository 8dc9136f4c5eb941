"""Distances pooled over cases: one KID or FVD over the features of all cases, from the files beside the records.

The mean over cases is another number: each case alone has few samples, and FVD of few samples is mostly bias. Only a
method with features of every case is pooled, so that all rows of a table are computed from the same videos.
"""

from collections.abc import Mapping, Sequence
from pathlib import Path

from rewild4d.errors import UserError
from rewild4d.leaderboard.cells import figure
from rewild4d.leaderboard.layout import Cell, Column, Table
from rewild4d.leaderboard.records import RunRecord
from rewild4d.leaderboard.statistics import estimate
from rewild4d.leaderboard.tables import Entrant, Frame, cases_of, ranked, rests_on, row_of
from rewild4d.leaderboard.titles import TITLES, digits_of
from rewild4d.leaderboard.variants import by_protocol, latest, variants
from rewild4d.metrics.names import KINDS
from rewild4d.metrics.score import Distance
from rewild4d.metrics.sets import FILE, Compared, distances, pool, read_features

NAMES = {name: kind for kind, scores in KINDS.items() for name in scores}
"""Score -> the kind of sets that it is a distance of."""
Found = tuple[Path, RunRecord]


class NotPooled(Exception):
    """Why a score of a method cannot be pooled."""


def pooled_tables(found: Sequence[Found]) -> list[Table]:
    """Make a table per (data set, protocol) that scores sets: a row a method, all cases pooled; see `pooled_table`.

    Args:
        found: records, each with the folder that holds it and its features.
    """
    tables = []
    for group in by_protocol([record for _, record in found]):
        protocol = group[0].protocol
        if not any(name in NAMES for name in protocol["scores"]):
            continue
        kept, remarks = latest(group)
        caption = f"Protocol `{protocol['name']}`."
        frame = Frame(protocol["name"], protocol["title"], caption, ("",), tuple(protocol["scores"]), tuple(remarks))
        entrants = [Entrant(variant.label, (variant.records,)) for variant in variants(kept)]
        tables.append(pooled_table(frame, entrants, found))
    return tables


def pooled_table(frame: Frame, entrants: Sequence[Entrant], found: Sequence[Found]) -> Table:
    """Make a table whose rows are entrants, columns scores of sets, over all cases of a condition at once.

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
    cases = [cases_of(entrants, index) for index in range(len(frame.conditions))]
    rows = []
    for entrant in entrants:
        cells: list[Cell] = []
        for records, wanted in zip(entrant.records, cases, strict=True):
            if entrant.absent or not records:
                cells += [Cell("n/a", note=entrant.absent or "no record yet")] * len(names)
                continue
            by_kind = {kind: _cells(records, wanted, kind, folders) for kind in {NAMES[name] for name in names}}
            cells += [by_kind[NAMES[name]][name] for name in names]
        rows.append(row_of(entrant, cells))
    columns = tuple(Column(TITLES[name], "lower", condition, name) for condition in frame.conditions for name in names)
    remarks = (*rests_on(frame, entrants, "Pooled over"), *frame.remarks)
    title = f"{frame.title}: all cases pooled"
    return Table(
        f"{frame.name}-pooled", title, frame.caption, ("method",), columns, tuple(ranked(rows, columns)), remarks
    )


def _cells(
    records: Sequence[RunRecord], cases: Sequence[str], kind: str, folders: Mapping[str, Path]
) -> dict[str, Cell]:
    """Make a cell for each score of one kind of sets."""
    try:
        by_seed = _pooled(records, cases, kind, folders)
    except NotPooled as error:
        return {name: Cell("n/a", note=f"not computed: {error}") for name in KINDS[kind]}
    by_score = zip(KINDS[kind], zip(*by_seed, strict=True), strict=True)
    return {name: _cell(name, found, len(cases)) for name, found in by_score}


def _cell(name: str, found: Sequence[Distance], cases: int) -> Cell:
    """Average one score's pooled distances, one a seed; a single one has its interval in brackets."""
    if missing := [each.note for each in found if each.value is None]:
        return Cell("n/a", note=missing[0] or "not computed")
    first, digits = found[0], digits_of(name, "1")
    counts = f"{TITLES[name]}: {cases} cases pooled, n = {first.n}, m = {first.m}"
    note = counts + (f", T = {first.frames}" if first.frames else "") + (f"; {first.note}" if first.note else "")
    mean = estimate({"pooled": {seed: each.value or 0.0 for seed, each in enumerate(found)}})
    return figure(mean, digits, note, first.interval if len(found) == 1 else None)


def _pooled(
    records: Sequence[RunRecord], cases: Sequence[str], kind: str, folders: Mapping[str, Path]
) -> list[list[Distance]]:
    """Compute for each seed the distances of one kind over all cases; `NotPooled` says why there are none."""
    found = []
    for seed in sorted({record.seed for record in records}):
        by_case = {record.case: record for record in records if record.seed == seed}
        if missing := [case for case in cases if case not in by_case]:
            raise NotPooled(f"no result with seed {seed} for {', '.join(missing)}")
        parts = [_sets(by_case[case], kind, folders[by_case[case].features]) for case in cases]
        try:
            found.append(distances(pool(parts)))
        except ValueError as error:
            raise NotPooled(f"{records[0].method}: {error}") from error
    return found


def _sets(record: RunRecord, kind: str, folder: Path) -> Compared:
    """Read the features of one run; `NotPooled` says why there are none."""
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
