"""The PLY container: header, ASCII and binary bodies, scalar and list properties, as arrays."""

import re
from abc import ABC, abstractmethod
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple

import numpy as np

from rewild4d.errors import UserError
from rewild4d.foreign.reading import TEXT, read_bytes, require_room

TYPES = {
    "char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4", "float": "f4",
    "double": "f8", "int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2", "int32": "i4", "uint32": "u4",
    "float32": "f4", "float64": "f8",
}  # fmt: skip
ORDERS = {"binary_little_endian": "<", "binary_big_endian": ">", "ascii": ""}
LONGEST_HEADER = 1 << 20
MOST_DIGITS = 18
"""Of a number of rows."""


@dataclass
class Element:
    """The rows of one element.

    Attributes:
        count: rows.
        columns: scalar properties, each [count]; integers have the type that the header declares, in ASCII files too.
        lists: list properties: length of each row, int64, [count], and all entries one after another.
    """

    count: int
    columns: dict[str, np.ndarray] = field(default_factory=dict)
    lists: dict[str, tuple[np.ndarray, np.ndarray]] = field(default_factory=dict)


class _Property(NamedTuple):
    name: str
    type: str
    length: str | None


def read_elements(path: Path) -> dict[str, Element]:
    """Return all elements of a PLY file by name.

    Raises:
        UserError: no such file, not a PLY, a format or type that does not exist, a body shorter than the header says.
    """
    data = read_bytes(path, "a PLY file that can be read")
    if not re.match(rb"ply\r?\n", data):
        raise UserError(f"{path}: expected a PLY file, which begins with the line 'ply', got another kind of file.")
    end = re.search(rb"\nend_header\r?\n", data[:LONGEST_HEADER])
    if end is None:
        raise UserError(f"{path}: expected a PLY header that ends with 'end_header', got none.")
    order, elements = _header(path, data[: end.start()].decode("ascii", errors="replace").splitlines()[1:])
    body = _Binary(path, data, end.end(), order) if order else _Ascii(path, data[end.end() :])
    return {name: body.element(name, count, properties) for name, count, properties in elements}


def _header(path: Path, lines: list[str]) -> tuple[str, list[tuple[str, int, list[_Property]]]]:
    """Return the byte order ("" for ASCII) and each element's name, rows and properties."""
    order: str | None = None
    elements: list[tuple[str, int, list[_Property]]] = []
    for line in lines:
        match line.split():
            case ["comment" | "obj_info", *_] | []:
                pass
            case ["format", name, "1.0"] if name in ORDERS:
                order = ORDERS[name]
            case ["element", name, count] if count.isdecimal() and len(count) <= MOST_DIGITS:
                elements.append((name, int(count), []))
            case ["property", "list", length, kind, name] if elements:
                elements[-1][2].append(_Property(name, _type(path, kind), _type(path, length)))
            case ["property", kind, name] if elements:
                elements[-1][2].append(_Property(name, _type(path, kind), None))
            case _:
                raise UserError(f"{path}: expected a line of a PLY 1.0 header, got '{line.strip()[:80]}'.")
    if order is None:
        raise UserError(f"{path}: expected a line 'format' in the PLY header, got none.")
    if len({name for name, _, _ in elements}) < len(elements):
        raise UserError(f"{path}: expected elements with different names in the PLY header, got one name twice.")
    for title, rows, properties in elements:
        if rows and not properties:
            raise UserError(f"{path}: expected properties of '{title[:40]}' in the PLY header, got none.")
        if len({item.name for item in properties}) < len(properties):
            raise UserError(f"{path}: expected properties of '{title[:40]}' with different names, got one name twice.")
    return order, elements


def _type(path: Path, name: str) -> str:
    if name not in TYPES:
        raise UserError(f"{path}: expected a PLY type such as float or uchar, got '{name[:40]}'.")
    return TYPES[name]


class _Body(ABC):
    """What follows the header, read from front to back."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def element(self, name: str, count: int, properties: list[_Property]) -> Element:
        """Return the next element, or a sentence that it is cut off."""
        try:
            if any(item.length for item in properties):
                return self._rows(count, properties)
            return Element(count, self._table(count, properties))
        except EOFError as error:
            raise UserError(f"{self.path}: expected {count} rows of '{name}', but the file ends before.") from error

    def _rows(self, count: int, properties: list[_Property]) -> Element:
        """Read rows that hold lists and so have no fixed length."""
        lengths: dict[str, list[int]] = {item.name: [] for item in properties}
        parts: dict[str, list[np.ndarray]] = {item.name: [np.empty(0, item.type)] for item in properties}
        for _ in range(count):
            for item in properties:
                entries = self._entries(item.length) if item.length else 1
                lengths[item.name].append(entries)
                parts[item.name].append(self._take(item.type, entries))
        element = Element(count)
        for item in properties:
            joined = self._typed(item, np.concatenate(parts[item.name]))
            if item.length:
                element.lists[item.name] = (np.array(lengths[item.name], dtype=np.int64), joined)
            else:
                element.columns[item.name] = joined
        return element

    def _entries(self, kind: str) -> int:
        length = float(self._take(kind, 1)[0])
        if not length.is_integer() or length < 0:
            raise UserError(f"{self.path}: expected lists of zero or more entries, got one of {length:g}.")
        return int(length)

    def _typed(self, item: _Property, values: np.ndarray) -> np.ndarray:
        """Return values in the type that the header declares."""
        return values

    @abstractmethod
    def _table(self, count: int, properties: list[_Property]) -> dict[str, np.ndarray]:
        """Return columns of the next rows, all of scalars; EOFError where there are fewer."""

    @abstractmethod
    def _take(self, kind: str, count: int) -> np.ndarray:
        """Return the next values of one type; EOFError where there are fewer."""


class _Binary(_Body):
    def __init__(self, path: Path, data: bytes, place: int, order: str) -> None:
        super().__init__(path)
        self._data, self._place, self._order = data, place, order

    def _table(self, count: int, properties: list[_Property]) -> dict[str, np.ndarray]:
        rows = self._next(np.dtype([(item.name, self._order + item.type) for item in properties]), count)
        return {item.name: rows[item.name] for item in properties}

    def _take(self, kind: str, count: int) -> np.ndarray:
        return self._next(np.dtype(self._order + kind), count)

    def _next(self, kind: np.dtype, count: int) -> np.ndarray:
        end = self._place + count * kind.itemsize
        if end > len(self._data):
            raise EOFError
        values = np.frombuffer(self._data, kind, count, self._place) if end > self._place else np.empty(0, kind)
        self._place = end
        return values


class _Ascii(_Body):
    def __init__(self, path: Path, body: bytes) -> None:
        super().__init__(path)
        require_room(path, TEXT * len(body), "an ASCII PLY file")
        try:
            self._values = np.array(body.split(), dtype=np.float64)
        except ValueError as error:
            raise UserError(f"{path}: expected numbers in the body of an ASCII PLY file, but {error}.") from error
        self._place = 0

    def _table(self, count: int, properties: list[_Property]) -> dict[str, np.ndarray]:
        table = self._take("f8", count * len(properties)).reshape(count, len(properties))
        return {item.name: self._typed(item, table[:, index]) for index, item in enumerate(properties)}

    def _typed(self, item: _Property, values: np.ndarray) -> np.ndarray:
        """Integers become what the header declares: their range says what they mean."""
        if item.type.startswith("f"):
            return values
        limits = np.iinfo(item.type)
        fits = (values >= limits.min) & (values <= limits.max) & (values == np.floor(values))
        if not fits.all():
            wanted = f"whole numbers from {limits.min} to {limits.max} in '{item.name[:40]}', as its type says"
            raise UserError(f"{self.path}: expected {wanted}, got {values[~fits][0]:g}.")
        return values.astype(item.type)

    def _take(self, kind: str, count: int) -> np.ndarray:
        end = self._place + count
        if end > len(self._values):
            raise EOFError
        values, self._place = self._values[self._place : end], end
        return values
