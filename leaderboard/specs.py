"""Tables as data (leaderboard/tables/*.toml) and what the paper printed (leaderboard/paper/*.json)."""

from collections.abc import Mapping
from importlib import resources
from typing import Any, Literal, TypeVar

import msgspec

from rewild4d.errors import unknown_name
from rewild4d.foreign.texts import parse_json, parse_toml

T = TypeVar("T")


class Condition(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """What every row is measured under: a group of columns.

    Attributes:
        title: of the group; may be left out where there is only one.
        protocol: its name; without a version the newest one.
        prior: what `run --prior` says.
        cases: patterns of cases, all where it is left out.
        dataset: name of a data set, the table's where it is left out.
    """

    protocol: str
    title: str = ""
    prior: str = "template"
    cases: tuple[str, ...] = ()
    dataset: str = ""


class Line(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """One row.

    Attributes:
        label: as printed.
        method: its name in the registry.
        settings: what differs from the preset, nested as in a preset file.
        preset: another one than the table's.
        note: a sentence that the table prints below.
    """

    label: str
    method: str
    settings: dict[str, Any] = {}
    preset: str | None = None
    note: str = ""


class Spec(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """One table.

    Attributes:
        title: as printed.
        description: how to read it.
        dataset: name of the data set that `run --table` runs; conditions on others are printed.
        scores: names of the scores, a column each under every condition.
        conditions: groups of columns.
        rows: labels, methods and settings.
        rows_of: name of a table whose rows stand before its own, "" for none.
        preset: where the command line names none.
        seeds: where the command line names none.
        paper: name of the file of reported numbers, "" for none.
    """

    title: str
    dataset: str
    scores: tuple[str, ...]
    conditions: tuple[Condition, ...]
    rows: tuple[Line, ...] = ()
    rows_of: str = ""
    description: str = ""
    preset: str = "standard"
    seeds: tuple[int, ...] = (0, 1, 2)
    paper: str = ""


class ReportedRow(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """One row of a paper's table.

    Attributes:
        label: as printed.
        cells: numbers as printed, None where a dash stands, by the name of the score; in a table of several conditions
            by "title/name".
    """

    label: str
    cells: dict[str, float | None]


class Reported(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """One table of a paper.

    Attributes:
        source: the paper and its table.
        note: why a comparison is loose.
        status: "printed" where it was read in the paper, "unconfirmed" where it was only read in notes on the paper.
    """

    source: str
    note: str
    rows: tuple[ReportedRow, ...]
    status: Literal["printed", "unconfirmed"] = "printed"

    @property
    def mark(self) -> str:
        """What stands behind the label of a row."""
        return "reported" if self.status == "printed" else "reported, unconfirmed"


def load_specs() -> dict[str, Spec]:
    """Read all tables that ship with the package, by name."""
    found = {name: _decode(f"tables/{name}.toml", data, Spec) for name, data in _files("tables", ".toml").items()}
    return {name: msgspec.structs.replace(spec, rows=_rows(spec, found), rows_of="") for name, spec in found.items()}


def _rows(spec: Spec, found: Mapping[str, Spec]) -> tuple[Line, ...]:
    if spec.rows_of and spec.rows_of not in found:
        raise unknown_name("table", spec.rows_of, found)
    return (*(found[spec.rows_of].rows if spec.rows_of else ()), *spec.rows)


def find_spec(name: str) -> Spec:
    """Find the table of that name.

    Raises:
        UserError: there is none.
    """
    specs = load_specs()
    if name not in specs:
        raise unknown_name("table", name, specs)
    return specs[name]


def load_reported(name: str) -> Reported:
    """Find the paper's table of that name.

    Raises:
        UserError: there is none.
    """
    files = _files("paper", ".json")
    if name not in files:
        raise unknown_name("table of the paper", name, files)
    return _decode(f"paper/{name}.json", files[name], Reported)


def _files(folder: str, suffix: str) -> Mapping[str, bytes]:
    entries = sorted((resources.files("rewild4d.leaderboard") / folder).iterdir(), key=lambda entry: entry.name)
    return {entry.name.removesuffix(suffix): entry.read_bytes() for entry in entries if entry.name.endswith(suffix)}


def _decode(path: str, data: bytes, kind: type[T]) -> T:
    parse = parse_json if path.endswith(".json") else parse_toml
    made: T = parse(data, f"leaderboard/{path}", kind.__name__, kind)
    return made
