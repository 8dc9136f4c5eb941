"""Tables from records, and from nothing else: one per protocol, or one whose rows somebody named."""

import statistics
from collections.abc import Sequence
from dataclasses import dataclass, replace

from rewild4d.errors import unknown_name
from rewild4d.leaderboard.cells import cell, difference, values_of
from rewild4d.leaderboard.formats import markdown as to_markdown
from rewild4d.leaderboard.layout import Cell, Column, Row, Table
from rewild4d.leaderboard.records import RunRecord
from rewild4d.leaderboard.remarks import cases_said, definitions_said, seeds_said
from rewild4d.leaderboard.specs import Reported
from rewild4d.leaderboard.statistics import Estimate, estimate, ranks
from rewild4d.leaderboard.titles import TITLES, better_of, digits_of, known_scores
from rewild4d.leaderboard.variants import (
    Variant,
    by_protocol,
    coverage_text,
    latest,
    marks,
    row_kind,
    scores_of,
    variants,
)
from rewild4d.metrics.names import KINDS

POOLED = "KID and FVD in rows of the mean are means over cases; `table --pooled` computes them over all cases at once."


@dataclass(frozen=True)
class Entrant:
    """A row to fill.

    Attributes:
        label: as printed.
        records: of the row, under each condition.
        absent: why there can be none, or "".
        notes: sentences on the row.
    """

    label: str
    records: tuple[tuple[RunRecord, ...], ...]
    absent: str = ""
    notes: tuple[str, ...] = ()


@dataclass(frozen=True)
class Frame:
    """What a table is about, before its rows.

    Attributes:
        name: for labels and files.
        title: as printed.
        caption: how to read it.
        conditions: titles, "" for a single one.
        scores: names.
        remarks: sentences below.
    """

    name: str
    title: str
    caption: str
    conditions: tuple[str, ...]
    scores: tuple[str, ...]
    remarks: tuple[str, ...] = ()


def markdown(records: Sequence[RunRecord]) -> str:
    """Write one Markdown table per (data set, protocol); see `protocol_tables`."""
    return "\n\n".join(map(to_markdown, protocol_tables(records))) or "no records"


def protocol_tables(records: Sequence[RunRecord]) -> list[Table]:
    """Make a table per (data set, protocol): a row per case and method, and the mean where cases are several.

    A cell is the mean over seeds, with the standard deviation where there are several. A method that was not run on all
    cases has the mean over its own, says how many they are and is not ranked. Runs by several versions of the code
    stand in rows of their own.
    """
    tables = []
    for group in by_protocol(records):
        kept, remarks = latest(group)
        cases = list(dict.fromkeys(record.case for record in kept))
        named = variants(kept)
        frame = _without_missing_sets(_frame(kept, remarks), kept)
        columns = (*columns_of(kept, frame.scores), Column("seeds"), Column("fit, s"))
        over = [[case] for case in cases] + [cases] * (len(cases) > 1)
        rows = []
        for some in over:
            rows += _apart([row for variant in named if (row := _timed_row(variant, some, frame.scores))])
        sets = len(cases) > 1 and any(name in scores for scores in KINDS.values() for name in frame.scores)
        remarks = [*frame.remarks, *definitions_said(kept, frame.scores), *([POOLED] if sets else [])]
        stubs = ("case", "method")
        tables.append(Table(frame.name, frame.title, frame.caption, stubs, columns, tuple(rows), tuple(remarks)))
    return tables


def standings(records: Sequence[RunRecord]) -> list[Table]:
    """Make a table per (data set, protocol): one row a method, its mean over the cases, ranked."""
    tables = []
    for group in by_protocol(records):
        kept, remarks = latest(group)
        entrants = [Entrant(found.label, (found.records,)) for found in variants(kept)]
        tables.append(named_table(_frame(kept, remarks), entrants))
    return tables


def named_table(frame: Frame, entrants: Sequence[Entrant], reported: Reported | None = None) -> Table:
    """Make a table whose rows are entrants, columns scores under conditions, cells means over the cases of a condition.

    The best of a column is bold and the second underlined, as `rewild4d.leaderboard.statistics.ranks` tells them apart
    by the spread over seeds. Lower bounds, reported rows and those that had what the others had not are never ranked.
    Remarks say over which cases the means are, and where nothing is known of the spread.

    Args:
        frame: titles, conditions and scores.
        entrants: rows with their records; the cases of a condition are those that any entrant was run on.
        reported: what the paper printed, below the others.
    """
    if reported is None:
        frame, entrants = _begun(frame, entrants)
    columns = columns_of(runs_of(entrants), frame.scores, frame.conditions)
    cases = [cases_of(entrants, index) for index in range(len(frame.conditions))]
    rows = ranked([
        row_of(entrant, [
            cell(under, names, score, entrant.absent)
            for under, names in zip(entrant.records, cases, strict=True) for score in frame.scores
        ])
        for entrant in entrants
    ], columns)  # fmt: skip
    remarks = [*rests_on(frame, entrants), *frame.remarks, *definitions_said(runs_of(entrants), frame.scores)]
    if reported is not None:
        rows += _reported_rows(reported, columns)
        remarks += [f"{reported.mark.capitalize()}: {reported.source}. {reported.note}"]
    return Table(frame.name, frame.title, frame.caption, ("method",), columns, tuple(rows), tuple(remarks))


def difference_table(frame: Frame, entrants: Sequence[Entrant], against: str) -> Table:
    """Subtract a reference row from every row: mean of the cases' differences, 95 % bootstrap interval in brackets.

    A row that is better than the reference, by an interval without 0, is bold; one that is worse by such an interval is
    not marked. Lower bounds and rows that had what the others had not are never marked.

    Raises:
        UserError: no row of that name.
    """
    reference = next((entrant for entrant in entrants if entrant.label.lower() == against.lower()), None)
    if reference is None:
        raise unknown_name("row", against, [entrant.label for entrant in entrants])
    frame, entrants = _begun(frame, entrants)
    reference = next(entrant for entrant in entrants if entrant.label == reference.label)
    columns = columns_of(runs_of(entrants), frame.scores, frame.conditions)
    rows = []
    for entrant in entrants:
        if entrant is not reference:
            pairs = zip(entrant.records, reference.records, strict=True)
            cells = [difference(*pair, name, entrant.absent) for pair in pairs for name in frame.scores]
            row = row_of(entrant, cells)
            rows.append(_leading(row, columns) if row.kind == "method" else row)
    title = f"{frame.title}: difference to {reference.label}"
    caption = _difference_caption(reference.label, entrants)
    remarks = tuple(filter(None, [_over(frame, entrants), *frame.remarks]))
    return Table(f"{frame.name}-difference", title, caption, ("method",), columns, tuple(_apart(rows)), remarks)


def _begun(frame: Frame, entrants: Sequence[Entrant]) -> tuple[Frame, Sequence[Entrant]]:
    """Leave out the conditions that no row has a record of, and say which; all stay where none has one."""
    kept = [index for index in range(len(frame.conditions)) if cases_of(entrants, index)]
    if len(kept) in (0, len(frame.conditions)):
        return frame, entrants
    absent = "; ".join(title for index, title in enumerate(frame.conditions) if index not in kept)
    remarks = (f"Without any record, and so without columns: {absent}.", *frame.remarks)
    frame = replace(frame, conditions=tuple(frame.conditions[index] for index in kept), remarks=remarks)
    return frame, [replace(one, records=tuple(one.records[index] for index in kept)) for one in entrants]


def runs_of(entrants: Sequence[Entrant]) -> list[RunRecord]:
    """Gather the records of entrants under all conditions."""
    return [record for entrant in entrants for under in entrant.records for record in under]


def row_of(entrant: Entrant, cells: Sequence[Cell]) -> Row:
    """Make the row of an entrant, with what its records say beside their numbers."""
    flags = marks(runs_of([entrant]))
    return Row((entrant.label,), tuple(cells), kind_of(entrant), (*entrant.notes, *flags), flags)


def rests_on(frame: Frame, entrants: Sequence[Entrant], words: str = "Mean over") -> list[str]:
    """Say over which cases and how many seeds the rows' figures are; nothing where nothing was run."""
    seeds = seeds_said([under for entrant in entrants if kind_of(entrant) != "floor" for under in entrant.records])
    return list(filter(None, [_over(frame, entrants, words), seeds]))


def _over(frame: Frame, entrants: Sequence[Entrant], words: str = "Mean over") -> str:
    return cases_said(words, frame.conditions, [cases_of(entrants, i) for i in range(len(frame.conditions))])


def cases_of(entrants: Sequence[Entrant], condition: int) -> list[str]:
    """List the cases that any row was run on under a condition."""
    return list(dict.fromkeys(record.case for entrant in entrants for record in entrant.records[condition]))


def _difference_caption(reference: str, entrants: Sequence[Entrant]) -> str:
    several = any(len(under) > len({run.case for run in under}) for each in entrants for under in each.records)
    drawn = "cases and seeds" if several else "cases alone, as every row has one seed"
    return (
        f"The row less {reference}: behind it is a minus where ↑ stands and a plus where ↓ stands. Mean of the cases' "
        f"differences; in brackets the 95 % interval of a bootstrap over {drawn}. Bold: ahead of {reference} by an "
        "interval without 0."
    )


def _leading(row: Row, columns: Sequence[Column]) -> Row:
    """Mark the differences of a row whose whole interval is on the better side of 0."""
    cells = []
    for found, column in zip(row.cells, columns, strict=True):
        low, high = found.interval or (0.0, 0.0)
        leads = {"higher": low > 0, "lower": high < 0}.get(column.better, False)
        cells.append(replace(found, mark="best" if leads else ""))
    return replace(row, cells=tuple(cells))


def columns_of(
    records: Sequence[RunRecord], scores: Sequence[str], conditions: Sequence[str] = ("",)
) -> tuple[Column, ...]:
    """Make a column for each score under each condition, with unit and direction as the records say."""
    known = known_scores(records)
    titles = {name: about["title"] for record in records for name, about in record.metrics.items() if "title" in about}
    columns = []
    for condition in conditions:
        for name in scores:
            score = known.get(name)
            unit = f", {score.unit}" if score and score.unit != "1" else ""
            columns.append(Column((titles | TITLES).get(name, name) + unit, better_of(name, known), condition, name))
    return tuple(columns)


def _frame(records: Sequence[RunRecord], remarks: Sequence[str]) -> Frame:
    protocol = records[0].protocol
    caption = f"Protocol `{protocol['name']}`. {sentence(coverage_text(records))}"
    scores = scores_of(records)
    return Frame(protocol["name"], protocol["title"], caption, ("",), scores, (*remarks, *_floors(records, scores)))


def _without_missing_sets(frame: Frame, records: Sequence[RunRecord]) -> Frame:
    """Leave out distances between sets that no run has, such as those of one short clip, and say why in a remark."""
    sets = {name for scores in KINDS.values() for name in scores if name in frame.scores}
    notes: dict[str, list[str]] = {}
    for name in frame.scores:
        found = [run.scores[name] for run in records if name in run.scores]
        if name in sets and found and all(score.value is None for score in found):
            notes.setdefault(found[0].note, []).append(name)
    missing = {name for names in notes.values() for name in names}
    scores = tuple(name for name in frame.scores if name not in missing)
    said = tuple(
        f"{', '.join(TITLES[name] for name in names)}: {note or 'not computed'}" for note, names in notes.items()
    )
    return replace(frame, scores=scores, remarks=(*frame.remarks, *said))


def _floors(records: Sequence[RunRecord], scores: Sequence[str]) -> list[str]:
    """Say what a perfect shape would get; nothing where no score has a floor.

    The floor depends on the number of points, so that rows have floors of their own: the sentence tells the lowest and
    the highest of the rows' means, and whose they are.
    """
    shapes = {variant.label: [run for run in variant.records if _has_shape(run)] for variant in variants(records)}
    parts = []
    for name in scores:
        found = {label: values_of(runs, name, lambda score: score.floor) for label, runs in shapes.items()}
        means = sorted((estimate(values).mean, label) for label, values in found.items() if values)
        if means:
            low, high = (f"{mean:.{digits_of(name, '1')}f}" for mean, _ in (means[0], means[-1]))
            shown = low if low == high else f"{low} ({means[0][1]}) to {high} ({means[-1][1]})"
            parts.append(f"{TITLES.get(name, name)} {shown}")
    words = "A second sampling of the true surface by as many points as a row has, which is what a perfect shape gets"
    return [f"{words}: {', '.join(parts)}."] if parts else []


def _has_shape(record: RunRecord) -> bool:
    """Tell whether its scores of the shape have values; the floor of a row without points says nothing."""
    return all(score.value is not None for score in record.scores.values() if score.floor is not None)


def _timed_row(variant: Variant, cases: list[str], scores: Sequence[str]) -> Row | None:
    """Make a row of one case or of the mean over several, with seeds and seconds; None where nothing was run."""
    runs = [record for record in variant.records if record.case in cases]
    if not runs:
        return None
    good = [run for run in runs if run.status == "ok"]
    whole = {run.case for run in good} == set(cases)
    mean = len(cases) > 1
    run_on = len({run.case for run in runs})
    seeds = str(len(good)) if len(good) == len(runs) else f"{len(good)} of {len(runs)}"
    if mean:
        seeds = f"{run_on} of {len(cases)} cases" if run_on < len(cases) else ""
    seconds = f"{statistics.fmean(run.timing.fit_seconds for run in good):.0f}" if whole else "-"
    cells = (*(cell(runs, cases, name) for name in scores), Cell(seeds), Cell(seconds))
    said = marks(variant.records)
    stubs = "mean" if mean else cases[0], variant.label
    return Row(stubs, cells, row_kind(variant.records), said, said, summary=mean)


def kind_of(entrant: Entrant) -> str:
    """Name the kind of its row: "method", "unranked" where it had what the others had not, or "floor"."""
    return row_kind(runs_of([entrant]))


def _apart(rows: list[Row]) -> list[Row]:
    """Sort: methods, then those that are not ranked, then lower bounds; otherwise as they come."""
    order = {"method": 0, "unranked": 1, "floor": 2}
    return sorted(rows, key=lambda row: order[row.kind])


def ranked(rows: Sequence[Row], columns: Sequence[Column]) -> list[Row]:
    """Put methods before those that are not ranked before lower bounds, and mark the best and second method of each
    column; what prints alike is alike."""
    found = []
    for place, column in enumerate(columns):
        cells = [row.cells[place] if row.kind == "method" else Cell("") for row in rows]
        known = [None if c.value is None or c.partial else Estimate(c.value, c.deviation, 0) for c in cells]
        digits = max((len(c.text.partition(" ")[0].partition(".")[2]) for c in cells), default=0)
        found.append(ranks(known, column.better, digits))
    return _apart([
        replace(row, cells=tuple(replace(c, mark=marked[index]) for c, marked in zip(row.cells, found, strict=True)))
        for index, row in enumerate(rows)
    ])  # fmt: skip


def _reported_rows(reported: Reported, columns: Sequence[Column]) -> list[Row]:
    """Make a row for each of a paper's; a dash stands where the paper has one, nothing where it has no such column."""
    rows = []
    for line in reported.rows:
        cells = []
        for column in columns:
            name = f"{column.group}/{column.score}" if column.group else column.score
            value, digits = line.cells.get(name), max(3, digits_of(column.score, "1"))
            dash = "—" if name in line.cells else ""
            cells.append(Cell(dash) if value is None else Cell(f"{value:.{digits}f}", value=value))
        rows.append(Row((f"{line.label} ({reported.mark})",), tuple(cells), "reported"))
    return rows


def sentence(text: str) -> str:
    """Start with a capital and end with a full stop."""
    return text[:1].upper() + text[1:].rstrip(".") + "." if text else ""
