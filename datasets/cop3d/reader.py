"""Read CoP3D (Sinha et al. 2023): films of cats and dogs with cameras from structure from motion and soft masks.

    {cat, dog}/<sequence>/{images, masks}    {cat, dog}/{frame_annotations.jgz, sequence_annotations.jgz, set_lists}

It is given out in parts of 20 GB, so sequences whose folder is missing are no cases, and frames whose files are missing
are left out and told. Layout: facebookresearch/cop3d, README.md @ 8816d16.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property, partial
from importlib import resources
from pathlib import Path
from typing import Any

import numpy as np

from rewild4d.contracts import Selection
from rewild4d.datasets.cop3d.annotations import (
    FRAMES,
    SEQUENCES,
    FrameAnnotation,
    SequenceAnnotation,
    read_frames,
    read_jgz,
    read_set_list,
)
from rewild4d.datasets.cop3d.cameras import to_opencv
from rewild4d.datasets.images import expect_size, read_alpha, read_rgb
from rewild4d.datasets.masking.masks import MaskFiles, open_masks
from rewild4d.datasets.video.frame_files import read_masks
from rewild4d.datasets.video.placed import split_placed
from rewild4d.datasets.video.reader import VideoDataset
from rewild4d.datasets.video.wild import Moment, Video, files_identity, listed
from rewild4d.errors import UserError, unknown_name
from rewild4d.files import digest
from rewild4d.foreign.texts import read_toml
from rewild4d.types import Clip, Truth

CATEGORIES = ("cat", "dog")
LICENCE = "CC BY-NC 4.0 (CoP3D, Sinha et al. 2023): attribute, non-commercial"
FPS = 10.0
"""Assumed where the times of a sequence's frames do not ascend."""


def evaluation_sequences() -> list[str]:
    """Return the 50 cases on which Animal Avatars and 4D-Animal are evaluated, in their order (sequences.toml)."""
    return [f"dog/{name}" for name in _known()["dog"]]


def refined_sequences() -> list[str]:
    """Return those of them, 40, for which Animal Avatars gives out refined masks."""
    return evaluation_sequences()[: _known()["refined_masks"]]


def _known() -> dict[str, Any]:
    return read_toml(resources.files("rewild4d.datasets.cop3d") / "sequences.toml", "the sequences of CoP3D")


class Cop3d(VideoDataset):
    """CoP3D: films of cats and dogs with cameras and soft masks.

    Args:
        root: the folder that holds cat and dog, or one of these.
        masks: other masks, <sequence>/frame000012.png with the frame_number, as Animal Avatars gives them out.

    Raises:
        UserError: no such folder, or no annotations in it.
    """

    licence = LICENCE
    options = ("masks",)

    def __init__(self, root: Path, masks: Path | None = None) -> None:
        is_category = root.name in CATEGORIES and (root / FRAMES).is_file()
        self.root, self.masks = root.parent if is_category else root, Path(masks) if masks else None
        for folder in filter(None, (root, self.masks)):
            if not folder.is_dir():
                raise UserError(f"{folder}: expected a folder, got no such folder.")
        names = [root.name] if is_category else CATEGORIES
        self.categories = [name for name in names if (self.root / name / FRAMES).is_file()]
        if not self.categories:
            raise UserError(
                f"{root}: expected CoP3D's folder with cat/{FRAMES} or dog/{FRAMES} (metadata_000 of the download), "
                "got neither."
            )

    def cases(self, selection: Selection) -> list[str]:
        """Return every sequence whose folder is here, "<category>/<sequence>".

        Raises:
            UserError: annotations that cannot be read, or no folder of any sequence.
        """
        if not self._sequences:
            raise UserError(f"{self.root}: expected folders of sequences (<category>/<sequence>/images), got none.")
        return list(self._sequences)

    def default_cases(self, selection: Selection) -> list[str]:
        """Return the evaluation sequences that are here, in their order; all where none is."""
        return [name for name in evaluation_sequences() if name in self._sequences] or self.cases(selection)

    def set_list(self, category: str, name: str) -> dict[str, list[tuple[str, int, str]]]:
        """Return sequence, frame_number and image of each frame of a set list's subsets; name: "manyview_0".

        Raises:
            UserError: no such list.
        """
        return read_set_list(self.root / category / "set_lists" / f"set_lists_{name}.json")

    def load(self, case: str, selection: Selection) -> tuple[Clip, Truth]:
        """Return the frames of a sequence with their cameras; errors as of `video`."""
        return split_placed(self.video(case), selection)

    def originals(self, case: str, selection: Selection) -> None:
        """Return None: nothing is cut out of the frames, so there is nothing behind the images."""
        return None

    def video(self, case: str) -> Video:
        if case not in self._sequences:
            raise unknown_name("case", case, self._sequences)
        category, _, sequence = case.partition("/")
        annotations = read_frames(self.root / category / FRAMES, sequence)
        return _Sequence(self.root, case, annotations, self.masks, self._sequences[case]).video()

    @cached_property
    def _sequences(self) -> dict[str, SequenceAnnotation | None]:
        """Case -> what its category's file says of it, None where there is no such file."""
        found: dict[str, SequenceAnnotation | None] = {}
        for category in self.categories:
            folder = self.root / category
            said: dict[str, SequenceAnnotation] = {}
            if (folder / SEQUENCES).is_file():
                said = {one.sequence_name: one for one in read_jgz(folder / SEQUENCES, list[SequenceAnnotation])}
            here = sorted(path.parent.name for path in folder.glob("*/images"))
            found |= {f"{category}/{name}": said.get(name) for name in here if not said or name in said}
        return found


@dataclass(frozen=True)
class _Sequence:
    """One film."""

    root: Path
    name: str
    every: list[FrameAnnotation]
    masks: Path | None
    said: SequenceAnnotation | None

    def video(self) -> Video:
        """Return the frames that have an image, a mask and a camera.

        Raises:
            UserError: none of them has one of the three, a size or a camera that cannot be used, or damaged files.
        """
        frames, notes = self._complete()
        size = self._size(frames)
        times, fps, assumed = self._times()
        images = [self.root / frame.image.path for frame in frames]
        masks = [self._mask(frame) for frame in frames]
        other = open_masks(masks) if self.masks else None
        places = {frame.frame_number: place for place, frame in enumerate(self.every)}
        moments = tuple(
            Moment(f"frame {frame.frame_number}", times[place], place=place, camera=self._camera(frame, size))
            for frame in frames
            for place in (places[frame.frame_number],)
        )
        cameras = [part for m in moments if m.camera for part in (m.camera.world_to_camera, m.camera.intrinsics)]
        return Video(
            title=str(self.root / self.name), name=self.name, species=self.name.partition("/")[0], fps=fps,
            licence=LICENCE, identity=digest(files_identity(*images, *masks), repr(times), *cameras), size=size,
            moments=moments, images=partial(_images, images, size), masks=partial(_soft_masks, masks, other, size),
            notes=(*notes, *filter(None, (assumed, other.meaning.note if other else ""))),
        )  # fmt: skip

    def _complete(self) -> tuple[list[FrameAnnotation], list[str]]:
        """Return the frames that have all that is needed, and sentences on the others."""
        absent = "" if self.masks is None else f" in {self.masks}"
        lacking = {
            "an image": [frame for frame in self.every if not (self.root / frame.image.path).is_file()],
            f"a mask{absent}": [frame for frame in self.every if not self._has_mask(frame)],
            "a camera": [frame for frame in self.every if frame.viewpoint is None],
        }
        for what, frames in lacking.items():
            if len(frames) == len(self.every):
                hint = "" if absent else " (is its part of the download unpacked?)"
                raise UserError(
                    f"{self.root / self.name}: expected {what} for its {len(frames)} frames, got none{hint}."
                )
        left_out = {frame.frame_number for frames in lacking.values() for frame in frames}
        notes = [self._told(frames, f"without {what} left out") for what, frames in lacking.items()]
        used = [frame for frame in self.every if frame.frame_number not in left_out]
        if not used:
            raise UserError(f"{self.root / self.name}: expected frames with an image, a mask and a camera, got none.")
        return used, list(filter(None, notes))

    def _told(self, frames: Sequence[FrameAnnotation], what: str) -> str:
        chosen = {frame.frame_number for frame in frames}
        labels = [f"frame {frame.frame_number}" for frame in self.every]
        return listed(labels, [i for i, frame in enumerate(self.every) if frame.frame_number in chosen], what)

    def _has_mask(self, frame: FrameAnnotation) -> bool:
        return (self.masks is not None or frame.mask is not None) and self._mask(frame).is_file()

    def _mask(self, frame: FrameAnnotation) -> Path:
        if self.masks is not None:
            return self.masks / self.name.partition("/")[2] / f"frame{frame.frame_number:06d}.png"
        return self.root / (frame.mask.path if frame.mask else "")

    def _size(self, frames: Sequence[FrameAnnotation]) -> tuple[int, int]:
        """Return the width and height of all frames."""
        height, width = frames[0].image.size
        for frame in frames:
            if frame.image.size != (height, width) or min(height, width) < 1:
                raise UserError(
                    f"{self.root / frame.image.path}: expected images of {width}x{height} pixels like the sequence's "
                    f"first, got {frame.image.size[1]}x{frame.image.size[0]} in its annotation."
                )
        return width, height

    def _camera(self, frame: FrameAnnotation, size: tuple[int, int]) -> Any:
        assert frame.viewpoint is not None
        try:
            return to_opencv(frame.viewpoint, size)
        except ValueError as error:
            where = self.root / self.name.partition("/")[0] / FRAMES
            raise UserError(
                f"{where}: frame {frame.frame_number} of {frame.sequence_name}: expected {error}."
            ) from error

    def _times(self) -> tuple[list[float], float, str]:
        """Return the seconds of every frame, frames a second on average, and what was assumed, "" for nothing."""
        found = np.array([np.nan if one.frame_timestamp is None else one.frame_timestamp for one in self.every])
        if len(found) > 1 and (np.diff(found) > 0).all():
            return found.tolist(), (len(found) - 1) / float(found[-1] - found[0]), ""
        length = self.said.video.length if self.said and self.said.video else None
        fps = len(found) / length if length and 0 < length < np.inf else FPS
        first = self.every[0].frame_number
        told = f"the times of its frames do not ascend: {fps:.4g} frames a second assumed"
        return [(one.frame_number - first) / fps for one in self.every], fps, told


def _images(files: Sequence[Path], size: tuple[int, int]) -> Iterator[np.ndarray]:
    """Yield images as they are stored, which their cameras are for, uint8 [h, w, 3]."""
    for file in files:
        image = read_rgb(file)
        expect_size(file, image, size, "its annotation")
        yield image


def _soft_masks(files: Sequence[Path], other: MaskFiles | None, size: tuple[int, int]) -> Iterator[np.ndarray | None]:
    """Yield masks one after the other, uint8 [h, w]: CoP3D's own as they are stored, others by what they mean."""
    if other is not None:
        yield from read_masks(other, None, range(len(files)), size)
        return
    for file in files:
        mask = read_alpha(file)
        expect_size(file, mask, size, "its image")
        yield mask
