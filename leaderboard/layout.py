"""A table before it has a format: what every writer of rewild4d.leaderboard.formats prints."""

from dataclasses import dataclass
from functools import cached_property
from itertools import groupby

Kind = str
"""Of a row: "method", "unranked" (it had what the others had not), "floor" (lower bound) or "reported" (by a paper)."""


@dataclass(frozen=True)
class Column:
    """One score under one condition.

    Attributes:
        title: with its unit.
        better: "higher", "lower" or "" for text.
        group: the condition; columns of one group stand together under its title, "" has none.
        score: name of the score in the records, "" for text.
    """

    title: str
    better: str = ""
    group: str = ""
    score: str = ""


@dataclass(frozen=True)
class Cell:
    """One figure, or why there is none.

    Attributes:
        text: the figure as printed, or "n/a", "failed", "".
        spread: over seeds as printed, "" for none.
        mark: "best", "second" or "".
        note: one sentence: why there is no figure, or what it leaves out.
        value: the figure, None where there is none.
        deviation: the spread, None where there is none.
        interval: ends of the 95 % interval of a difference, None for other figures.
        partial: whether it is over some of the cases that other rows have; such figures are not ranked.
    """

    text: str
    spread: str = ""
    mark: str = ""
    note: str = ""
    value: float | None = None
    deviation: float | None = None
    interval: tuple[float, float] | None = None
    partial: bool = False


@dataclass(frozen=True)
class Row:
    """One line.

    Attributes:
        stubs: its titles, one for each of the table's stub columns.
        cells: one for each column.
        kind: rules are drawn between kinds.
        notes: sentences on the whole row.
        flags: those of the notes that keep the row out of the ranking, to be seen at once.
        summary: whether it sums up rows above it; where a format has bold titles, its first one is bold.
    """

    stubs: tuple[str, ...]
    cells: tuple[Cell, ...]
    kind: Kind = "method"
    notes: tuple[str, ...] = ()
    flags: tuple[str, ...] = ()
    summary: bool = False


@dataclass(frozen=True)
class Table:
    """Rows under columns.

    Attributes:
        name: for labels and files.
        title: what was measured.
        caption: how to read it.
        stubs: titles of the leading columns.
        columns: of figures.
        rows: in the order to print.
        remarks: sentences below it that belong to no cell.
    """

    name: str
    title: str
    caption: str
    stubs: tuple[str, ...]
    columns: tuple[Column, ...]
    rows: tuple[Row, ...]
    remarks: tuple[str, ...] = ()

    @cached_property
    def notes(self) -> tuple[str, ...]:
        """List each note of a row or a cell once, in the order in which they are met."""
        found = [note for row in self.rows for note in (*row.notes, *(cell.note for cell in row.cells)) if note]
        return tuple(dict.fromkeys(found))

    @cached_property
    def groups(self) -> list[tuple[str, int]]:
        """List the title of each group of neighbouring columns, and how many they are."""
        return [(title, len(list(columns))) for title, columns in groupby(column.group for column in self.columns)]

    def number(self, *notes: str) -> str:
        """Return the numbers of notes among `notes`, from 1: "1,3", or ""."""
        return ",".join(str(self.notes.index(note) + 1) for note in dict.fromkeys(notes) if note)
