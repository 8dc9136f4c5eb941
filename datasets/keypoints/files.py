"""Keypoint files that people have: BADJA, COCO-like (APTv2, APT-36K, AP-10K), DeepLabCut's and SLEAP's CSV.

Every reader gives, for each frame of a folder, the named points in its pixels or None. What a name means on the
template is said by a mapping file (`priors.landmarks.load_mapping`), never here.
"""

import csv
import json
import math
import re
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import torch

from rewild4d.datasets.keypoints import entries
from rewild4d.datasets.keypoints.entries import Entry, LeftOut, Unusable, shown
from rewild4d.datasets.keypoints.keypoints import BADJA_SIZE, OfFrames, badja_joints, bounded, not_used
from rewild4d.errors import UserError
from rewild4d.types import Keypoints

LIKELY = 0.6
"""Confidence from which a detected point counts as seen (DeepLabCut's own default cut-off)."""

Points = list[tuple[str, float, float, bool]]
"""(name, x, y, visible), pixel centres at +0.5."""


def read_keypoints(path: Path, stems: Sequence[str], size: tuple[int, int]) -> OfFrames:
    """Return keypoints of the frames of a folder.

    Args:
        path: .json of BADJA or COCO form, .csv of DeepLabCut or SLEAP.
        stems: file names of the frames without their ending, in order; numbers in a CSV count these from 0.
        size: width and height of the frames in pixels.

    Returns:
        One entry per frame, in which points outside the frame are not visible, and what of the file is not used.

    Raises:
        UserError: the file is none of these, is broken, holds no usable keypoints, or names no frame of the folder.
    """
    left = LeftOut()
    try:
        if path.suffix.lower() == ".csv":
            rows = [row for row in csv.reader(path.read_text(encoding="utf-8-sig").splitlines()) if row]
            found = _sleap(rows, stems) if "frame_idx" in rows[0] else _deeplabcut(rows, stems)
        else:
            content = json.loads(path.read_text(encoding="utf-8"))
            is_badja = isinstance(content, list)
            found = dict(left.usable(content, partial(_badja, size=size))) if is_badja else _coco(content, left)
    except OSError as error:
        raise UserError(f"{path}: expected a keypoint file, but: {error.strerror}.") from error
    except (
        LookupError, TypeError, ValueError, ArithmeticError, AttributeError, StopIteration, RecursionError, csv.Error
    ) as error:  # fmt: skip
        raise UserError(
            f"{path}: expected keypoints as BADJA, COCO, DeepLabCut or SLEAP write them, got others ({error!r})."
        ) from error
    wanted = f"expected keypoints of the frames {stems[0]} to {stems[-1]}"
    faults = "; ".join(left.told())
    if not any(found.values()):
        raise UserError(f"{path}: {wanted}, got none{f': {faults}' if faults else ''}.")
    result = [_checked(found[stem], size) if found.get(stem) else None for stem in stems]
    if not any(result):
        raise UserError(
            f"{path}: {wanted}, got those of {', '.join(list(found)[:3])}{f' ({faults})' if faults else ''}."
        )
    return result, not_used(path, result, size, left)


def _checked(points: Points, size: tuple[int, int]) -> Keypoints:
    places = torch.tensor([(x, y) if seen else (0.0, 0.0) for _, x, y, seen in points])
    return bounded([name for name, *_ in points], places, torch.tensor([seen for *_, seen in points]), size)


def _badja(entry: Entry, size: tuple[int, int]) -> tuple[str, Points]:
    across, down = size[0] / BADJA_SIZE[0], size[1] / BADJA_SIZE[1]
    stem, places, visible = badja_joints(entry)
    return stem, [
        (str(joint), column * across, row * down, seen)
        for joint, ((column, row), seen) in enumerate(zip(places, visible, strict=True))
    ]


def _coco(content: Any, left: LeftOut) -> dict[str, Points]:
    """Return the annotation with the largest box of each image."""
    images = entries.by_id(entries.listed(content, "images"), "file_name", str)
    kinds = entries.by_id(entries.listed(content, "categories"), "keypoints", list)
    largest: dict[str, float] = {}
    found: dict[str, Points] = {}
    annotations = entries.listed(content, "annotations")
    for stem, area, points in left.usable(annotations, partial(_annotated, images, kinds)):
        if area > largest.get(stem, 0.0):
            largest[stem], found[stem] = area, points
    return found


def _annotated(images: Mapping[Any, Entry], kinds: Mapping[Any, Entry], entry: Entry) -> tuple[str, float, Points]:
    """Return the stem of an annotation's image, the area of its box, and its points, or raise `Unusable`."""
    image, kind = entries.image_of(images, entry), entries.look_up(kinds, entry, "category_id")
    if kind is None or not kind["keypoints"]:
        raise Unusable("name a category without names of keypoints", shown(entry, "category_id"))
    _, _, width, height = entries.box_of(entry)
    if not (width > 0 and height > 0):
        raise Unusable("have an empty bbox", shown(entry, "bbox"))
    names = [str(name) for name in kind["keypoints"]]
    values = entries.triples_of(entry, len(names))
    triples = zip(names, values[0::3], values[1::3], values[2::3], strict=True)
    return _stem(image["file_name"]), width * height, [(name, x + 0.5, y + 0.5, v > 0) for name, x, y, v in triples]


def _sleap(rows: list[list[str]], stems: Sequence[str]) -> dict[str, Points]:
    """Read columns frame_idx, instance.score, <node>.x, .y and .score; of each frame the instance of highest score."""
    nodes = [name[:-2] for name in rows[0] if name.endswith(".x")]
    best: dict[str, float] = {}
    found: dict[str, Points] = {}
    for cells in rows[1:]:
        row = dict(zip(rows[0], cells, strict=False))
        stem, total = _counted(row["frame_idx"], stems), _number(row["instance.score"], -math.inf)
        if stem not in found or total > best[stem]:
            best[stem] = total
            found[stem] = [  # a node without a score, as in labels by hand, is certain
                _detected(name, row[f"{name}.x"], row[f"{name}.y"], _number(row.get(f"{name}.score", ""), 1.0))
                for name in nodes
            ]
    return found


def _deeplabcut(rows: list[list[str]], stems: Sequence[str]) -> dict[str, Points]:
    """Read rows below the headers scorer, (individuals,) bodyparts and coords; of several individuals the first."""
    heads = {row[0].strip(): row for row in rows[:4]}
    parts, coords = heads["bodyparts"], heads["coords"]
    people = heads.get("individuals", [""] * len(parts))
    start = next((column for column, value in enumerate(coords) if value.strip() == "x"), None)
    if start is None:
        raise ValueError("no column called x")
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


def _number(text: str, missing: float = math.nan) -> float:
    number = float(text) if text.strip() else math.nan
    return missing if math.isnan(number) else number


def _counted(label: str, stems: Sequence[str]) -> str:
    """Return the frame that a row is about: a bare number counts from 0, all else is the name or path of an image."""
    number = re.fullmatch(r"([0-9]+)(\.0)?", label.strip())
    if number is None:
        return _stem(label)
    index = int(number[1])
    return stems[index] if index < len(stems) else f"number {index}"


def _stem(path: str) -> str:
    return Path(path.replace("\\", "/")).stem
