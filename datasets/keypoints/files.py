"""Keypoint files that people have: BADJA, COCO-like (APTv2, APT-36K, AP-10K), DeepLabCut's and SLEAP's CSV.

Every reader gives, for each frame of a folder, the named points in its pixels or None. What a name means on the
template is said by a mapping file (`priors.landmarks.load_mapping`), never here.
"""

import csv
import math
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import torch

from rewild4d.datasets.keypoints import entries
from rewild4d.datasets.keypoints.entries import Entry, LeftOut, Unusable
from rewild4d.datasets.keypoints.individuals import Instance, Looks, choose
from rewild4d.datasets.keypoints.keypoints import BADJA_SIZE, OfFrames, badja_joints, bounded, not_used
from rewild4d.datasets.keypoints.tables import Animals, read_table, stem_of
from rewild4d.errors import UserError, reason, shown
from rewild4d.foreign.texts import decoded, parse_json, read_bytes
from rewild4d.types import Keypoints

HDF5 = b"\x89HDF\r\n\x1a\n"
SCORED = 0.3
"""Confidence from which a point counts that a program wrote in place of COCO's 1 and 2: MMPose's own cut-off."""
FORMS = "keypoints as BADJA, COCO, DeepLabCut or SLEAP write them"


def read_keypoints(
    path: Path,
    stems: Sequence[str],
    size: tuple[int, int],
    looks: Looks | None = None,
    stored: tuple[int, int] | None = None,
) -> OfFrames:
    """Return keypoints of the frames of a folder.

    Args:
        path: .json of BADJA or COCO form, .csv of DeepLabCut or SLEAP.
        stems: file names of the frames without their ending, in order; numbers in a CSV count these from 0.
        size: width and height of the frames in pixels.
        looks: masks of the animal, by which it is known among several.
        stored: width and height before the pixels of the frames were made square, in which programs count; None: as
            ``size``.

    Returns:
        One entry per frame, in which points outside the frame are not visible, and what of the file is not used.

    Raises:
        UserError: the file is none of these, is broken, holds no usable keypoints, or names no frame of the folder.
    """
    left = LeftOut()
    found, limit = _read(path, stems, size, left)
    if stored is not None:
        found = {stem: [animal.stretched(size, stored) for animal in animals] for stem, animals in found.items()}
    wanted = f"expected keypoints of the frames {stems[0]} to {stems[-1]}"
    faults = "; ".join(left.told())
    if not any(animal.points for animals in found.values() for animal in animals):
        raise UserError(f"{path}: {wanted}, got none{f': {faults}' if faults else ''}.")
    frames = [found.get(stem, []) for stem in stems]
    if not any(frames):
        named = ", ".join(shown(stem) for stem in list(found)[:3])
        raise UserError(f"{path}: {wanted}, got those of {named}{f' ({faults})' if faults else ''}.")
    try:
        chosen, note = choose(frames, limit, size, looks)
    except ValueError as error:
        raise UserError(f"{path}: {wanted}, got {error}.") from error
    names = [name for name, *_ in next(animal for animals in frames for animal in animals).points]
    result = [
        _checked(animal, names, limit, size) if animals else None
        for animal, animals in zip(chosen, frames, strict=True)
    ]
    told = [sentence for sentence in (note, _kept(path, chosen, result, limit, size)) if sentence]
    return result, "; ".join([*told, *filter(None, [not_used(path, result, size, left)])])


def _read(path: Path, stems: Sequence[str], size: tuple[int, int], left: LeftOut) -> tuple[Animals, float]:
    """Return the animals of each frame, and the confidence from which a point counts."""
    data = read_bytes(path, "a keypoint file")
    if data.startswith(HDF5):
        raise UserError(
            f"{path}: expected {FORMS}, in .json or .csv, got HDF5: DeepLabCut writes a .csv beside it with "
            "save_as_csv=True, SLEAP one with `sleap-convert --format analysis.csv`."
        )
    try:
        text = decoded(data)
        suffix, begin = path.suffix.lower(), text.lstrip()[:1]
        if suffix == ".csv" or (suffix != ".json" and begin not in ("{", "[")):
            return read_table(text, stems)
        content = parse_json(text, path, FORMS)
        if not isinstance(content, list):
            return _coco(content, left), SCORED
        if content and all(isinstance(entry, dict) and {"image_id", "keypoints"} <= {*entry} for entry in content):
            raise ValueError(
                "a list of COCO results, which names neither images nor points: a file with images, annotations and "
                "categories has these"
            )
        return {stem: [animal] for stem, animal in left.usable(content, partial(_badja, size=size))}, 0.0
    except (ValueError, csv.Error) as error:
        raise UserError(f"{path}: expected {FORMS}, got others ({reason(error)}).") from error


def _kept(
    path: Path,
    chosen: Sequence[Instance | None],
    result: Sequence[Keypoints | None],
    limit: float,
    size: tuple[int, int],
) -> str:
    """Return how many points of how many are used, where some are unlikely; a `UserError` where none is left."""
    points = [point for animal in chosen if animal for point in animal.found(-math.inf)]
    unlikely = sum(point[3] < limit for point in points)
    kept = sum(int(keypoints.visible.sum()) for keypoints in result if keypoints is not None)
    best = max((point[3] for point in points), default=0.0)
    if not points:
        raise UserError(f"{path}: expected visible keypoints, got none.")
    if unlikely == len(points):
        raise UserError(f"{path}: expected keypoints with a score of {limit:g} or more, got {best:.3g} at most.")
    if not kept:
        raise UserError(f"{path}: expected keypoints inside frames of {size[0]}x{size[1]} pixels, got them outside.")
    return f"{kept} of {len(points)} keypoints kept, {unlikely} have a score below {limit:g}" if unlikely else ""


def _checked(animal: Instance | None, names: Sequence[str], limit: float, size: tuple[int, int]) -> Keypoints:
    """Return the points of an animal, those of None and unlikely ones not visible."""
    if animal is None:
        return Keypoints(tuple(names), torch.zeros(len(names), 2), torch.zeros(len(names), dtype=torch.bool))
    sure = {*animal.found(limit)}
    seen = [point in sure for point in animal.points]
    places = [(x, y) if known else (0.0, 0.0) for (_, x, y, _), known in zip(animal.points, seen, strict=True)]
    return bounded([name for name, *_ in animal.points], torch.tensor(places).reshape(-1, 2), torch.tensor(seen), size)


def _badja(entry: Entry, size: tuple[int, int]) -> tuple[str, Instance]:
    across, down = size[0] / BADJA_SIZE[0], size[1] / BADJA_SIZE[1]
    stem, places, visible = badja_joints(entry)
    joints = enumerate(zip(places, visible, strict=True))
    points = ((str(joint), x * across, y * down, 1.0 if seen else math.nan) for joint, ((x, y), seen) in joints)
    return stem, Instance("", 0.0, tuple(points))


def _coco(content: Any, left: LeftOut) -> Animals:
    """Return all annotations of each image."""
    images = entries.by_id(entries.listed(content, "images"), "file_name", str)
    kinds = entries.by_id(entries.listed(content, "categories"), "keypoints", list)
    found: Animals = {}
    annotations = entries.listed(content, "annotations")
    for stem, animal in left.usable(annotations, partial(_annotated, images, kinds)):
        found.setdefault(stem, []).append(animal)
    return found


def _annotated(images: Mapping[Any, Entry], kinds: Mapping[Any, Entry], entry: Entry) -> tuple[str, Instance]:
    """Return the stem of an annotation's image and its animal, whose score is the area of its box; or `Unusable`."""
    image, kind = entries.image_of(images, entry), entries.look_up(kinds, entry, "category_id")
    if kind is None or not kind["keypoints"]:
        raise Unusable("name a category without names of keypoints", entries.shown(entry, "category_id"))
    names = [str(name) for name in kind["keypoints"]]
    values = entries.triples_of(entry, len(names))
    triples = zip(names, values[0::3], values[1::3], values[2::3], strict=True)
    # 0, 1 and 2 say whether a point is there; programs that detect points write how sure they are
    points = tuple((name, x + 0.5, y + 0.5, min(seen, 1.0) if seen > 0 else math.nan) for name, x, y, seen in triples)
    track = entry.get("track_id")
    return stem_of(image["file_name"]), Instance("" if track is None else shown(track), _area(entry, points), points)


def _area(entry: Entry, points: Sequence[tuple[str, float, float, float]]) -> float:
    """Return the area of an annotation's box, or of its points where it has no box."""
    if "bbox" not in entry:
        found = [(x, y) for _, x, y, seen in points if math.isfinite(x) and math.isfinite(y) and math.isfinite(seen)]
        width, height = (max(side) - min(side) for side in zip(*found, strict=True)) if found else (0.0, 0.0)
        return width * height
    width, height = entries.box_of(entry)[2:]
    if not (width > 0 and height > 0):
        raise Unusable("have an empty bbox", entries.shown(entry, "bbox"))
    return width * height
