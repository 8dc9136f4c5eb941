"""Masks of a whole film from boxes, masks or strokes on any frames, or from nothing: `masks --tool track`."""

import sys
from bisect import bisect_right
from collections.abc import Iterator
from dataclasses import replace

import cv2
import numpy as np

from rewild4d.datasets.images import size_within
from rewild4d.datasets.masking.backdrop import Backdrop
from rewild4d.datasets.masking.following import Follower, standing_out
from rewild4d.datasets.masking.grabcut import rough_masks
from rewild4d.datasets.masking.makers import Box, Unmasked
from rewild4d.datasets.masking.marks import resized
from rewild4d.datasets.masking.neighbours import Recent
from rewild4d.datasets.masking.saliency import NAME, Saliency
from rewild4d.errors import UserError
from rewild4d.metrics.weights import FETCH, is_here, load_weights

WORK_SIDE = 854
"""Frames are read at this longer side."""
LOOKED = 0.15
"""Share of the work that is done once all frames have been looked through for their backdrops."""
RIVAL = 0.5
"""What has this share of the largest thing's area competes with it."""


def track_masks(source: Unmasked) -> Iterator[np.ndarray]:
    """Follow the animal on and back from each frame that somebody told about: a box, a whole mask or strokes.

    Where nobody did it starts in the first frame in which one thing stands out. Without the network's weights the masks
    are rough ones, and a line says so. Pixels that marks tell are as they say.

    Raises:
        UserError: no box, and two things stand out, or nothing does.
    """
    for index, mask in enumerate(_made(source)):
        said = source.marks.get(index)
        yield mask if said is None else np.where(said > 0, 255, np.where(said < 0, 0, mask)).astype(np.uint8)


def _made(source: Unmasked) -> Iterator[np.ndarray]:
    """Yield the mask of each frame, uint8 [h, w]."""
    if not is_here(NAME):
        print(
            f"masks: the network '{NAME}' is not here, so these are rough masks, from flow and colours alone; "
            f"run: {FETCH} {NAME}",
            file=sys.stderr,
        )
        yield from rough_masks(replace(source, boxes={**_boxes_of(source.marks), **source.boxes}))
        return
    saliency = Saliency(load_weights(NAME))
    size = size_within(source.size, WORK_SIDE)
    for mask in _followed(source, saliency, size):
        found = cv2.resize(mask.astype(np.float32), source.size, interpolation=cv2.INTER_LINEAR) > 0.5
        yield found * np.uint8(255)


def _boxes_of(marks: dict[int, np.ndarray]) -> dict[int, Box]:
    """Return the boxes around whole masks, by the frame's place."""
    whole = {place: said for place, said in marks.items() if said.all() and (said > 0).any()}
    boxes = {place: cv2.boundingRect((said > 0).astype(np.uint8)) for place, said in whole.items()}
    return {place: (float(x), float(y), float(wide), float(high)) for place, (x, y, wide, high) in boxes.items()}


def _followed(source: Unmasked, saliency: Saliency, size: tuple[int, int]) -> Iterator[np.ndarray]:
    """Yield a mask of each frame at the size at which frames are read.

    Of the frames between two that somebody told about, the nearer half is followed back from the second. Masks come
    `neighbours.FRAMES` frames late.
    """
    told = sorted({*source.boxes, *source.marks})
    late: list[bytes] = []  # frames that are followed back, compressed
    last, follower, recent = -1, None, Recent()
    backdrop, done = Backdrop(_looked_through(source, size), saliency), _Done(source)
    for index, image in enumerate(source.images()):
        small = _resized(image, size)
        start = _start_of(source, index, small, saliency, follower, backdrop)
        if start is not None:
            follower = start
            yield from recent.rest()
            yield from _backwards(late, follower, backdrop, index - len(late), done)
            late, last = [], index
            done.one()
            yield follower.mask
            continue
        ahead = told[bisect_right(told, index) :]
        if follower is not None and (not ahead or index - last <= ahead[0] - index):
            mask = follower.step(small, backdrop.odds(index, small))
            done.one()
            yield from recent.add(small, mask, follower.loose)
            continue
        if follower is not None and not _is_start(source, ahead[0]):
            follower.step(small, backdrop.odds(index, small))  # strokes will correct what it finds there
        late.append(cv2.imencode(".jpg", small, (cv2.IMWRITE_JPEG_QUALITY, 95))[1].tobytes())
    if follower is None:
        raise UserError(f"{source.title}: nothing in it stands out; give a box: --box frame:left,top,width,height.")
    yield from recent.rest()


class _Done:
    """Counts the frames in which the animal was followed."""

    def __init__(self, source: Unmasked) -> None:
        self._log, self._total, self._count = source.log, len(source.stems), 0

    def one(self) -> None:
        self._count += 1
        self._log(LOOKED + (1 - LOOKED) * self._count / self._total)


def _looked_through(source: Unmasked, size: tuple[int, int]) -> Iterator[np.ndarray]:
    for count, image in enumerate(source.images(), 1):
        yield _resized(image, size)
        source.log(LOOKED * count / len(source.stems))


def _is_start(source: Unmasked, index: int) -> bool:
    """Whether the animal is followed anew from a frame; few strokes correct the mask there."""
    return index in source.boxes or bool(source.marks[index].all() and source.marks[index].max() > 0)


def _resized(image: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    return cv2.resize(image, size, interpolation=cv2.INTER_AREA)


def _start_of(
    source: Unmasked,
    index: int,
    small: np.ndarray,
    saliency: Saliency,
    follower: Follower | None,
    backdrop: Backdrop,
) -> Follower | None:
    """Return what follows the animal on from a frame that somebody told about, or in which one thing stands out first.

    Args:
        source: the film.
        index: of the frame.
        small: the frame as it is read.
        saliency: the network.
        follower: of the frames before.
        backdrop: of all frames.
    """
    said = source.marks.get(index)
    if said is not None:
        said = resized(said, (small.shape[1], small.shape[0]))
    if index in source.boxes:
        box = _box(source, index, small)
        return Follower(saliency, small, backdrop.odds(index, small), box, said)
    if said is not None and follower is not None and not (said.all() and said.max() > 0):
        apart = backdrop.odds(index, small)
        follower.step(small, apart)
        follower.correct(small, apart, said)
        return follower
    if said is not None:
        if not (said > 0).any():
            raise UserError(
                f"{source.title}: the first marked frame, {source.stems[index]}, has no stroke on the animal; "
                "draw one, or give a box."
            )
        return Follower(saliency, small, backdrop.odds(index, small), None, said)
    if source.boxes or source.marks or follower is not None:
        return None
    found = _outstanding(source, index, small, saliency)
    return None if found is None else Follower(saliency, small, backdrop.odds(index, small), found)


def _box(source: Unmasked, index: int, small: np.ndarray) -> Box:
    """Return a frame's box in pixels of ``small``."""
    left, top, width, height = source.boxes[index]
    wide, high = source.size
    if left >= wide or top >= high or left + width <= 0 or top + height <= 0:
        raise UserError(
            f"--box: expected a box inside the frame of {wide} x {high} pixels, got "
            f"{left:g},{top:g},{width:g},{height:g}."
        )
    across, down = small.shape[1] / wide, small.shape[0] / high
    return left * across, top * down, width * across, height * down


def _outstanding(source: Unmasked, index: int, small: np.ndarray, saliency: Saliency) -> Box | None:
    """Return the box of the one thing that stands out in a frame; None where nothing does."""
    across, down = small.shape[1] / source.size[0], small.shape[0] / source.size[1]
    found = standing_out(saliency(small))
    if not found:
        return None
    rivals = [box for box, mask in found if mask.sum() >= RIVAL * found[0][1].sum()]
    if len(rivals) > 1:
        ways = " or ".join(
            f"--box {source.stems[index]}:{x / across:.0f},{y / down:.0f},{w / across:.0f},{h / down:.0f}"
            for x, y, w, h in rivals
        )
        raise UserError(
            f"{source.title}: {len(rivals)} things stand out in frame {source.stems[index]}; choose: {ways}."
        )
    return found[0][0]


def _backwards(late: list[bytes], follower: Follower, backdrop: Backdrop, first: int, done: _Done) -> list[np.ndarray]:
    """Return the masks of the frames before a start, the first of which has place ``first``, in the film's order."""
    masks, back, recent = list[np.ndarray](), follower.twin(), Recent()
    for index, data in reversed([*enumerate(late, first)]):
        image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR)
        assert image is not None
        mask = back.step(image, backdrop.odds(index, image))
        done.one()
        masks += recent.add(image, mask, back.loose)
    return [*masks, *recent.rest()][::-1]
