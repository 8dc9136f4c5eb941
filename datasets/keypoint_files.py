"""Keypoint files that people have: BADJA, COCO-like (APTv2, APT-36K, AP-10K), DeepLabCut's and SLEAP's CSV.

Every reader gives, for each frame of a folder, the named points in its pixels or None. What a name means on the
template is said by a mapping file (`priors.landmarks.load_mapping`), never here.
"""

import csv
import json
import math
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import torch

from rewild4d.datasets.keypoints import BADJA_SIZE
from rewild4d.errors import UserError
from rewild4d.types import Keypoints

LIKELY = 0.6
"""Confidence from which a detected point counts as seen (DeepLabCut's own default cut-off)."""

Points = list[tuple[str, float, float, bool]]
"""(name, x, y, visible), pixel centres at +0.5."""


def read_keypoints(path: Path, stems: Sequence[str], size: tuple[int, int]) -> list[Keypoints | None]:
    """Keypoints of the frames of a folder.

    Args:
        path: .json of BADJA or COCO form, .csv of DeepLabCut or SLEAP.
        stems: file names of the frames without their ending, in order; numbers in a CSV count these from 0.
        size: width and height of the frames in pixels.

    Returns:
        One entry per frame; points outside the frame are not visible (`told_outside`).

    Raises:
        UserError: the file is none of these, is broken, or names no frame of the folder.
    """
    try:
        if path.suffix.lower() == ".csv":
            found = _csv(path.read_text(encoding="utf-8-sig"), stems)
        else:
            found = _json(json.loads(path.read_text(encoding="utf-8")), size)
    except OSError as error:
        raise UserError(f"{path}: expected a keypoint file, but: {error.strerror}.") from error
    except (LookupError, TypeError, ValueError, AttributeError, StopIteration, RecursionError, csv.Error) as error:
        raise UserError(
            f"{path}: expected keypoints as BADJA, COCO, DeepLabCut or SLEAP write them, got others ({error!r})."
        ) from error
    result = [_checked(found[stem], size) if stem in found else None for stem in stems]
    if not any(result):
        named = ", ".join(list(found)[:3]) or "none"
        raise UserError(f"{path}: expected keypoints of the frames {stems[0]} to {stems[-1]}, got those of {named}.")
    return result


def told_outside(found: Sequence[Keypoints | None], size: tuple[int, int]) -> str:
    """A sentence on the points that a file marks as seen but that lie outside their frame; "" where there are none."""
    limit = torch.tensor(size)
    count = sum(int(((k.points < 0) | (k.points > limit)).any(dim=1).sum()) for k in found if k is not None)
    return f"{count} keypoints outside their frame taken as not visible" if count else ""


def _checked(points: Points, size: tuple[int, int]) -> Keypoints:
    inside = [seen and 0 <= x <= size[0] and 0 <= y <= size[1] for _, x, y, seen in points]
    places = [(x, y) if seen else (0.0, 0.0) for _, x, y, seen in points]
    return Keypoints(tuple(name for name, *_ in points), torch.tensor(places), torch.tensor(inside))


def _json(content: Any, size: tuple[int, int]) -> dict[str, Points]:
    if isinstance(content, list):
        return _badja(content, size)
    return _coco(content)


def _badja(entries: list[Mapping[str, Any]], size: tuple[int, int]) -> dict[str, Points]:
    across, down = size[0] / BADJA_SIZE[0], size[1] / BADJA_SIZE[1]
    return {
        Path(entry["image_path"]).stem: [
            (str(joint), (column + 0.5) * across, (row + 0.5) * down, bool(seen))
            for joint, ((row, column), seen) in enumerate(zip(entry["joints"], entry["visibility"], strict=True))
        ]
        for entry in entries
    }


def _coco(content: Mapping[str, Any]) -> dict[str, Points]:
    """The annotation with the largest box of each image."""
    stems = {image["id"]: _stem(image["file_name"]) for image in content["images"]}
    names = {category["id"]: category["keypoints"] for category in content["categories"]}
    largest: dict[str, float] = {}
    found: dict[str, Points] = {}
    for entry in content["annotations"]:
        stem, box = stems[entry["image_id"]], entry["bbox"]
        if box[2] * box[3] > largest.get(stem, 0.0):
            values = entry["keypoints"]
            triples = zip(values[0::3], values[1::3], values[2::3], strict=True)
            largest[stem] = box[2] * box[3]
            found[stem] = [
                (name, x + 0.5, y + 0.5, v > 0)
                for name, (x, y, v) in zip(names[entry["category_id"]], triples, strict=True)
            ]
    return found


def _csv(text: str, stems: Sequence[str]) -> dict[str, Points]:
    rows = [row for row in csv.reader(text.splitlines()) if row]
    return _sleap(rows, stems) if "frame_idx" in rows[0] else _deeplabcut(rows, stems)


def _sleap(rows: list[list[str]], stems: Sequence[str]) -> dict[str, Points]:
    """Columns frame_idx, instance.score and <node>.x, .y, .score; the instance with the highest score of each frame."""
    at = {name: column for column, name in enumerate(rows[0])}
    nodes = [name[:-2] for name in at if name.endswith(".x")]
    best: dict[str, float] = {}
    found: dict[str, Points] = {}
    for row in rows[1:]:
        stem, total = _counted(row[at["frame_idx"]], stems), _number(row[at["instance.score"]])
        total = -math.inf if math.isnan(total) else total
        if stem not in found or total > best[stem]:
            best[stem] = total
            found[stem] = [
                _detected(name, row[at[f"{name}.x"]], row[at[f"{name}.y"]], _score(row, at, name)) for name in nodes
            ]
    return found


def _score(row: list[str], at: Mapping[str, int], name: str) -> float:
    """A node without a score, as labels by hand are, is certain."""
    score = _number(row[at[f"{name}.score"]]) if f"{name}.score" in at else math.nan
    return 1.0 if math.isnan(score) else score


def _deeplabcut(rows: list[list[str]], stems: Sequence[str]) -> dict[str, Points]:
    """Header rows scorer, (individuals,) bodyparts, coords; of several individuals the first."""
    heads = {row[0].strip(): row for row in rows[:4]}
    parts, coords = heads["bodyparts"], heads["coords"]
    people = heads.get("individuals", [""] * len(parts))
    start = next(column for column, value in enumerate(coords) if value.strip() == "x")
    columns: dict[str, dict[str, int]] = {}
    for column in range(start, len(coords)):
        if people[column] == people[start]:
            columns.setdefault(parts[column], {})[coords[column].strip()] = column
    found = {}
    for row in rows[rows.index(coords) + 1 :]:
        # labels by hand spread the path of an image over the first columns
        label = "/".join(cell for cell in row[:start] if cell.strip())
        found[_counted(label, stems)] = [
            _detected(name, row[at["x"]], row[at["y"]], _number(row[at["likelihood"]]) if "likelihood" in at else 1.0)
            for name, at in columns.items()
        ]
    return found


def _detected(name: str, x: str, y: str, score: float) -> tuple[str, float, float, bool]:
    across, down = _number(x), _number(y)
    return name, across + 0.5, down + 0.5, math.isfinite(across) and math.isfinite(down) and score >= LIKELY


def _number(text: str) -> float:
    return float(text) if text.strip() else math.nan


def _counted(label: str, stems: Sequence[str]) -> str:
    """The frame that a row is about: a bare number counts from 0, all else is the name or path of an image."""
    number = re.fullmatch(r"([0-9]+)(\.0)?", label.strip())
    if number is None:
        return _stem(label)
    index = int(number[1])
    return stems[index] if index < len(stems) else f"number {index}"


def _stem(path: str) -> str:
    return Path(path.replace("\\", "/")).stem
