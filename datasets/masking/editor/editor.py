"""Do what pages ask for: every request changes the one state of the work."""

import sys
import traceback
from collections import deque
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from threading import Event, Lock
from typing import Any

import cv2
import numpy as np

from rewild4d.datasets.masking.editor import requests as ask
from rewild4d.datasets.masking.editor.drawing import drawn, mask_of, true_marks
from rewild4d.datasets.masking.editor.film import Film
from rewild4d.datasets.masking.editor.job import Job
from rewild4d.datasets.masking.editor.saving import marks_folder, save
from rewild4d.datasets.masking.editor.work import Busy, Refused, Stale, Work, packed
from rewild4d.datasets.masking.makers import Box, MaskMaker, Unmasked
from rewild4d.datasets.masking.marks import is_whole
from rewild4d.errors import UserError

PATIENCE = 5.0
"""Seconds that a job gets to stop at the end."""
REMEMBERED = 1000
"""Drawings whose ids are known: one that is sent again after a lost connection is not drawn twice."""
GREEN, RED = (60, 220, 60, 255), (70, 70, 255, 255)
"""Strokes in the page, as OpenCV orders channels (blue, green, red, alpha)."""


class Editor:
    """The work, its film and its files, for any number of pages.

    Args:
        source: the frames; boxes and marks in it are ignored for those of ``work``.
        film: the same frames as JPEG.
        work: the state.
        maker: of masks.
        folder: for masks.
        command: what to run after saving.
        lacking: a sentence where the maker works with less than it could ("" else).

    Attributes:
        ended: set when a page said that it is done.
    """

    def __init__(
        self,
        source: Unmasked,
        film: Film,
        work: Work,
        maker: MaskMaker,
        folder: Path,
        command: str = "",
        lacking: Callable[[], str] = str,
    ) -> None:
        self.source, self.film, self.work, self.maker = source, film, work, maker
        self.folder, self.command, self.lacking = folder, command, lacking
        self.ended = Event()
        self._job: Job | None = None
        self._changing = Lock()
        self._drawn: deque[str] = deque(maxlen=REMEMBERED)

    def state(self) -> dict[str, Any]:
        """Return what a page shows, for JSON."""
        work = self.work
        with work.lock:
            masks, marks = work.layers["masks"], work.layers["marks"]
            frames = [
                (
                    work.seen[place],
                    "" if place not in marks else "true" if work.is_whole[place] else "strokes",
                    "" if place not in masks else "empty" if work.is_empty[place] else "mask",
                )
                for place in range(work.count)
            ]
            return {
                "version": work.version,
                "frames": frames,
                "boxes": work.layers["boxes"],
                "undo": work.done[-1].title if work.done else "",
                "redo": work.undone[-1].title if work.undone else "",
                "saved": work.is_saved,
                "notice": work.notice,
                "job": self._progress(),
                "lacking": self.lacking(),
            }

    def about(self) -> dict[str, Any]:
        """Return what never changes, for JSON."""
        return {"title": Path(self.source.title).name, "names": self.source.stems, "size": self.source.size}

    def do(self, request: ask.AnyRequest) -> int | None:
        """Do what a page asks for; return the frame to show, if another one is meant.

        Raises:
            Stale: the page's state is not the newest.
            Busy: the animal is being followed.
            Refused: it cannot be done.
            UserError: files that cannot be written.
        """
        if isinstance(request, ask.Cancel):
            if self._job:
                self._job.cancel()
            return None
        with self._changing:
            if self.work.is_busy:
                raise Busy("The animal is being followed; wait for it, or cancel it.")
            if isinstance(request, ask.Decision) and request.version != self.work.version:
                raise Stale("This page was not up to date; it is now. Look, and try again.")
            place = getattr(request, "place", None)
            if place is not None and place >= self.work.count:
                raise Refused(f"There is no frame {place}.")
            return self._do(request)

    def close(self) -> None:
        """Stop what runs."""
        try:
            if self._job:
                self._job.cancel()
                self._job.join(PATIENCE)
        finally:
            self.film.close()

    def _do(self, request: ask.AnyRequest) -> int | None:
        match request:
            case ask.Stroke() | ask.DrawBox():
                if request.id not in self._drawn:
                    self._stroke(request) if isinstance(request, ask.Stroke) else self._box(request)
                    self._drawn.append(request.id)
            case ask.Undo():
                return self.work.undo().place
            case ask.Redo():
                return self.work.redo().place
            case ask.Clear(place=place):
                values = self._corrected(place, np.zeros(self.work.size[::-1], np.int8))
                self.work.change(f"clear of frame {self._name(place)}", place, {("boxes", place): None, **values})
            case ask.Fix(place=place):
                self._fix(place)
            case ask.Track(place=first):
                self._track(first or 0)
            case ask.Save():
                self._save()
            case ask.Done():
                self.ended.set()
        return None

    def _stroke(self, stroke: ask.Stroke) -> None:
        before = self.work.marks(stroke.place)
        if stroke.tool == "eraser" and is_whole(before):
            raise Refused("This mask is set as true: every pixel is told. Press f to let it go, then erase strokes.")
        said = drawn(before, stroke.tool, stroke.radius, stroke.points)
        title = f"{'eraser' if stroke.tool == 'eraser' else 'stroke'} in frame {self._name(stroke.place)}"
        self.work.change(title, stroke.place, self._corrected(stroke.place, said))

    def _corrected(self, place: int, said: np.ndarray) -> dict[tuple[str, int], Any]:
        """Return a frame's marks and the mask that follows from them."""
        mask = mask_of(self.film.image(place), self.work.mask(place, "bases"), said)
        return {
            ("marks", place): packed(said) if said.any() else None,
            ("masks", place): None if mask is None else packed(mask),
        }

    def _box(self, request: ask.DrawBox) -> None:
        box, (wide, high) = request.box, self.work.size
        if box is not None:
            left, top = max(0.0, box[0]), max(0.0, box[1])
            right, bottom = min(float(wide), box[0] + box[2]), min(float(high), box[1] + box[3])
            if right - left < 1 or bottom - top < 1:
                raise Refused("The box is not inside the frame.")
            box = (round(left, 1), round(top, 1), round(right - left, 1), round(bottom - top, 1))
        values = {} if box is None else self._boxed(request.place, box)
        values["boxes", request.place] = box
        self.work.change(f"box in frame {self._name(request.place)}", request.place, values)

    def _boxed(self, place: int, box: Box) -> dict[tuple[str, int], Any]:
        """Return a frame's mask as following starts from a box, before it goes on to other frames."""
        said, stems = self.work.marks(place), (self.source.stems[place],)
        marks, images = {0: said} if said.any() else {}, partial(iter, (self.film.image(place),))
        source = replace(self.source, stems=stems, images=images, boxes={0: box}, marks=marks)
        mask = packed(next(iter(self.maker(source))))
        return {("bases", place): mask, ("masks", place): mask}

    def _fix(self, place: int) -> None:
        name, before, mask = self._name(place), self.work.marks(place), self.work.mask(place)
        if before.any() and is_whole(before):
            values = self._corrected(place, np.zeros_like(before))
            self.work.change(f"true mask of frame {name} let go", place, values)
            return
        if mask is None:
            raise Refused("This frame has no mask yet that could be true.")
        said = true_marks(mask)
        self.work.change(f"true mask of frame {name}", place, self._corrected(place, said))

    def _track(self, first: int) -> None:
        with self.work.lock:
            source = replace(self.source, boxes=dict(self.work.layers["boxes"]), marks=self._told())
            self._job = Job(self.work, source, self.maker, first)
            self.work.is_busy = True
            self.work.say("", "")
        self._job.start()

    def _told(self) -> dict[int, np.ndarray]:
        """Return all marks; a first frame with strokes alone starts from its mask, if it had one before them."""
        layers = self.work.layers
        marks = {place: self.work.marks(place) for place in layers["marks"]}
        start = min({*layers["boxes"], *marks}, default=-1)
        mask = self.work.mask(start)
        if start in layers["bases"] and start not in layers["boxes"] and mask is not None and (mask > 127).any():
            marks[start] = true_marks(mask)
        return marks

    def _save(self) -> None:
        found = save(self.work, self.source, self.folder)
        said = f"{found.masks} masks written into {self.folder}"
        if found.empty:
            unmade = f", {found.missing} of these because no mask was made yet" if found.missing else ""
            said += f" ({found.empty} without the animal{unmade})"
        if found.marks or self.work.layers["boxes"]:
            said += f"; marks and boxes into {marks_folder(self.folder)}"
        self.work.say("saved", f"{said}. Next: {self.command}" if self.command else f"{said}.")

    def _progress(self) -> dict[str, Any] | None:
        if not self.work.is_busy or self._job is None:
            return None
        job = self._job
        left = job.left
        return {
            "done": job.written, "share": job.share, "total": job.total, "first": job.first,
            "left": None if left is None else round(left, 1), "stopping": job.is_stopping,
        }  # fmt: skip

    def _name(self, place: int) -> str:
        return self.source.stems[place].lstrip("0") or "0"

    def mask_png(self, place: int) -> bytes:
        """Return a frame's mask as a grey PNG, black where there is none."""
        with self.work.lock:
            data = self.work.layers["masks"].get(place)
        return _png(np.zeros(self.work.size[::-1], np.uint8)) if data is None else data

    def marks_png(self, place: int) -> bytes:
        """Return a frame's strokes as a PNG, green and red on nothing; a true mask has none."""
        said = self.work.marks(place)
        image = np.zeros((*said.shape, 4), np.uint8)
        if not is_whole(said):
            image[said > 0], image[said < 0] = GREEN, RED
        return _png(image)


def _png(image: np.ndarray) -> bytes:
    return cv2.imencode(".png", image, (cv2.IMWRITE_PNG_COMPRESSION, 1))[1].tobytes()


def refused(error: Exception) -> tuple[int, str]:
    """Return the HTTP status and the sentence for an error of `Editor.do`; what is our own fault is printed too."""
    for kind, status in ((Stale, 409), (Busy, 423), (Refused, 400), (UserError, 500)):
        if isinstance(error, kind):
            return status, str(error)
    traceback.print_exception(error, file=sys.stderr)
    return 500, f"The editor failed ({type(error).__name__}: {error}); the terminal has the details."
