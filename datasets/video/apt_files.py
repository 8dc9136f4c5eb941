"""Annotations of APTv2 and APT-36K: COCO-like JSON whose subjects are (video, track) pairs.

Every split file of APTv2 lists all images, so clips are found through annotations. APT-36K has Windows paths.
"""

import re
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path, PurePosixPath
from typing import Any

from rewild4d.datasets.keypoints import entries as coco
from rewild4d.datasets.keypoints.entries import Entry, LeftOut, Unusable, short, shown
from rewild4d.datasets.keypoints.keypoints import APT, coco_keypoints
from rewild4d.datasets.masking.masks import last_number
from rewild4d.errors import UserError
from rewild4d.foreign.texts import read_json
from rewild4d.types import Keypoints

NAMES = {"howling-monkey": "howling monkey", "raccon": "raccoon", "hourse": "horse"}
"""Spellings of APT-36K and what they mean."""

MOST_PIXELS = 1_000_000
"""Width or height of an image; no format of images has more."""
MOST_TRACK = 2**53
"""A larger number of an animal is not told from its neighbours in every program that writes JSON."""
MOST_NAME = 255
"""Bytes of a part of a path; file systems have no longer ones."""

UNLISTED = "animal of no listed category"
"""The species where no annotation of an animal names a category that its file lists."""


@dataclass(frozen=True)
class Sighting:
    """One animal in one frame.

    Attributes:
        file: path of the image as the data set's own folder has it: "easy/10gorilla/v12C1/0000.jpg".
        number: of the frame in its clip.
        size: width and height that the annotation states.
        box: left, top, width, height in pixels.
        keypoints: in the frame's pixels.
    """

    file: PurePosixPath
    number: int
    size: tuple[int, int]
    box: tuple[float, float, float, float]
    keypoints: Keypoints


@dataclass
class Subject:
    """One animal in one clip."""

    name: str
    track: int
    species: str
    sightings: list[Sighting] = field(default_factory=list)
    outside: int = 0


@dataclass(frozen=True)
class Annotations:
    """All subjects of a data set, and what did not fit, a sentence each.

    Attributes:
        subjects: by name.
        faults: of all files.
        clip_faults: of each clip, by its folder; under "" those of which nobody knows the clip.
    """

    subjects: dict[str, Subject]
    faults: tuple[str, ...]
    clip_faults: dict[str, list[str]]


def read_annotations(root: Path) -> Annotations:
    """Return every subject of every split, by "<clip folder>@<track>".

    Raises:
        UserError: no annotation file, one that is damaged or of another kind, or no annotation that fits an image.
    """
    files = sorted({*root.glob("annotations*/*.json"), *root.glob("*.json")})
    subjects: dict[str, Subject] = {}
    faults: list[str] = []
    clip_faults: dict[str, list[str]] = {}
    seen: set[tuple[str, int]] = set()
    read = 0
    for path in files:
        table = read_json(path, "JSON")
        if not isinstance(table, dict) or "annotations" not in table:
            continue
        read += 1
        left = _add(path, table, subjects, seen)
        faults += [f"{path.name}: {sentence}" for sentence in left.told()]
        for clip in left.groups:
            clip_faults.setdefault(clip, []).extend(f"{path.name}: {sentence}" for sentence in left.told(clip))
    if not read:
        raise UserError(f"{root / 'annotations'}: expected annotation files of APTv2 or APT-36K (.json), got none.")
    if not subjects:
        raise UserError(f"{root}: expected annotations of animals in images, got none: {'; '.join(faults) or 'empty'}.")
    for subject in subjects.values():
        subject.sightings.sort(key=lambda sighting: (sighting.number, str(sighting.file)))
    return Annotations(dict(sorted(subjects.items())), tuple(faults), clip_faults)


def _add(path: Path, table: dict[str, Any], subjects: dict[str, Subject], seen: set[tuple[str, int]]) -> LeftOut:
    """Add one file's annotations to ``subjects`` and ``seen`` (splits overlap); return those that did not fit."""
    try:
        entries = coco.listed(table, "annotations")
        images = coco.by_id(coco.listed(table, "images"), "file_name", str)
        kinds = coco.by_id(coco.listed({"categories": []} | table, "categories"), "name", str)
    except ValueError as error:
        raise UserError(f"{path}: expected COCO-like annotations, got {error}.") from error
    for key in ("video_id", "track_id"):
        if entries and not any(isinstance(entry, dict) and key in entry for entry in entries):
            raise UserError(f"{path}: expected annotations with video_id and track_id, got none with {key}.")
    left = LeftOut()
    for species, track, outside, sighting in left.usable(entries, partial(_sighting, images, kinds)):
        if (str(sighting.file), track) in seen:
            continue
        seen.add((str(sighting.file), track))
        name = f"{sighting.file.parent}@{track}"
        subject = subjects.setdefault(name, Subject(name, track, species))
        subject.species = species if subject.species == UNLISTED else subject.species
        subject.outside += outside
        subject.sightings.append(sighting)
    return left


def _sighting(images: dict[Any, Entry], kinds: dict[Any, Entry], entry: Entry) -> tuple[str, int, int, Sighting]:
    """Return species, track, the number of keypoints outside the image, and the sighting of one annotation."""
    image, kind = coco.image_of(images, entry), coco.look_up(kinds, entry, "category_id")
    species = str(kind["name"]) if kind else UNLISTED
    file = clean_path(image["file_name"])
    try:
        if ".." in file.parts or any(len(part) > MOST_NAME or "\0" in part for part in file.parts):
            raise Unusable("name an image that no data set can hold", shown(image, "file_name"))
        size = _size(image)
        box = _within(coco.box_of(entry), size, entry)
        values = coco.triples_of(entry, len(APT)) if entry.get("keypoints") else [0.0] * (3 * len(APT))
        keypoints, outside = coco_keypoints(values, APT, size)
        sighting = Sighting(file, last_number(file.stem) or 0, size, box, keypoints)
        return NAMES.get(species, species), _track(entry), outside, sighting
    except Unusable as fault:
        fault.group = str(file.parent)
        raise


def _size(image: Entry) -> tuple[int, int]:
    sides = coco.numbers([image.get("width"), image.get("height")])
    if len(sides) < 2 or not all(1 <= side <= MOST_PIXELS for side in sides):
        got = f"image_id {short(image['id'])} with {shown(image, 'width')} and {shown(image, 'height')}"
        raise Unusable("name an image without width and height in pixels", got)
    return int(sides[0]), int(sides[1])


def _track(entry: Entry) -> int:
    """Return the number of an animal in its clip; nobody may guess it."""
    found = coco.numbers([entry.get("track_id")])
    if not found or not found[0].is_integer() or abs(found[0]) > MOST_TRACK:
        raise Unusable("have no whole number as track_id", shown(entry, "track_id"))
    return int(found[0])


def _within(
    box: tuple[float, float, float, float], size: tuple[int, int], entry: Entry
) -> tuple[float, float, float, float]:
    """Return the part of a box that lies in its image."""
    left, top, width, height = box
    right, bottom = min(left + width, size[0]), min(top + height, size[1])
    left, top = max(left, 0.0), max(top, 0.0)
    if not (right > left and bottom > top):  # also where a number is NaN
        raise Unusable("have no box inside their image", shown(entry, "bbox"))
    return left, top, right - left, bottom - top


def clean_path(text: str) -> PurePosixPath:
    """Return a file name as the data set's own folder has it.

    APT-36K's "D:\\Animal_pose\\AP-36k-patr1\\29wolf\\v3c2\\frame7.jpg" becomes "29wolf/v3c2/frame7.jpg".
    """
    path = PurePosixPath(text.encode("ascii", "ignore").decode().replace("\\", "/"))
    if re.match(r"^[A-Za-z]:", str(path)) or path.is_absolute():
        return PurePosixPath(*path.parts[-3:])
    return path
