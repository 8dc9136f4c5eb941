"""Masks of a whole film from a box on any frame, or from nothing: `masks --tool track`."""

import sys
from collections.abc import Iterator

import cv2
import numpy as np

from rewild4d.datasets.masking.following import Follower, standing_out
from rewild4d.datasets.masking.grabcut import rough_masks
from rewild4d.datasets.masking.makers import Box, Unmasked
from rewild4d.datasets.masking.saliency import NAME, Saliency
from rewild4d.errors import UserError
from rewild4d.metrics.weights import FETCH, is_here, load_weights

WORK_SIDE = 854
"""Frames are read at this longer side."""
RIVAL = 0.5
"""What has this share of the largest thing's area competes with it."""


def track_masks(source: Unmasked) -> Iterator[np.ndarray]:
    """Follow the animal from each box to the next, and from the first one back to the film's start.

    Without a box it starts in the first frame in which one thing stands out. Without the network's weights the masks
    are rough ones, and a line says so.

    Raises:
        UserError: no box, and two things stand out, or nothing does.
    """
    if not is_here(NAME):
        print(
            f"masks: the network '{NAME}' is not here, so these are rough masks, from flow and colours alone; "
            f"run: {FETCH} {NAME}",
            file=sys.stderr,
        )
        yield from rough_masks(source)
        return
    saliency = Saliency(load_weights(NAME))
    scale = min(1.0, WORK_SIDE / max(source.size))
    size = (max(1, round(source.size[0] * scale)), max(1, round(source.size[1] * scale)))
    for mask in _followed(source, saliency, size):
        found = cv2.resize(mask.astype(np.float32), source.size, interpolation=cv2.INTER_LINEAR) > 0.5
        yield found * np.uint8(255)


def _followed(source: Unmasked, saliency: Saliency, size: tuple[int, int]) -> Iterator[np.ndarray]:
    """Yield a mask of each frame at the size at which frames are read."""
    waiting: list[bytes] = []  # frames before the first start, compressed
    follower: Follower | None = None
    for index, image in enumerate(source.images()):
        small = cv2.resize(image, size, interpolation=cv2.INTER_AREA)
        box = _start_of(source, index, small, saliency, follower is None)
        if box is not None:
            follower = Follower(saliency, small, box)
            yield from _backwards(waiting, Follower(saliency, small, box) if waiting else follower)
            waiting = []
            yield follower.mask
        elif follower is not None:
            yield follower.step(small)
        else:
            waiting.append(cv2.imencode(".jpg", small, (cv2.IMWRITE_JPEG_QUALITY, 95))[1].tobytes())
    if follower is None:
        raise UserError(f"{source.title}: nothing in it stands out; give a box: --box frame:left,top,width,height.")


def _start_of(source: Unmasked, index: int, small: np.ndarray, saliency: Saliency, is_first: bool) -> Box | None:
    """Return the box from which to follow the animal anew in a frame, in pixels of ``small``; None for none."""
    across, down = small.shape[1] / source.size[0], small.shape[0] / source.size[1]
    if index in source.boxes:
        left, top, width, height = source.boxes[index]
        if left >= source.size[0] or top >= source.size[1] or left + width <= 0 or top + height <= 0:
            wide, high = source.size
            raise UserError(
                f"--box: expected a box inside the frame of {wide} x {high} pixels, got "
                f"{left:g},{top:g},{width:g},{height:g}."
            )
        return left * across, top * down, width * across, height * down
    if source.boxes or not is_first:
        return None
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


def _backwards(waiting: list[bytes], follower: Follower) -> list[np.ndarray]:
    """Return the masks of the frames before a start, in the film's order."""
    masks = []
    for data in reversed(waiting):
        image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR)
        assert image is not None
        masks.append(follower.step(image))
    return masks[::-1]
