"""Follow the animal in the background while the page goes on."""

import sys
import time
import traceback
from collections.abc import Iterator
from dataclasses import replace
from itertools import islice
from threading import Event, Thread
from typing import Any

import numpy as np

from rewild4d.datasets.masking.editor.drawing import true_marks
from rewild4d.datasets.masking.editor.work import Step, Work
from rewild4d.datasets.masking.makers import MaskMaker, Unmasked
from rewild4d.errors import UserError


class Cancelled(Exception):
    """The job was told to stop."""


class Job(Thread):
    """Makes masks of the frames from ``first`` on and puts them into the work as they come.

    Args:
        work: the state.
        source: all frames, with the boxes and marks that are known.
        maker: of masks.
        first: frame to start from; above 0 its mask is taken for true.

    Attributes:
        total: frames to do.
        written: masks so far.
        share: of the work that is done, 0 to 1.
    """

    def __init__(self, work: Work, source: Unmasked, maker: MaskMaker, first: int = 0) -> None:
        super().__init__(name="rewild4d-editor-job", daemon=True)
        self.work, self.maker, self.first = work, maker, first
        self.source = source if first == 0 else _from(source, first, work.mask(first))
        self.total, self.written, self.share = len(self.source.stems), 0, 0.0
        self._cancelled, self._began = Event(), time.monotonic()

    def cancel(self) -> None:
        """Stop at the next frame."""
        self._cancelled.set()
        self.work.touch()

    @property
    def is_stopping(self) -> bool:
        """Whether it was told to stop."""
        return self._cancelled.is_set()

    @property
    def left(self) -> float | None:
        """Seconds that are left, from the time that each frame took so far; None where nobody knows."""
        if self.share * self.total < 2:
            return None
        return (time.monotonic() - self._began) / self.share * (1 - self.share)

    def run(self) -> None:
        parts: list[tuple[str, int, Any, Any]] = []
        kind, said = "bad", ""
        try:
            watched = replace(self.source, images=self._watched, log=self._told)
            for offset, mask in enumerate(self.maker(watched)):
                self._stop_if_cancelled()
                self.written = offset + 1
                self._told(self.written / self.total)
                parts += self.work.put_mask(self.first + offset, mask)
            lost = sum(self.work.is_empty[self.first + offset] for offset in range(self.written))
            kind, said = "good", f"Followed through {self.written} frames, {lost} of them without the animal."
        except Cancelled:
            kind, said = "", f"Stopped after {self.written} of {self.total} frames."
        except UserError as error:
            said = f"{error} In this page: draw a box around the animal." if "--box" in str(error) else str(error)
        except Exception as error:
            traceback.print_exc(file=sys.stderr)
            said = f"Following failed ({type(error).__name__}: {error}); the terminal has the details."
        with self.work.lock:
            self.work.is_busy = False
            if parts:
                self.work.remember(Step("propagation", self.first, tuple(parts)))
            self.work.say(kind, said)

    def _watched(self) -> Iterator[np.ndarray]:
        for image in self.source.images():
            self._stop_if_cancelled()
            yield image

    def _told(self, share: float) -> None:
        self.share = max(self.share, share)
        self.work.touch()

    def _stop_if_cancelled(self) -> None:
        if self.is_stopping:
            raise Cancelled


def _from(source: Unmasked, first: int, mask: np.ndarray | None) -> Unmasked:
    """Return the frames from one on, whose mask, if it shows an animal, is true."""
    boxes = {place - first: box for place, box in source.boxes.items() if place >= first}
    marks = {place - first: said for place, said in source.marks.items() if place >= first}
    if mask is not None and (mask > 127).any():
        boxes.pop(0, None)
        marks[0] = true_marks(mask)
    return replace(
        source, stems=source.stems[first:], images=lambda: islice(source.images(), first, None), boxes=boxes,
        marks=marks,
    )  # fmt: skip
