"""Read text, JSON and TOML that people give: what the file holds, or one sentence on why it cannot be read."""

import codecs
import json
import tomllib
from importlib.resources.abc import Traversable
from pathlib import Path
from typing import Any, TypeVar, overload

import msgspec

from rewild4d.errors import UserError, reason
from rewild4d.foreign.reading import require_there

T = TypeVar("T")
_MARKS = {
    codecs.BOM_UTF8: "utf-8-sig",
    codecs.BOM_UTF32_LE: "utf-32",  # begins like UTF-16's, so it is looked for first
    codecs.BOM_UTF32_BE: "utf-32",
    codecs.BOM_UTF16_LE: "utf-16",
    codecs.BOM_UTF16_BE: "utf-16",
}


def read_bytes(file: Path | Traversable, expected: str) -> bytes:
    """Return what a file holds.

    Args:
        file: its path.
        expected: what it should be, as a sentence names it: "a keypoint file".

    Raises:
        UserError: it is missing, no regular file, too large (`reading.largest`), or cannot be read.
    """
    if isinstance(file, Path):
        require_there(file, expected)
    try:
        return file.read_bytes()
    except (OSError, ValueError) as error:  # a name with a zero byte is a ValueError
        raise UserError(f"{file}: expected {expected}, but it cannot be read: {reason(error)}.") from error


def read_text(file: Path | Traversable, expected: str) -> str:
    """Return a file's text: UTF-8, or what the byte-order mark at its start says.

    Args:
        file: its path.
        expected: what it should be, as a sentence names it.

    Raises:
        UserError: it cannot be read, or is no text.
    """
    data = read_bytes(file, expected)
    try:
        return decoded(data)
    except UnicodeError as error:
        raise UserError(f"{file}: expected {expected}, but {reason(error)}.") from error


def decoded(data: bytes) -> str:
    """Return the text of some bytes, as `read_text`; a UnicodeError where they are none."""
    encoding = next((encoding for mark, encoding in _MARKS.items() if data.startswith(mark)), "utf-8")
    return data.decode(encoding)


@overload
def read_json(file: Path | Traversable, expected: str) -> Any: ...
@overload
def read_json(file: Path | Traversable, expected: str, kind: type[T]) -> T: ...
def read_json(file: Path | Traversable, expected: str, kind: Any = Any) -> Any:
    """Return what a JSON file holds; errors as `parse_json`."""
    return parse_json(read_bytes(file, expected), file, expected, kind)


@overload
def read_toml(file: Path | Traversable, expected: str) -> Any: ...
@overload
def read_toml(file: Path | Traversable, expected: str, kind: type[T]) -> T: ...
def read_toml(file: Path | Traversable, expected: str, kind: Any = Any) -> Any:
    """Return what a TOML file holds; errors as `parse_toml`."""
    return parse_toml(read_bytes(file, expected), file, expected, kind)


def parse_json(data: bytes | str, name: object, expected: str, kind: Any = Any) -> Any:
    """Return what JSON holds; NaN and Infinity are numbers where any kind will do.

    Args:
        data: the JSON.
        name: of the file, for the message.
        expected: what it should be, as a sentence names it.
        kind: a type that msgspec knows, which the value must fit.

    Raises:
        UserError: it is no JSON, of another kind, nested too deeply, or holds a number that is too long to be read.
    """
    try:
        text = decoded(data) if isinstance(data, bytes) else data
        return json.loads(text) if kind is Any else msgspec.json.decode(text, type=kind)
    except (msgspec.MsgspecError, ValueError, RecursionError) as error:
        raise UserError(f"{name}: expected {expected}, but {_fault(error)}.") from error


def parse_toml(data: bytes | str, name: object, expected: str, kind: Any = Any) -> Any:
    """Return what TOML holds; arguments and errors as of `parse_json`."""
    try:
        text = decoded(data) if isinstance(data, bytes) else data
        return tomllib.loads(text) if kind is Any else msgspec.toml.decode(text, type=kind)
    except (msgspec.MsgspecError, ValueError, RecursionError) as error:
        raise UserError(f"{name}: expected {expected}, but {_fault(error)}.") from error


def _fault(error: Exception) -> str:
    parsers = (json.JSONDecodeError, tomllib.TOMLDecodeError)
    return f"it cannot be parsed ({reason(error)})" if isinstance(error, parsers) else reason(error)
