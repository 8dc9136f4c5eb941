"""Annotation files of CoP3D (Sinha et al. 2023), in the format of CO3Dv2: gzipped JSON.

    <category>/{frame_annotations.jgz, sequence_annotations.jgz}    <category>/set_lists/set_lists_<name>.json

Fields: facebookresearch/co3d, co3d/dataset/data_types.py @ eb51d75. A category's frames are some hundred megabytes of
JSON, so those of one sequence are kept in the cache.
"""

import gzip
import json
import zlib
from functools import lru_cache
from pathlib import Path
from typing import Any, TypeVar

import msgspec

from rewild4d.datasets.cop3d.cameras import Viewpoint
from rewild4d.errors import UserError, reason
from rewild4d.files import cache_folder, digest, file_state, write_text
from rewild4d.foreign.reading import largest, require_room, require_there
from rewild4d.foreign.texts import decoded, read_json

FRAMES, SEQUENCES = "frame_annotations.jgz", "sequence_annotations.jgz"
T = TypeVar("T")


class Image(msgspec.Struct, frozen=True):
    """An image: its path below the data set's root, and its height and width."""

    path: str
    size: tuple[int, int]


class Mask(msgspec.Struct, frozen=True):
    """A soft mask: its path below the data set's root, and the pixels of animal in it."""

    path: str
    mass: float | None = None


class FrameAnnotation(msgspec.Struct, frozen=True):
    """One frame: its number counts the frames of its sequence and need not be that of its file."""

    sequence_name: str
    frame_number: int
    image: Image
    frame_timestamp: float | None = None
    mask: Mask | None = None
    viewpoint: Viewpoint | None = None


class Film(msgspec.Struct, frozen=True):
    """The film of a sequence: its length in seconds."""

    length: float | None = None


class SequenceAnnotation(msgspec.Struct, frozen=True):
    """One sequence."""

    sequence_name: str
    category: str
    video: Film | None = None
    viewpoint_quality_score: float | None = None


def read_jgz(path: Path, kind: type[T]) -> T:
    """Return what a gzipped JSON file holds.

    Raises:
        UserError: no such file, one that is cut off, damaged or too large, or JSON of another kind.
    """
    require_there(path, "an annotation file of CoP3D")
    try:
        with gzip.open(path) as file:
            data = file.read(largest() + 1)
    except (EOFError, zlib.error, OSError) as error:
        raise UserError(
            f"{path}: expected a gzipped annotation file of CoP3D, but it is cut off or damaged ({reason(error)})."
        ) from error
    require_room(path, len(data), "annotations")
    try:
        return msgspec.json.decode(data, type=kind)
    except msgspec.MsgspecError:
        return _with_nan(path, data, kind)


def _with_nan(path: Path, data: bytes, kind: type[T]) -> T:
    """Parse JSON with Python's own numbers, NaN among them, which others refuse."""
    try:
        found: T = msgspec.convert(json.loads(decoded(data)), type=kind)
    except (msgspec.MsgspecError, ValueError, RecursionError) as error:
        raise UserError(f"{path}: expected annotations of CoP3D, but {reason(error)}.") from error
    return found


def read_frames(path: Path, sequence: str) -> list[FrameAnnotation]:
    """Return the frames of one sequence in the order of their numbers.

    Raises:
        UserError: as `read_jgz`, no such sequence, or a number that two frames have.
    """
    require_there(path, "an annotation file of CoP3D")
    kept = cache_folder() / "cop3d" / f"{digest(file_state(path), sequence)[:32]}.json"
    if not kept.is_file():
        frames = _by_sequence(path, file_state(path)).get(sequence, [])
        numbers = [frame.frame_number for frame in frames]
        if not frames or len({*numbers}) < len(numbers):
            came = "none" if not frames else "two of one frame_number"
            raise UserError(f"{path}: expected annotations of the frames of {sequence}, got {came}.")
        write_text(kept, json.dumps(msgspec.to_builtins(frames)))
    return [msgspec.convert(entry, FrameAnnotation) for entry in read_json(kept, "kept annotations of CoP3D")]


@lru_cache(maxsize=1)
def _by_sequence(path: Path, state: str) -> dict[str, list[FrameAnnotation]]:
    """Return all frames of a file that is known by its ``state``, by sequence and in the order of their numbers."""
    found: dict[str, list[FrameAnnotation]] = {}
    for frame in sorted(read_jgz(path, list[FrameAnnotation]), key=lambda frame: frame.frame_number):
        found.setdefault(frame.sequence_name, []).append(frame)
    return found


def read_set_list(path: Path) -> dict[str, list[tuple[str, int, str]]]:
    """Return the frames of each subset ("train", "val", "test"): sequence, frame_number and path of the image.

    Raises:
        UserError: no such file, or none of CoP3D's.
    """
    kind: Any = dict[str, list[tuple[str, int, str]]]
    return read_json(path, "a list of CoP3D's frames by subset", kind)
