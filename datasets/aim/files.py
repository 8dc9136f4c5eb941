"""The folders of Animal-in-Motion (AiM, Zhao et al. 2025): which files a track has, and what they say.

    [<split>/]<category>/<track>/<frame8>_{rgb.png, mask.png, metadata.json, keypoint.txt}    <track>_info.json

A track is <YouTube id, 11 characters>_<clip>_<object>; YouTube ids have "_" and "-" in them too, so it is taken apart
from the right. Frames are numbered at ten a second from the start of the clip, and a track may start late. Layout:
briannlongzhao/Animal-in-Motion, README.md and models/animal_tracker.py @ c94ad47.
"""

import math
import re
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache
from importlib import resources
from pathlib import Path

import msgspec
import torch

from rewild4d.datasets.keypoints.keypoints import APT, bounded
from rewild4d.errors import UserError, shown
from rewild4d.foreign.texts import read_json, read_text, read_toml
from rewild4d.types import Crop, Keypoints

CONFIDENT = 0.5
"""Keypoints of a higher score count as seen (4DEquine, amr/utils/evaluate_metric.py @ 746c1f4); AiM takes all."""
FPS = 10.0
"""The clips are resampled to this many frames a second (scripts/track_animal.py:21)."""
UNSAID = (1920, 1080)
"""Width and height of a film whose metadata does not state them: what the official loader assumes."""
SQUARE = 0.02
"""Share of its longer side by which a crop box may differ from a square; whole numbers make it differ by a pixel."""
_TRACK = re.compile(r"(.+)_(\d{3,})_(\d{3,})")
_FILE = re.compile(r"(\d{8})_(rgb\.png|mask\.png|metadata\.json|keypoint\.txt)")


@dataclass(frozen=True)
class TrackId:
    """What the name of a track says.

    Attributes:
        video: YouTube id.
        clip: number of the clip in the video.
        animal: number of the animal in the clip.
    """

    video: str
    clip: int
    animal: int


@dataclass(frozen=True)
class FrameFiles:
    """The files of one frame; None for one that is missing."""

    number: int
    rgb: Path | None
    mask: Path | None
    metadata: Path | None
    keypoints: Path | None


class _Metadata(msgspec.Struct, frozen=True):
    crop_box_xyxy: tuple[float, float, float, float]
    video_frame_width: int | None = None
    video_frame_height: int | None = None
    frame_size_wh: tuple[int, int] | None = None


class _Info(msgspec.Struct, frozen=True):
    fps: float | None = None


@cache
def benchmark_tracks() -> dict[str, tuple[str, ...]]:
    """Return the tracks of the benchmark by category: 230 of 23 species, ten each (tracks.toml)."""
    table = read_toml(resources.files("rewild4d.datasets.aim") / "tracks.toml", "the tracks of AiM")
    return {category: tuple(tracks) for category, tracks in table["tracks"].items()}


def parse_track(name: str) -> TrackId | None:
    """Take the name of a track apart, from the right; None where it is none.

    Examples:
        >>> parse_track("-H3Y5_d6V1o_0481_002")
        TrackId(video='-H3Y5_d6V1o', clip=481, animal=2)
    """
    found = _TRACK.fullmatch(name)
    return TrackId(found[1], int(found[2]), int(found[3])) if found else None


def find_tracks(root: Path) -> dict[str, Path]:
    """Return the folders of all tracks by "<category>/<track>", whether splits stand above the categories or not.

    Args:
        root: the data set, one category of it, or one track.

    Raises:
        UserError: no such folder, no track in it, or a track that two splits hold.
    """
    if not root.is_dir():
        raise UserError(f"{root}: expected a folder of AiM, got no such folder.")
    folders = [root] if parse_track(root.name) and list_frames(root) else []
    for pattern in ("*", "*/*", "*/*/*"):
        if not folders:
            folders = sorted(path for path in root.glob(pattern) if parse_track(path.name) and path.is_dir())
    found: dict[str, Path] = {}
    for folder in folders:
        first = found.setdefault(f"{folder.parent.name}/{folder.name}", folder)
        if first is not folder:
            raise UserError(f"{folder}: expected each track once, got another at {first}; name one split's folder.")
    if not found:
        raise UserError(
            f"{root}: expected tracks of AiM (<category>/<track>, as in horse/AmWzveUePWU_019_001), got none."
        )
    return found


def list_frames(track: Path) -> list[FrameFiles]:
    """Return the files of every frame of a track, in the order of their numbers."""
    found: dict[int, dict[str, Path]] = {}
    for entry in track.iterdir():
        if matched := _FILE.fullmatch(entry.name):
            found.setdefault(int(matched[1]), {})[matched[2]] = entry
    return [
        FrameFiles(number, *(kinds.get(kind) for kind in ("rgb.png", "mask.png", "metadata.json", "keypoint.txt")))
        for number, kinds in sorted(found.items())
    ]


def read_crop(path: Path) -> tuple[Crop, bool]:
    """Return the square of the film that a frame shows, and whether its metadata states the film's size.

    The square may leave the film's frame, where the crop is black.

    Raises:
        UserError: no metadata of AiM, or no square.
    """
    said = read_json(path, "metadata of AiM with crop_box_xyxy", _Metadata)
    left, top, right, bottom = said.crop_box_xyxy
    width, height = right - left, bottom - top
    if not min(width, height) > 0 or abs(width - height) > max(2.0, SQUARE * max(width, height)):
        raise UserError(f"{path}: expected a square as crop_box_xyxy, got {shown(list(said.crop_box_xyxy))}.")
    size = (said.video_frame_width, said.video_frame_height)
    stated = size if None not in size else said.frame_size_wh
    film = UNSAID if stated is None else stated
    if min(film[0] or 0, film[1] or 0) < 1:
        raise UserError(f"{path}: expected the width and height of the film in pixels, got {shown(film)}.")
    return Crop(left, top, (width + height) / 2, int(film[0] or 0), int(film[1] or 0)), stated is not None


def read_keypoints(path: Path, size: tuple[int, int]) -> Keypoints:
    """Return the keypoints of a frame: predictions of ViTPose, in the order of AP-10K, in the crop's pixels.

    They are taken as they stand, a pixel's left edge at a whole number: AiM's evaluator compares them with projections
    of (x + 1) / 2 * width (scripts/run_benchmark.py @ 904a443).

    Args:
        path: a file of 17 rows "x y score".
        size: width and height of the crop; a point outside is not visible.

    Raises:
        UserError: another number of rows, or what is no finite number.
    """
    rows = [line.split() for line in read_text(path, "keypoints of AiM").splitlines() if line.strip()]
    if len(rows) != len(APT):
        raise UserError(f"{path}: expected {len(APT)} rows of x, y and score, got {len(rows)} rows.")
    table = torch.tensor([list(_numbers(path, row)) for row in rows])
    return bounded(APT, table[:, :2], table[:, 2] > CONFIDENT, size, table[:, 2])


def _numbers(path: Path, row: list[str]) -> Iterator[float]:
    if len(row) != 3:
        raise UserError(f"{path}: expected rows of x, y and score, got '{shown(' '.join(row))}'.")
    for word in row:
        try:
            number = float(word)
        except ValueError:
            number = math.nan
        if not math.isfinite(number):
            raise UserError(f"{path}: expected finite numbers, got '{shown(word)}'.")
        yield number


def read_fps(track: Path) -> float:
    """Return the frames a second of a track's clip: what <track>_info.json says, else ten.

    Raises:
        UserError: the file is damaged, or says no rate.
    """
    path = track / f"{track.name}_info.json"
    fps = read_json(path, "facts of a track of AiM", _Info).fps if path.is_file() else None
    if fps is not None and not 0 < fps < 1000:
        raise UserError(f"{path}: expected frames a second as fps, got {shown(fps)}.")
    return FPS if fps is None else fps
