"""Tables of keypoints: DeepLabCut's and SLEAP's CSV, with any separator and in any Unicode encoding."""

import csv
import math
import re
from collections.abc import Mapping, Sequence
from pathlib import Path

from rewild4d.datasets.keypoints.individuals import Instance, Point
from rewild4d.errors import shown

DEEPLABCUT_LIKELY, SLEAP_LIKELY = 0.6, 0.2
"""Confidence from which a detected point counts as seen: the programs' own default cut-offs. SLEAP's is a height of a
peak, rarely above 0.8 on good points."""
SEPARATORS = ",;\t"
WHOLE = r"([0-9]{1,9})(\.0)?"

Animals = dict[str, list[Instance]]
"""All animals of each frame, by the frame's stem."""


def read_table(text: str, stems: Sequence[str]) -> tuple[Animals, float]:
    """Return the animals of each frame, and the confidence from which a point counts.

    Args:
        text: of the file.
        stems: file names of the frames without their ending, in order; bare numbers count these from 0.

    Raises:
        ValueError: another table, or a cell that is not what its column says; the message ends a sentence.
        csv.Error: no table.
    """
    lines = text.splitlines()
    first = next((line for line in lines if line.strip()), "")
    separator = max(SEPARATORS, key=first.count)
    rows = [row for row in csv.reader(lines, delimiter=separator) if any(cell.strip() for cell in row)]
    if rows and "frame_idx" in rows[0]:
        return _sleap(rows, stems, separator), SLEAP_LIKELY
    heads = {row[0].strip(): row for row in rows[:4]}
    if "bodyparts" in heads and "coords" in heads:
        return _deeplabcut(rows, heads, stems, separator), DEEPLABCUT_LIKELY
    raise ValueError(f"a table that begins with '{shown(first)}'")


def _sleap(rows: Sequence[Sequence[str]], stems: Sequence[str], separator: str) -> Animals:
    """Read columns track, frame_idx, instance.score, <node>.x, .y and .score; all but the index may be left out."""
    head = [name.strip() for name in rows[0]]
    nodes = [name[:-2] for name in head if name.endswith(".x") and f"{name[:-2]}.y" in head]
    found: Animals = {}
    for number, cells in enumerate(rows[1:], 2):
        row = dict(zip(head, cells, strict=False))
        cell = _Cells(row, number, separator)
        # a node without a score, as in labels by hand, is certain
        points = [
            (node, cell(f"{node}.x") + 0.5, cell(f"{node}.y") + 0.5, cell(f"{node}.score", 1.0)) for node in nodes
        ]
        scores = [score for _, x, y, score in points if math.isfinite(x) and math.isfinite(y)]
        mean = sum(scores) / len(scores) if scores else 0.0
        animal = Instance(row.get("track", "").strip(), cell("instance.score", mean), tuple(points))
        frame = row.get("frame_idx", "").strip()
        if re.fullmatch(WHOLE, frame) is None:
            raise ValueError(f"'{shown(frame)}' for the number of a frame in row {number}")
        found.setdefault(counted(frame, stems), []).append(animal)
    return found


def _deeplabcut(
    rows: Sequence[Sequence[str]], heads: Mapping[str, Sequence[str]], stems: Sequence[str], separator: str
) -> Animals:
    """Read rows below the headers scorer, (individuals,) bodyparts and coords."""
    parts, coords = heads["bodyparts"], [name.strip() for name in heads["coords"]]
    people = heads.get("individuals", [""] * len(parts))
    if "x" not in coords:
        raise ValueError("no column called x")
    start = coords.index("x")
    if not len(parts) == len(coords) == len(people):
        raise ValueError("headers of different lengths")
    columns: dict[str, dict[str, dict[str, int]]] = {}
    for column in range(start, len(coords)):
        columns.setdefault(people[column].strip(), {}).setdefault(parts[column], {})[coords[column]] = column
    for person, bodyparts in columns.items():
        for part, at in bodyparts.items():
            if not {"x", "y"} <= {*at}:
                raise ValueError(f"no columns x and y of '{shown(' '.join((person, part)).strip())}'")
    found: Animals = {}
    first = rows.index(heads["coords"]) + 1
    for number, row in enumerate(rows[first:], first + 1):
        # labels by hand spread the path of an image over the first columns
        stem = counted("/".join(cell for cell in row[:start] if cell.strip()), stems)
        cell = _Cells({str(column): text for column, text in enumerate(row)}, number, separator)
        found[stem] = [
            Instance(person, 0.0, tuple(_placed(name, at, cell) for name, at in bodyparts.items()))
            for person, bodyparts in columns.items()
        ]
    return {stem: [_scored(animal) for animal in animals] for stem, animals in found.items()}


def _placed(name: str, at: Mapping[str, int], cell: "_Cells") -> Point:
    score = cell(str(at["likelihood"])) if "likelihood" in at else 1.0
    return name, cell(str(at["x"])) + 0.5, cell(str(at["y"])) + 0.5, score


def _scored(animal: Instance) -> Instance:
    """Return an animal whose score is the sum of its likely points."""
    return Instance(animal.track, sum(point[3] for point in animal.found(DEEPLABCUT_LIKELY)), animal.points)


class _Cells:
    """The numbers of a row by the name of their column; an empty cell is NaN."""

    def __init__(self, row: Mapping[str, str], number: int, separator: str) -> None:
        self._row, self._number, self._separator = row, number, separator

    def __call__(self, name: str, missing: float = math.nan) -> float:
        text = self._row.get(name, "").strip()
        if self._separator == ";":  # such tables come from where the decimal sign is a comma
            text = text.replace(",", ".")
        try:
            value = float(text) if text else math.nan
        except ValueError:
            column = f"column {int(name) + 1}" if name.isdecimal() else name
            raise ValueError(f"'{shown(text)}' for a number in row {self._number}, {shown(column)}") from None
        return missing if math.isnan(value) else value


def counted(label: str, stems: Sequence[str]) -> str:
    """Return the frame that a row is about: a bare number counts from 0, all else is the name or path of an image."""
    number = re.fullmatch(WHOLE, label.strip())
    if number is None:
        return stem_of(label)
    index = int(number[1])
    return stems[index] if index < len(stems) else f"number {index}"


def stem_of(path: str) -> str:
    """Return the name of a file without folders, of Windows too, and ending."""
    return Path(path.replace("\\", "/")).stem
