"""Read and write what the editor works on: masks in a folder, marks and boxes in another beside it."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from rewild4d.datasets.masking.editor.work import Work
from rewild4d.datasets.masking.makers import Box, Unmasked, parse_boxes, write_masks
from rewild4d.datasets.masking.marks import read_marks, write_marks
from rewild4d.datasets.masking.masks import list_images, match_masks, open_masks
from rewild4d.errors import UserError
from rewild4d.files import write_text
from rewild4d.foreign.texts import read_text

BOXES = "boxes.txt"
"""File of the boxes among the marks: lines as words of `--box`."""


@dataclass(frozen=True)
class Saved:
    """What was written.

    Attributes:
        masks: number of masks.
        empty: of them without the animal.
        missing: of those, frames that had no mask yet.
        marks: number of frames with marks.
    """

    masks: int
    empty: int
    missing: int
    marks: int


def marks_folder(folder: Path) -> Path:
    """Return the folder of marks beside a folder of masks."""
    return folder.with_name(f"{folder.name}-marks")


def read_masks(folder: Path, source: Unmasked) -> tuple[dict[int, np.ndarray], str]:
    """Return masks that a folder holds already, uint8 [h, w], by the frame's place, and a note on their names.

    Raises:
        UserError: masks that fit no frame, cannot be read, or tell several objects apart.
    """
    files = list_images(folder) if folder.is_dir() else []
    if not files:
        return {}, ""
    matched, note = match_masks(files, source.stems, folder)
    masks = open_masks(matched)
    if len(masks.ids) > 1:
        raise UserError(
            f"{folder}: expected masks of one animal, got numbers of {len(masks.ids)} objects, which the editor would "
            "write over; choose another folder with --out."
        )
    read = (masks.read(place, None, source.size) for place in range(len(source.stems)))
    return {place: mask for place, mask in enumerate(read) if mask is not None}, note


def read_drawn(folder: Path, source: Unmasked) -> tuple[dict[int, np.ndarray], dict[int, Box]]:
    """Return the marks and boxes of an earlier sitting; none where the folder is not there.

    Raises:
        UserError: files that cannot be read, or are of another film.
    """
    marks = read_marks(folder, source.stems, source.size) if folder.is_dir() and list_images(folder) else {}
    file = folder / BOXES
    try:
        boxes = parse_boxes(tuple(read_text(file, "boxes").split()), source.stems) if file.is_file() else {}
    except UserError as error:
        raise UserError(f"{file}: expected boxes, one a line. {error}") from error
    return marks, boxes


def save(work: Work, source: Unmasked, folder: Path) -> Saved:
    """Write folder/<stem>.png for every frame, and marks and boxes beside it.

    Args:
        work: the state.
        source: the frames.
        folder: of masks.

    Raises:
        UserError: a folder that cannot be written.
    """
    with work.lock:
        version = work.version
        masks, boxes = dict(work.layers["masks"]), dict(work.layers["boxes"])
        marks = {place: work.marks(place) for place in work.layers["marks"]}

    def maker(_: Unmasked) -> Iterator[np.ndarray]:
        for place in range(work.count):
            mask = work.mask(place) if place in masks else None
            yield np.zeros(work.size[::-1], np.uint8) if mask is None else mask

    paths, empty = write_masks(source, maker, folder)
    _write_drawn(marks, boxes, source.stems, marks_folder(folder))
    with work.lock:
        if work.version == version:
            work.is_saved = True
    return Saved(len(paths), empty, work.count - len(masks), len(marks))


def _write_drawn(marks: dict[int, np.ndarray], boxes: dict[int, Box], stems: Sequence[str], folder: Path) -> None:
    """Write marks and boxes; frames that no longer have any lose their files."""
    if marks:
        write_marks(marks, stems, folder)
    for place, stem in enumerate(stems):
        if place not in marks:
            (folder / f"{stem}.png").unlink(missing_ok=True)
    words = [f"{stems[place]}:{','.join(f'{value:g}' for value in box)}" for place, box in sorted(boxes.items())]
    if words:
        write_text(folder / BOXES, "\n".join(words) + "\n")
    else:
        (folder / BOXES).unlink(missing_ok=True)
