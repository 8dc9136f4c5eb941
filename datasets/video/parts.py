"""Keep all parts of masks, or the one that is the animal where a segmenter took in something else.

An animal behind a pole is in parts too, so by itself nothing is left out but what stands well apart, time and again.
"""

from collections.abc import Collection, Iterator
from dataclasses import replace
from functools import partial
from typing import get_args

import cv2
import msgspec
import numpy as np

from rewild4d.contracts import Parts
from rewild4d.datasets.masking.facts import NOISE
from rewild4d.datasets.video.wild import Masks, Video
from rewild4d.errors import unknown_name
from rewild4d.files import atomic, cache_folder, digest
from rewild4d.foreign.texts import read_json

NOTE = "of masks in several parts only the one that goes on from the frame before is taken"
APART = 0.2
"""Distance from the largest part, times the animal's length, beyond which another is not its other side of a pole."""
OFTEN = 0.1
"""Share of the masks that have such a part, from which on it is taken for another animal."""


def with_parts(video: Video, parts: str, is_named: bool) -> Video:
    """Return the video with its masks cut down to the parts that are wanted.

    Args:
        video: its ``true_masks`` stay as they are.
        parts: `Parts`.
        is_named: whether somebody named all that the masks show as what is wanted; "auto" is "all" then.

    Raises:
        UserError: another word, or masks that cannot be read.
    """
    if parts not in get_args(Parts):
        raise unknown_name("choice of --parts", parts, get_args(Parts))
    if parts == "all" or (parts == "auto" and is_named):
        return video
    note = f"{NOTE} (--parts main)"
    if parts == "auto":
        apart, seen = _counted(video)
        if not apart or apart < OFTEN * seen:
            return video
        note = f"{apart} of {seen} masks have a part far from the rest (a second animal?): {NOTE} (--parts all: all)"
    whole, identity = video.masks, f"{video.identity} main part 2"
    return replace(
        video, masks=partial(main_parts, whole), identity=identity, notes=(*video.notes, note),
        masks_without=lambda held: partial(main_parts, whole, held),
    )  # fmt: skip


def _counted(video: Video) -> tuple[int, int]:
    """Return `standing_apart` of a video's masks; kept on disk, because masks may be a long film."""
    file = cache_folder() / "wild" / f"parts-{digest(video.identity, repr((NOISE, APART, 3)))[:32]}.json"
    if not file.is_file():
        found = standing_apart(video.masks)
        with atomic(file) as path:
            path.write_bytes(msgspec.json.encode(found))
    return read_json(file, "two counts of masks", tuple[int, int])


def standing_apart(masks: Masks) -> tuple[int, int]:
    """Return how many masks have a part that stands apart from the largest one, and how many show anything.

    A part counts from `NOISE` of the largest one's area on; the animal's length is the median, over the masks, of the
    longer side of the largest one's box.
    """
    gaps, lengths = [], []
    for mask in masks():
        if mask is None or not (solid := (mask > 127).astype(np.uint8)).any():
            continue
        _, labels, stats, _ = cv2.connectedComponentsWithStats(solid)
        areas = stats[:, cv2.CC_STAT_AREA] * (np.arange(len(stats)) > 0)  # the first is the background
        largest = int(areas.argmax())
        lengths.append(stats[largest, [cv2.CC_STAT_WIDTH, cv2.CC_STAT_HEIGHT]].max())
        others = np.flatnonzero(areas >= NOISE * areas[largest])
        gaps.append(0.0)
        if len(others) > 1:
            away = cv2.distanceTransform((labels != largest).astype(np.uint8), cv2.DIST_L2, 5)
            gaps[-1] = max(float(away[labels == other].min()) for other in others)
    return sum(bool(gap > APART * np.median(lengths)) for gap in gaps), len(gaps)


def main_parts(masks: Masks, held: Collection[int] = ()) -> Iterator[np.ndarray | None]:
    """Yield of every mask the part that shares most pixels with the one kept before it, or the largest part.

    Args:
        masks: uint8 [h, w], or None where a frame has none.
        held: moments whose masks decide nothing for those after them.
    """
    before: np.ndarray | None = None
    for moment, mask in enumerate(masks()):
        if mask is None or not (solid := mask > 127).any():
            yield mask
            continue
        part = _main(solid, before)
        if moment not in held:
            before = part & solid
        yield np.where(part, mask, 0).astype(np.uint8)


def _main(solid: np.ndarray, before: np.ndarray | None) -> np.ndarray:
    """Return pixels nearer to the main part than to another, bool [h, w]."""
    nearest: np.ndarray
    _, nearest = cv2.distanceTransformWithLabels(
        (~solid).astype(np.uint8), cv2.DIST_L2, 5, labelType=cv2.DIST_LABEL_CCOMP
    )
    shared = np.bincount(nearest[solid & before]) if before is not None else np.zeros(0, dtype=np.int64)
    if not shared.any():
        shared = np.bincount(nearest[solid])
    return nearest == int(shared.argmax())
