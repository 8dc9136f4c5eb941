"""Read entries of annotation files (COCO-like, BADJA); count and report those that cannot be used."""

import json
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any, TypeVar

Entry = Mapping[str, Any]
T = TypeVar("T")
_ID = (int, float, str)


class Unusable(ValueError):
    """An entry that cannot be used.

    Args:
        what: such entries do, in the plural: "have no bbox of four numbers".
        got: what this one has: "bbox null".
        group: what it belongs to (a clip) as far as that is known.
    """

    def __init__(self, what: str, got: str, group: str = "") -> None:
        super().__init__(what, got)
        self.what, self.got, self.group = what, got, group


class LeftOut:
    """Entries of a file that were left out, and why."""

    def __init__(self) -> None:
        self.total = 0
        self._found: list[tuple[str, Unusable]] = []

    def usable(self, entries: Sequence[Any], read: Callable[[Entry], T]) -> Iterator[T]:
        """Yield what ``read`` makes of every entry, without those for which it raises `Unusable`."""
        self.total += len(entries)
        for number, entry in enumerate(entries):
            try:
                if not isinstance(entry, Mapping):
                    raise Unusable("are no objects with named values", short(entry))
                result = read(entry)
            except Unusable as fault:
                self._found.append((_label(entry, number), fault))
                continue
            yield result

    def told(self, group: str | None = None) -> list[str]:
        """Return a sentence for every reason, with the first such entry: of all entries, or of one group."""
        chosen = [(label, fault) for label, fault in self._found if group in (None, fault.group)]
        share = f"annotations of {group}" if group else f"of {self.total} annotations"
        sentences = []
        for what in dict.fromkeys(fault.what for _, fault in chosen):
            same = [(label, fault.got) for label, fault in chosen if fault.what == what]
            label, got = same[0]
            sentences.append(f"{len(same)} {share} {what} and are left out; the first ({label}) has {got}")
        return sentences

    @property
    def groups(self) -> set[str]:
        """Those that entries were left out of; "" where it is not known."""
        return {fault.group for _, fault in self._found}


def shown(entry: Entry, key: str) -> str:
    """Return a value as a sentence names it: "bbox null", "no bbox"."""
    return f"{key} {short(entry[key])}" if key in entry else f"no {key}"


def short(value: Any) -> str:
    """Return a value as JSON writes it, cut where it is long."""
    try:
        text = json.dumps(value)
    except RecursionError:
        return "what is nested too deeply"
    return text if len(text) <= 60 else f"{text[:60]}... ({len(text)} characters)"


def _label(entry: Any, number: int) -> str:
    key = next((key for key in ("id", "image_path") if isinstance(entry, Mapping) and key in entry), None)
    return f"number {number}" if key is None else f"{key} {short(entry[key])}"


def listed(table: Any, key: str) -> list[Any]:
    """Return a list of a table, or raise `ValueError` where there is none."""
    if not isinstance(table, Mapping) or not isinstance(table.get(key), list):
        raise ValueError(f"no list called {key}")
    return table[key]


def by_id(items: Sequence[Any], key: str, kind: type) -> dict[Any, Entry]:
    """Return the items that have an id and a value of a kind, by the id and its text; others count as not listed."""
    fit = (item for item in items if isinstance(item, Mapping) and isinstance(item.get(key), kind))
    known = [item for item in fit if isinstance(item.get("id"), _ID)]
    return {str(item["id"]): item for item in known} | {item["id"]: item for item in known}


def look_up(table: Mapping[Any, Entry], entry: Entry, key: str) -> Entry | None:
    """Return what an entry's id stands for, a number in quotes too; None where nothing is listed under it."""
    number = entry.get(key)
    if not isinstance(number, _ID):
        return None
    return table.get(number, table.get(str(number)))


def image_of(images: Mapping[Any, Entry], entry: Entry) -> Entry:
    """Return the image of an annotation, or raise `Unusable` where it is not listed."""
    image = look_up(images, entry, "image_id")
    if image is None:
        raise Unusable("name an image that is not listed", shown(entry, "image_id"))
    return image


def numbers(values: Any) -> list[float]:
    """Return a list of numbers; empty where it is none, or where one is too large for a float."""
    try:
        return [float(value) for value in values] if isinstance(values, list) else []
    except (TypeError, ValueError, OverflowError):
        return []


def box_of(entry: Entry) -> tuple[float, float, float, float]:
    """Return the left, top, width and height, or raise `Unusable`."""
    box = numbers(entry.get("bbox"))
    if len(box) != 4:
        raise Unusable("have no bbox of four numbers", shown(entry, "bbox"))
    return box[0], box[1], box[2], box[3]


def triples_of(entry: Entry, count: int) -> list[float]:
    """Return x, y and v of every keypoint, [3 count], NaN where one is null; or raise `Unusable`."""
    given = entry.get("keypoints")
    values = numbers([math.nan if value is None else value for value in given] if isinstance(given, list) else given)
    if len(values) != 3 * count:
        raise Unusable(f"have other keypoints than {3 * count} numbers", shown(entry, "keypoints"))
    return values
