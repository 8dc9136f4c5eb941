"""Masks for videos that have none: what a maker of masks gets and gives, and any program as one.

A maker gets the frames one after the other and gives a mask for each. Another program is one through folders: we write
frames/00000.png, ..., it writes masks/00000.png, ..., and a command line joins the two.
"""

import math
import re
import tempfile
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import cv2
import numpy as np

from rewild4d.datasets.masking.masks import list_images, match_masks, open_masks
from rewild4d.errors import UserError
from rewild4d.files import atomic, command_words
from rewild4d.foreign.programs import TIMEOUT, run_foreign

Box = tuple[float, float, float, float]
"""Left, top, width, height in pixels."""
PLACES = ("frames", "masks", "boxes")
"""What a command line may name in braces."""


@dataclass(frozen=True)
class Unmasked:
    """Frames that need masks.

    Attributes:
        title: what a sentence calls them.
        stems: name of each frame's mask file, without suffix.
        size: width and height.
        images: every frame, uint8 [h, w, 3].
        boxes: of the animal, by the frame's place; empty where nobody knows one.
        marks: what a person says of single frames (`marks`), by the frame's place, int8 [h, w].
        log: called with the share of the work that is done by a maker whose masks come later than their work.
    """

    title: str
    stems: tuple[str, ...]
    size: tuple[int, int]
    images: Callable[[], Iterator[np.ndarray]]
    boxes: dict[int, Box]
    marks: dict[int, np.ndarray] = field(default_factory=dict)
    log: Callable[[float], None] = lambda _: None


MaskMaker = Callable[[Unmasked], Iterator[np.ndarray]]
"""Frames -> a mask for each, uint8 [h, w], 0 where the animal is not."""


def write_masks(
    source: Unmasked, maker: MaskMaker, folder: Path, log: Callable[[int, int], None] = lambda *_: None
) -> tuple[list[Path], int]:
    """Write folder/<stem>.png for every frame.

    Args:
        source: the frames.
        maker: of their masks.
        folder: for the files.
        log: called with the number of frames that are done and of all. A maker that tells how much of its work is done
            (`Unmasked.log`) counts by that, since its masks may come many frames later.

    Returns:
        The files, and in how many of them there is no animal.

    Raises:
        UserError: what the maker raises, or a folder that cannot be written.
    """
    paths, empty, total = list[Path](), 0, len(source.stems)
    done = 0

    def told(share: float) -> None:
        nonlocal done
        done = max(done, len(paths), int(share * total))
        log(done, total)

    for stem, mask in zip(source.stems, maker(replace(source, log=told)), strict=False):
        paths.append(folder / f"{stem}.png")
        _write(paths[-1], mask)
        empty += not (mask > 127).any()
        told(len(paths) / total)
    if len(paths) < total:
        raise UserError(f"{source.title}: expected a mask for each of {total} frames, got {len(paths)}.")
    return paths, empty


def run_program(command: str, timeout: float = TIMEOUT) -> MaskMaker:
    """Return any program as a maker of masks.

    Args:
        command: with {frames} and {masks} in it, for the folders that it reads and writes; {boxes}, if it is there,
            stands for a text file with lines "frame left top width height".
        timeout: seconds that the program may take.

    Raises:
        UserError: a command without {frames} or {masks}, or with another name in braces.
    """
    try:
        words = command_words(command)
        said = [word.format(**dict.fromkeys(PLACES, Path())) for word in words]
    except (KeyError, IndexError, ValueError, AttributeError, TypeError) as error:
        names = ", ".join(f"{{{name}}}" for name in PLACES)
        raise UserError(f"--command: expected a command line with {names} in it, got '{command}' ({error}).") from error
    if not said or not all(f"{{{name}}}" in command for name in PLACES[:2]):
        raise UserError(f"--command: expected a command line with {{frames}} and {{masks}} in it, got '{command}'.")

    def maker(source: Unmasked) -> Iterator[np.ndarray]:
        with tempfile.TemporaryDirectory(prefix="rewild4d-masks-") as name:
            places = {place: Path(name) / place for place in PLACES}
            places["frames"].mkdir()
            places["masks"].mkdir()
            stems = [f"{index:05d}" for index in range(len(source.stems))]
            for count, (stem, image) in enumerate(zip(stems, source.images(), strict=True), 1):
                _write(places["frames"] / f"{stem}.png", cv2.cvtColor(image, cv2.COLOR_RGB2BGR))
                source.log(count / len(stems) / 2)
            lines = [f"{index} {' '.join(f'{x:g}' for x in box)}\n" for index, box in sorted(source.boxes.items())]
            places["boxes"].write_text("".join(lines), encoding="utf-8")
            _call([word.format(**places) for word in words], timeout)
            written = list_images(places["masks"])
            if not written:
                raise UserError(f"{words[0]}: expected a mask for each of {len(stems)} frames, but it wrote none.")
            files, _ = match_masks(written, stems, places["masks"])
            missing = files.count(None)
            if missing:
                raise UserError(
                    f"{words[0]}: expected a mask for each of {len(stems)} frames, but {missing} are missing (first: "
                    f"{stems[files.index(None)]}.png)."
                )
            masks = open_masks(files)
            for index in range(len(stems)):
                mask = masks.read(index, None, source.size)
                assert mask is not None
                yield mask

    return maker


def _call(words: list[str], timeout: float) -> None:
    ended = run_foreign(words, timeout=timeout)
    if ended.status:
        said = (ended.said or "nothing").rstrip(".")
        raise UserError(f"{words[0]}: the program ended with status {ended.status} and said: {said}.")


def parse_boxes(texts: tuple[str, ...], stems: Sequence[str]) -> dict[int, Box]:
    """Return boxes by the frame's place, from "left,top,width,height" (the first frame) or "frame:left,...".

    Args:
        texts: words of the command line.
        stems: names of the frames that are used; "120" means "00120", the film's own number, as everywhere.

    Raises:
        UserError: another form, an empty box, or a frame that is not there.
    """
    boxes, places = {}, frame_places(stems)
    for text in texts:
        before, colon, numbers = text.rpartition(":")
        try:
            left, top, width, height = (float(number) for number in numbers.split(","))
        except ValueError as error:
            raise UserError(f"--box: expected left,top,width,height or frame:left,..., got '{text}'.") from error
        is_finite = all(map(math.isfinite, (left, top, width, height)))
        place = places.get(before.strip().lstrip("0") or "0") if colon else 0
        if place is None or not (is_finite and width > 0 and height > 0):
            raise UserError(
                f"--box: expected a box with a size, in a frame from {stems[0]} to {stems[-1]}, got '{text}'."
            )
        boxes[place] = (left, top, width, height)
    return boxes


def frame_places(stems: Sequence[str]) -> dict[str, int]:
    """Return each frame's place by its name and by the number at its end, without leading zeros."""
    places = {stem.lstrip("0") or "0": place for place, stem in enumerate(stems)}
    for place, stem in enumerate(stems):
        if number := re.search(r"\d+$", stem):
            places.setdefault(number[0].lstrip("0") or "0", place)
    return places


def _write(path: Path, image: np.ndarray) -> None:
    with atomic(path) as temporary:
        cv2.imwrite(str(temporary), image)
