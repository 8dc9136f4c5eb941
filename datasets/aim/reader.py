"""Read Animal-in-Motion (AiM, Zhao et al. 2025): crops of animals out of films (the layout: `files`).

AiM is given out without RGB: a script of its authors restores it from YouTube, as far as the films are still there. So
frames without an image or a mask are left out and told.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property, partial
from pathlib import Path

import numpy as np

from rewild4d.contracts import Selection
from rewild4d.datasets.aim.files import (
    UNSAID,
    FrameFiles,
    benchmark_tracks,
    find_tracks,
    list_frames,
    read_crop,
    read_fps,
    read_keypoints,
)
from rewild4d.datasets.images import expect_size, read_alpha
from rewild4d.datasets.video.frame_files import image_size, read_images
from rewild4d.datasets.video.placed import split_placed
from rewild4d.datasets.video.reader import VideoDataset
from rewild4d.datasets.video.wild import Moment, Video, files_identity, listed
from rewild4d.errors import UserError, unknown_name
from rewild4d.types import Clip, Truth

LICENCE = "frames from YouTube, no licence stated (Animal-in-Motion, Zhao et al. 2025): do not pass on"
RESTORE = "python tools/restore_rgb_data.py --data_dir DATA --video_dir NEW_FOLDER"
"""How RGB is restored, in a checkout of github.com/briannlongzhao/Animal-in-Motion; --video_dir must not exist yet."""


class Aim(VideoDataset):
    """Animal-in-Motion (AiM): crops of 23 species out of films, with masks and predicted keypoints.

    Args:
        root: the data set's folder, with or without a level of splits; or one category, or one track.

    Raises:
        UserError: no such folder, or no track in it.
    """

    licence = LICENCE
    options = ()
    keypoint_mapping, keypoint_use = "aptv2", "none"

    def __init__(self, root: Path) -> None:
        self.root = root
        self._tracks = find_tracks(root)

    def cases(self, selection: Selection) -> list[str]:
        """Return every track, "<category>/<track>"."""
        return list(self._tracks)

    def default_cases(self, selection: Selection) -> list[str]:
        """Return the tracks of the benchmark that are here; all where none is."""
        wanted = {f"{category}/{track}" for category, tracks in benchmark_tracks().items() for track in tracks}
        return [name for name in self._tracks if name in wanted] or list(self._tracks)

    def load(self, case: str, selection: Selection) -> tuple[Clip, Truth]:
        """Return the crops of a track as they are; errors as of `video`."""
        return split_placed(self.video(case), selection)

    def originals(self, case: str, selection: Selection) -> None:
        """Return None: the whole frames of the films are not part of the data set."""
        return None

    def video(self, case: str) -> Video:
        if case not in self._tracks:
            raise unknown_name("case", case, self._tracks)
        return _Track(case, self._tracks[case]).video()


@dataclass(frozen=True)
class _Track:
    """One animal of one clip."""

    name: str
    folder: Path

    @cached_property
    def every(self) -> list[FrameFiles]:
        return list_frames(self.folder)

    def video(self) -> Video:
        """Return the frames that have an image, a mask and metadata.

        Raises:
            UserError: none of them has one of the three, or a file that cannot be used.
        """
        frames, notes = self._complete()
        fps, rgb, masks = read_fps(self.folder), [frame.rgb for frame in frames], [frame.mask for frame in frames]
        images = [file for file in rgb if file is not None]
        size = image_size(images[0])
        moments, more = self._moments(frames, fps, size)
        files = (*rgb, *masks, *(frame.metadata for frame in frames), *(frame.keypoints for frame in frames))
        return Video(
            title=str(self.folder), name=self.name, species=self.folder.parent.name, fps=fps, licence=LICENCE,
            identity=files_identity(*files), size=size, moments=moments, images=partial(read_images, images, size),
            masks=partial(_masks, [file for file in masks if file is not None], size), notes=(*notes, *more),
        )  # fmt: skip

    def _complete(self) -> tuple[list[FrameFiles], tuple[str, ...]]:
        """Return the frames that have all that is needed, and a sentence on the others."""
        lacking = {
            "a mask": [frame for frame in self.every if frame.mask is None],
            "an RGB image": [frame for frame in self.every if frame.rgb is None],
            "metadata": [frame for frame in self.every if frame.metadata is None],
        }
        for what, name in (("a mask", "mask.png"), ("an RGB image", "rgb.png"), ("metadata", "metadata.json")):
            if len(lacking[what]) == len(self.every):
                hint = f"; AiM's own script restores them: {RESTORE}" if name == "rgb.png" and self.every else ""
                raise UserError(f"{self.folder}: expected files <frame>_{name}, got none{hint}.")
        left_out = {frame.number for frames in lacking.values() for frame in frames}
        notes = [self._told(frames, f"without {what} left out") for what, frames in lacking.items()]
        used = [frame for frame in self.every if frame.number not in left_out]
        if not used:
            raise UserError(f"{self.folder}: expected frames with an image, a mask and metadata, got none with all.")
        return used, tuple(filter(None, notes))

    def _moments(
        self, frames: Sequence[FrameFiles], fps: float, size: tuple[int, int]
    ) -> tuple[tuple[Moment, ...], tuple[str, ...]]:
        """Return what is known of the frames, and sentences on what is not."""
        places = {frame.number: place for place, frame in enumerate(self.every)}
        moments, unsaid = [], []
        for frame in frames:
            assert frame.metadata is not None
            crop, is_stated = read_crop(frame.metadata)
            unsaid += [] if is_stated else [frame]
            points = read_keypoints(frame.keypoints, size) if frame.keypoints else None
            label = f"{frame.number:08d}"
            moments.append(Moment(label, frame.number / fps, points, places[frame.number], crop=crop))
        assumed = f"whose film's size is not stated, taken as {UNSAID[0]}x{UNSAID[1]}"
        silent = [frame for frame in frames if frame.keypoints is None]
        notes = (self._told(unsaid, assumed), self._told(silent, "without keypoints"))
        return tuple(moments), tuple(filter(None, notes))

    def _told(self, frames: Sequence[FrameFiles], what: str) -> str:
        """Return a sentence about some frames, "" about none."""
        chosen = {frame.number for frame in frames}
        return listed(
            [f"{frame.number:08d}" for frame in self.every],
            [place for place, frame in enumerate(self.every) if frame.number in chosen],
            what,
        )


def _masks(files: Sequence[Path], size: tuple[int, int]) -> Iterator[np.ndarray]:
    """Yield masks one after the other, uint8 [h, w]; a `UserError` where one has another size than its image."""
    for file in files:
        mask = read_alpha(file)
        expect_size(file, mask, size, "its image")
        yield mask
