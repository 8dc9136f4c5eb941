"""Of the animals that a keypoint file has in a frame, take the one that the video is about, and say which.

Where masks are given, it is the animal whose points lie in them, whatever it is called: trackers break one animal into
several tracks and let two change their numbers. Without masks it is the track with the most likely points.
"""

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np

from rewild4d.errors import shown

INSIDE = 0.5
"""Share of an animal's points that lie in the masks, from which on the masks are of it."""
MARGIN = 0.02
"""Of the longer side of a frame: points this near to a mask lie in it, for masks end short of paws and tails."""

Looks = Callable[[], Iterator[tuple[int, np.ndarray | None]]]
"""Indices of frames and their masks, uint8 [h, w], ascending."""
Point = tuple[str, float, float, float]
"""(name, x, y, confidence), pixel centres at +0.5; not finite in one of the numbers where nothing was found."""


@dataclass(frozen=True)
class Instance:
    """One animal in one frame.

    Attributes:
        track: its name or number in the whole file; "" where each frame has its own.
        score: of several without a track the highest is taken.
        points: all that the file names.
    """

    track: str
    score: float
    points: tuple[Point, ...]

    def stretched(self, size: tuple[int, int], stored: tuple[int, int]) -> "Instance":
        """Return the same animal in frames that were stretched from ``stored`` to ``size`` (width, height)."""
        across, down = size[0] / stored[0], size[1] / stored[1]
        return replace(self, points=tuple((name, x * across, y * down, sure) for name, x, y, sure in self.points))

    def found(self, limit: float) -> list[Point]:
        """Return the points that are somewhere and of at least this confidence."""
        return [point for point in self.points if all(map(math.isfinite, point[1:])) and point[3] >= limit]


def choose(
    frames: Sequence[Sequence[Instance]], limit: float, size: tuple[int, int], looks: Looks | None
) -> tuple[list[Instance | None], str]:
    """Return the animal of each frame, None where there is none, and a sentence where others were left out.

    Args:
        frames: what a file has of each frame.
        limit: confidence from which a point counts.
        size: width and height of the frames.
        looks: masks of the animal.

    Raises:
        ValueError: several animals, none of which lies in the masks.
    """
    tracks = sorted({instance.track for instances in frames for instance in instances})
    crowded = sum(len(instances) > 1 for instances in frames)
    if len(tracks) < 2 and not crowded:
        return [instances[0] if instances else None for instances in frames], ""
    if looks is None or not any(item.found(limit) for instances in frames for item in instances):
        return _likeliest(frames, limit, crowded, tracks)
    inside, total = _looked_up(frames, limit, size, looks)
    share = {key: inside[key] / total[key] for key in total}
    chosen: list[Instance | None] = []
    used: set[Key] = set()
    for index, instances in enumerate(frames):
        fit = [(share[key], item.score, n, key) for n, (key, item) in enumerate(_keyed(index, instances))
               if share.get(key, 0.0) >= INSIDE and item.found(limit)]  # fmt: skip
        best = max(fit, default=None)
        chosen.append(instances[best[2]] if best else None)
        used |= {best[3]} if best else set()
    names = sorted({str(key) for key in used if isinstance(key, str)})
    hits, points = (sum(counts[key] for key in used) for counts in (inside, total))
    if not points:
        raise ValueError(f"those of {_several(tracks, crowded)}, none of which lies in the masks")
    who = shown(", ".join(names)) if names else "the animal of each frame"
    return chosen, (
        f"of {_several(tracks, crowded)} {who} taken, because {hits} of its {points} keypoints lie in the masks"
    )


Key = str | tuple[int, int]
"""A track, or the frame and place of an animal without one."""


def _keyed(index: int, instances: Sequence[Instance]) -> Iterator[tuple[Key, Instance]]:
    return ((instance.track or (index, place), instance) for place, instance in enumerate(instances))


def _several(tracks: Sequence[str], crowded: int) -> str:
    named = [track for track in tracks if track]
    return f"{len(named)} animals ({shown(', '.join(named))})" if named else f"several animals in {crowded} frames"


def _looked_up(
    frames: Sequence[Sequence[Instance]], limit: float, size: tuple[int, int], looks: Looks
) -> tuple[dict[Key, int], dict[Key, int]]:
    """Return how many points of each animal lie in the masks, and how many it has in frames with a mask."""
    inside: dict[Key, int] = {}
    total: dict[Key, int] = {}
    reach = 1 + 2 * max(2, round(MARGIN * max(size)))
    for index, mask in looks():
        if mask is None or not frames[index] or not (mask > 127).any():
            continue
        wide = cv2.dilate((mask > 127).astype(np.uint8), np.ones((reach, reach), np.uint8))
        for key, instance in _keyed(index, frames[index]):
            points = instance.found(limit)
            within = [(int(x), int(y)) for _, x, y, _ in points if 0 <= x < size[0] and 0 <= y < size[1]]
            inside[key] = inside.get(key, 0) + sum(bool(wide[row, column]) for column, row in within)
            total[key] = total.get(key, 0) + len(points)
    return inside, {key: count for key, count in total.items() if count}


def _likeliest(
    frames: Sequence[Sequence[Instance]], limit: float, crowded: int, tracks: Sequence[str]
) -> tuple[list[Instance | None], str]:
    """Choose without masks: the track with the most points, and of animals without tracks the one of highest score."""
    if any(tracks):
        evidence: dict[str, tuple[int, float]] = {}
        for instance in (item for instances in frames for item in instances):
            count, score = evidence.get(instance.track, (0, 0.0))
            found = len(instance.found(limit))
            evidence[instance.track] = (count + found, score + (instance.score if found else 0.0))
        best = max(evidence, key=lambda track: evidence[track])
        chosen = [next((item for item in instances if item.track == best), None) for instances in frames]
        return chosen, f"of {_several(tracks, crowded)} {shown(best)} taken, which has the most likely keypoints"
    chosen = [max(instances, key=lambda item: item.score, default=None) for instances in frames]
    return chosen, f"{_several(tracks, crowded)} without a track: the one of highest score taken, which may jump"
