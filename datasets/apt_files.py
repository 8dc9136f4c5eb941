"""Annotations of APTv2 and APT-36K: COCO-like JSON whose subjects are (video, track) pairs.

Every split file of APTv2 lists all images, so clips are found through annotations. APT-36K has Windows paths.
"""

import re
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path, PurePosixPath
from typing import Any

from rewild4d.datasets.keypoints import APT, coco_keypoints, read_json
from rewild4d.errors import UserError
from rewild4d.types import Keypoints

NAMES = {"howling-monkey": "howling monkey", "raccon": "raccoon", "hourse": "horse"}
"""Spellings of APT-36K and what they mean."""


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
    """All subjects of a data set, and what did not fit, a sentence each."""

    subjects: dict[str, Subject]
    faults: tuple[str, ...]


def read_annotations(root: Path) -> Annotations:
    """Every subject of every split, by "<clip folder>@<track>".

    Raises:
        UserError: no annotation file, one that is damaged or of another kind, or no annotation that fits an image.
    """
    files = sorted({*root.glob("annotations*/*.json"), *root.glob("*.json")})
    subjects: dict[str, Subject] = {}
    faults: list[str] = []
    seen: set[tuple[str, str]] = set()
    read = 0
    for path in files:
        table = read_json(path)
        if not isinstance(table, dict) or "annotations" not in table:
            continue
        read += 1
        faults += _add(path, table, subjects, seen)
    if not read:
        raise UserError(f"{root / 'annotations'}: expected annotation files of APTv2 or APT-36K (.json), got none.")
    if not subjects:
        raise UserError(f"{root}: expected annotations of animals in images, got none: {'; '.join(faults) or 'empty'}.")
    for subject in subjects.values():
        subject.sightings.sort(key=lambda sighting: (sighting.number, str(sighting.file)))
    return Annotations(dict(sorted(subjects.items())), tuple(faults))


def _add(path: Path, table: dict[str, Any], subjects: dict[str, Subject], seen: set[tuple[str, str]]) -> list[str]:
    """Add one file's annotations; gives what did not fit."""
    try:
        images = {image["id"]: image for image in table["images"]}
        kinds = {kind["id"]: str(kind["name"]) for kind in table.get("categories", [])}
        for key in ("video_id", "track_id"):
            if table["annotations"] and not any(key in entry for entry in table["annotations"]):
                raise UserError(f"{path}: expected annotations with video_id and track_id, got none with {key}.")
        counts = {"name an image that is not listed": 0, "have no box inside their image": 0}
        for entry in table["annotations"]:
            image = images.get(entry["image_id"])
            if image is None:
                counts["name an image that is not listed"] += 1
                continue
            pair = (str(image["file_name"]), str(entry.get("track_id", 0)))
            if pair in seen:
                continue
            seen.add(pair)
            if not _sight(entry, image, kinds.get(entry.get("category_id"), "animal"), subjects):
                counts["have no box inside their image"] += 1
    except (KeyError, TypeError, AttributeError, ValueError, OverflowError) as error:
        raise UserError(f"{path}: expected COCO-like annotations, but an entry does not fit ({error!r}).") from error
    total = len(table["annotations"])
    return [f"{path.name}: {count} of {total} annotations {what}" for what, count in counts.items() if count]


def _sight(entry: dict[str, Any], image: dict[str, Any], species: str, subjects: dict[str, Subject]) -> bool:
    """Add one annotation to its subject; False where its box lies outside the image."""
    file, size = clean_path(str(image["file_name"])), (int(image["width"]), int(image["height"]))
    left, top, width, height = map(float, entry["bbox"])
    right, bottom = min(left + width, size[0]), min(top + height, size[1])
    left, top = max(left, 0.0), max(top, 0.0)
    if not (right > left and bottom > top):  # also where a number is NaN
        return False
    values = entry.get("keypoints") or [0] * (3 * len(APT))
    keypoints, outside = coco_keypoints(values, APT, size)
    track = int(entry.get("track_id", 0))
    name = f"{file.parent}@{track}"
    subject = subjects.setdefault(name, Subject(name, track, NAMES.get(species, species)))
    subject.outside += outside
    box = (left, top, right - left, bottom - top)
    subject.sightings.append(Sighting(file, _number(file.stem), size, box, keypoints))
    return True


def clean_path(text: str) -> PurePosixPath:
    """A file name as the data set's own folder has it.

    APT-36K's "D:\\Animal_pose\\AP-36k-patr1\\29wolf\\v3c2\\frame7.jpg" becomes "29wolf/v3c2/frame7.jpg".
    """
    path = PurePosixPath(text.encode("ascii", "ignore").decode().replace("\\", "/"))
    if re.match(r"^[A-Za-z]:", str(path)) or path.is_absolute():
        return PurePosixPath(*path.parts[-3:])
    return path


def _number(stem: str) -> int:
    digits = re.findall(r"[0-9]+", stem)
    return int(digits[-1]) if digits else 0


def image_places(root: Path, file: PurePosixPath) -> Iterator[Path]:
    """Where an image may lie."""
    for folder in ("data", "", "images"):
        yield root / folder / file
