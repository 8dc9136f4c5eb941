"""What a person has drawn in a film and the masks that came of it: one state for all pages, with undo.

Layers map a frame's place to an immutable value: boxes, marks and masks. A mask is what a tracker or a file gave
(`bases`) with the frame's strokes carried to the image's edges (`masks`). Arrays are kept as PNG, so that hundreds of
steps back cost little.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from threading import RLock
from typing import Any

import cv2
import numpy as np

from rewild4d.datasets.masking.makers import Box
from rewild4d.datasets.masking.marks import is_whole

LAYERS = ("boxes", "marks", "bases", "masks")
MOST_STEPS = 300
"""Steps that can be taken back."""
FASTEST = (cv2.IMWRITE_PNG_COMPRESSION, 1)


class Refused(Exception):
    """What was asked for does not fit the state; the message is a sentence for the page."""


class Stale(Refused):
    """The page has not seen the newest state."""


class Busy(Refused):
    """The animal is being followed: what is drawn now would be written over."""


@dataclass(frozen=True)
class Step:
    """A change that can be taken back.

    Attributes:
        title: as in "undo TITLE".
        place: of the frame to look at.
        parts: layer, place, and the value before and after; None where there is none.
    """

    title: str
    place: int
    parts: tuple[tuple[str, int, Any, Any], ...]


class Work:
    """The state. Every method may be called from any thread.

    Args:
        count: number of frames.
        size: width and height of the frames.

    Attributes:
        lock: held while the state is read or changed.
        version: grows with every change.
        seen: the version in which each frame was last changed.
        is_saved: whether all of it is in files.
        is_busy: whether a job writes masks.
        notice: what the pages were told last: the version then, "good", "bad", "saved" or "", and a sentence.
    """

    def __init__(self, count: int, size: tuple[int, int]) -> None:
        self.count, self.size = count, size
        self.lock = RLock()
        self.version, self.seen = 1, [1] * count
        self.is_saved, self.is_busy = True, False
        self.layers: dict[str, dict[int, Any]] = {layer: {} for layer in LAYERS}
        self.is_empty: dict[int, bool] = {}  # masks without the animal
        self.is_whole: dict[int, bool] = {}  # marks that are true masks
        self.done: list[Step] = []
        self.undone: list[Step] = []
        self.notice = (0, "", "")

    def load(self, boxes: Mapping[int, Box], marks: Mapping[int, np.ndarray], masks: Mapping[int, np.ndarray]) -> None:
        """Take over what files hold: no step of the work."""
        with self.lock:
            for place, box in boxes.items():
                self._set("boxes", place, tuple(box))
            for place, said in marks.items():
                self._set("marks", place, packed(said))
            for place, mask in masks.items():
                data = packed(mask)
                self._set("bases", place, data)
                self._set("masks", place, data)

    def change(self, title: str, place: int, values: Mapping[tuple[str, int], Any]) -> None:
        """Change layers in one step: (layer, place) -> value, or None for nothing."""
        with self.lock:
            parts = tuple((layer, at, self.layers[layer].get(at), value) for (layer, at), value in values.items())
            parts = tuple(part for part in parts if part[2] != part[3])
            if parts:
                self._apply(parts)
                self.remember(Step(title, place, parts))

    def remember(self, step: Step) -> None:
        """Put a step that was made already onto those that can be taken back."""
        with self.lock:
            self.done = [*self.done, step][-MOST_STEPS:]
            self.undone = []
            self.touch()

    def put_mask(self, place: int, mask: np.ndarray) -> list[tuple[str, int, Any, Any]]:
        """Take over a tracker's mask and return the parts of a step that does so."""
        data = packed(mask)
        with self.lock:
            parts = [(layer, place, self.layers[layer].get(place), data) for layer in ("bases", "masks")]
            self._apply(parts)
            return parts

    def undo(self) -> Step:
        """Take the last step back.

        Raises:
            Refused: there is none.
        """
        with self.lock:
            if not self.done:
                raise Refused("Nothing to undo.")
            step = self.done.pop()
            self._apply([(layer, place, after, before) for layer, place, before, after in reversed(step.parts)])
            self.undone.append(step)
            return step

    def redo(self) -> Step:
        """Make the step again that was taken back last.

        Raises:
            Refused: there is none.
        """
        with self.lock:
            if not self.undone:
                raise Refused("Nothing to redo.")
            step = self.undone.pop()
            self._apply(step.parts)
            self.done.append(step)
            return step

    def touch(self) -> None:
        """Let the pages know that something beside the layers has changed."""
        with self.lock:
            self.version += 1

    def say(self, kind: str, text: str) -> None:
        """Show a sentence on every page; kinds stand at `notice`."""
        with self.lock:
            self.version += 1
            self.notice = (self.version, kind, text)

    def marks(self, place: int) -> np.ndarray:
        """Return a frame's marks, int8 [h, w], zeros where there are none."""
        data = self.layers["marks"].get(place)
        return np.zeros(self.size[::-1], np.int8) if data is None else unpacked(data).view(np.int8)

    def mask(self, place: int, layer: str = "masks") -> np.ndarray | None:
        """Return a frame's mask, uint8 [h, w], or None."""
        data = self.layers[layer].get(place)
        return None if data is None else unpacked(data)

    def _apply(self, parts: Any) -> None:
        for layer, place, _, value in parts:
            self._set(layer, place, value)
        self.is_saved = False
        self.version += 1
        for _, place, _, _ in parts:
            self.seen[place] = self.version

    def _set(self, layer: str, place: int, value: Any) -> None:
        if value is None:
            self.layers[layer].pop(place, None)
            return
        self.layers[layer][place] = value
        if layer == "masks":
            self.is_empty[place] = not (unpacked(value) > 127).any()
        if layer == "marks":
            self.is_whole[place] = is_whole(unpacked(value))


def packed(values: np.ndarray) -> bytes:
    """Return a mask or marks, 8 bits [h, w], as PNG."""
    return cv2.imencode(".png", np.ascontiguousarray(values).view(np.uint8), FASTEST)[1].tobytes()


def unpacked(data: bytes) -> np.ndarray:
    """Return what `packed` was given, uint8 [h, w]."""
    values = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
    assert values is not None
    return values
