"""Read a person's own video: a file or a folder of frames, and masks of the animal in it.

Masks are a folder (named or numbered like the frames, or as many), a second video, or the alpha channel of the frames
themselves; root/masks is looked at where nothing is named. Images are turned as their EXIF says and videos as their
header says; frames keep their own time stamps, so any frame rate will do, a variable one too.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache, partial
from pathlib import Path

import numpy as np

from rewild4d.contracts import Selection
from rewild4d.datasets.keypoints.files import read_keypoints
from rewild4d.datasets.masking import masks as mask_files
from rewild4d.datasets.masking.makers import Unmasked
from rewild4d.datasets.masking.masks import MaskFiles, fit_size, match_masks, open_masks, read_transparency
from rewild4d.datasets.masking.meaning import Census, Meaning
from rewild4d.datasets.video.frame_files import FRAME_SUFFIXES, image_size, read_images, read_masks
from rewild4d.datasets.video.parts import with_parts
from rewild4d.datasets.video.reader import VideoDataset
from rewild4d.datasets.video.video_file import SUFFIXES, read_video, video_facts
from rewild4d.datasets.video.wild import Masks, Moment, Video, files_identity
from rewild4d.errors import UserError, unknown_name
from rewild4d.types import Keypoints

FOLDER_FPS = 25.0
"""Of a folder of frames where --fps is left out."""
MOST_FRAMES = 300
"""A longer video is thinned evenly where --fps is left out: more frames fill the memory and hardly help."""
LICENCE = "a person's own video; its terms are not known"


@dataclass(frozen=True)
class Material:
    """The frames of a video in order: image files, or one video file.

    Attributes:
        files: empty for a video file.
        times: seconds of every frame, ascending.
        size: width and height.
        has_alpha: whether the frames carry a mask of their own: any is transparent anywhere.
        notes: what was found wrong, a sentence each.
        stored: width and height before the pixels of a video were made square; None: they were.
    """

    files: tuple[Path, ...]
    times: tuple[float, ...]
    size: tuple[int, int]
    has_alpha: bool
    notes: tuple[str, ...]
    stored: tuple[int, int] | None = None


class Online(VideoDataset):
    """A person's own video, with masks.

    The case is called like the file or the folder; where masks hold several objects, each is a case of its own too:
    "clip@2".

    Args:
        root: a video file, a folder of frames, or a folder that holds one called frames (and one called masks).
        masks: folder of masks or a video of them.
        start: seconds from where on frames are used.
        end: seconds up to which frames are used.
        fps: frames per second that are kept; of a folder also the rate at which it was taken.
        parts: of the masks (`parts.Parts`).
        keypoints: a file of them (`keypoint_files`), which names the frames or counts those of the video from 0.

    Raises:
        UserError: no such file, or numbers that make no sense.
    """

    options = ("masks", "start", "end", "fps", "keypoints", "parts")
    licence = LICENCE

    def __init__(
        self,
        root: Path,
        masks: Path | str | None = None,
        start: float | str | None = None,
        end: float | str | None = None,
        fps: float | str | None = None,
        keypoints: Path | str | None = None,
        parts: str = "auto",
    ) -> None:
        self.root, self.parts = root, parts
        self.masks, self.keypoints = (Path(path) if path else None for path in (masks, keypoints))
        self.start, self.end, self.fps = (None if value is None else float(value) for value in (start, end, fps))
        for path in (self.root, *([self.masks] if self.masks else [])):
            if not path.exists():
                raise UserError(f"{path}: expected a video file or a folder of images, but there is no such thing.")
        if self.fps is not None and not 0 < self.fps <= 1000:
            raise UserError(f"--fps: expected a number above 0, up to 1000, got {self.fps:g}.")
        if (self.start or 0) < 0 or (self.end is not None and self.end <= (self.start or 0)):
            end = "no end" if self.end is None else f"{self.end:g}"
            raise UserError(f"--start and --end: expected 0 <= start < end, got {self.start or 0:g} and {end}.")

    def cases(self, selection: Selection) -> list[str]:
        """Return the video's name, and one for each object where its masks hold several."""
        return list(self._table)

    def default_cases(self, selection: Selection) -> list[str]:
        """Return the whole mask, or each object on its own where there are several."""
        return [case for case, number in self._table.items() if number is not None] or list(self._table)

    def video(self, case: str) -> Video:
        if case not in self._table:
            raise unknown_name("case", case, self._table)
        material, (indices, thinned) = self._material, self._chosen
        times = [material.times[i] for i in indices]
        span = times[-1] - times[0]
        masks, note = self._masks(self._table[case])
        points, outside = self._keypoints(masks)
        settings = f"{indices} {self._table[case]} {self.fps}"
        sources, labels = self._mask_sources, [file.name for file in material.files]
        video = Video(
            title=str(self.root), name=case, species="animal", fps=(len(times) - 1) / span if span else FOLDER_FPS,
            licence=LICENCE, identity=files_identity(*(material.files or (self.root,)), *sources) + settings,
            size=material.size,
            moments=tuple(Moment(labels[i] if labels else f"frame {i}", material.times[i], points[i]) for i in indices),
            images=self._images, masks=masks,
            notes=(*material.notes, *(text for text in (thinned, note, outside) if text)),
        )  # fmt: skip
        return with_parts(video, self.parts, is_named=self._table[case] is None and len(self._table) > 1)

    def unmasked(self, case: str) -> Unmasked:
        """Return the chosen frames for programs that make masks; these are named by frame number."""
        stems = tuple(self._stems[i] for i in self._chosen[0])
        return Unmasked(str(self.root), stems, self._material.size, self._images, {})

    @property
    def _stems(self) -> list[str]:
        """Names of all frames; of a video their numbers."""
        return [f.stem for f in self._material.files] or [f"{i:05d}" for i in range(len(self._material.times))]

    def _keypoints(self, masks: Masks) -> tuple[list[Keypoints | None], str]:
        """Return the keypoints of every frame, and a note on what of their file is not used.

        Args:
            masks: of the chosen frames, by which the animal is known among several.
        """
        if self.keypoints is None:
            return [None] * len(self._material.times), ""
        indices, size, stored = self._chosen[0], self._material.size, self._material.stored
        looks = partial(_numbered, indices, masks)
        found, told = read_keypoints(self.keypoints, self._stems, size, looks, stored)
        return found, "; ".join(filter(None, ("keypoints stretched like the frames" if stored else "", told)))

    @property
    def name(self) -> str:
        """Return the name of the video's file or folder."""
        return self.root.stem if self.root.is_file() else self.root.resolve().name

    @cached_property
    def _material(self) -> Material:
        if self.root.is_file():
            if self.root.suffix.lower() in FRAME_SUFFIXES:
                raise UserError(f"{self.root}: expected a video or a folder of frames, got one image.")
            facts = video_facts(self.root)
            fault = f"ffmpeg complains of the video, {len(facts.times)} frames were read: {facts.faults}"
            notes = (fault if facts.faults else "", facts.pace, *facts.changes)
            told, size = tuple(note for note in notes if note), (facts.width, facts.height)
            return Material((), facts.times, size, facts.has_alpha, told, facts.stored if facts.is_stretched else None)
        inner = (self.root / name for name in ("frames", "images"))
        folder = next((path for path in inner if path.is_dir()), self.root)
        files = tuple(mask_files.list_images(folder, FRAME_SUFFIXES))
        if not files:
            expected = f"frames ({', '.join(FRAME_SUFFIXES)})"
            videos = [entry.name for entry in folder.iterdir() if entry.suffix.lower() in SUFFIXES]
            hint = f", but there is {videos[0]}: name that file" if videos else ", got none"
            raise UserError(f"{folder}: expected {expected}{hint}.")
        rate = self.fps or FOLDER_FPS
        size = image_size(files[0])
        has_alpha = any(alpha is not None and bool((alpha < 255).any()) for alpha in map(read_transparency, files))
        assumed = f"a folder of frames has no frame rate: {FOLDER_FPS:g} a second assumed (--fps)"
        times = tuple(i / rate for i in range(len(files)))
        return Material(files, times, size, has_alpha, () if self.fps else (assumed,))

    @cached_property
    def _chosen(self) -> tuple[list[int], str]:
        """Indices of the frames between --start and --end at --fps, and a sentence where they were thinned unasked."""
        times = self._material.times
        low, high = self.start or 0.0, self.end if self.end is not None else float("inf")
        inside = [i for i, time in enumerate(times) if low <= time <= high]
        if not inside:
            raise UserError(
                f"{self.root}: expected frames between {low:g} and {high:g} s, but the last is at {times[-1]:.2f} s."
            )
        if self.fps and not self._material.files:
            return _thinned([times[i] for i in inside], inside, self.fps), ""
        if len(inside) > MOST_FRAMES and not self.fps:
            step = -(-len(inside) // MOST_FRAMES)
            return inside[::step], f"{len(inside)} frames thinned to every {step}th (--fps and --end choose otherwise)"
        return inside, ""

    @cached_property
    def _table(self) -> dict[str, int | None]:
        """Case -> object id (None: all that the masks hold)."""
        name = self.name
        ids = self._mask_match[0].ids if self._mask_match else ()
        return {name: None} | {f"{name}@{number}": number for number in ids if len(ids) > 1}

    @cached_property
    def _mask_place(self) -> Path | None:
        """The folder or video of masks, or None where they are the frames' alpha."""
        beside = self.root / "masks" if self.root.is_dir() else None
        place = self.masks or (beside if beside and beside.is_dir() else None)
        if place is None and not self._material.has_alpha:
            raise UserError(
                f"{self.root}: expected masks of the animal, but no frame is transparent anywhere and no --masks was "
                "given; `rewild4d-bench masks` makes some."
            )
        return place

    @cached_property
    def _mask_match(self) -> tuple[MaskFiles, str] | None:
        """The mask of each chosen frame where masks lie in a folder."""
        if self._mask_place is None or not self._mask_place.is_dir():
            return None
        found, (indices, _) = mask_files.list_images(self._mask_place), self._chosen
        stems = [file.stem for file in self._material.files] or [str(i) for i in range(len(self._material.times))]
        if len(found) == len(indices) < len(stems):  # made from the chosen frames alone
            matched, note = match_masks(found, [stems[i] for i in indices], self._mask_place)
            if None in matched:  # as many masks as chosen frames, but numbered by themselves
                matched = list(found)
                note = f"one mask for each of the {len(found)} chosen frames: matched in order, {found[0].name} first"
        else:
            every, note = match_masks(found, stems, self._mask_place)
            matched = [every[i] for i in indices]
        masks = replace(open_masks(matched), stored=self._material.stored)
        return masks, "; ".join(filter(None, (note, masks.meaning.note)))

    @property
    def _mask_sources(self) -> Sequence[Path | None]:
        if self._mask_match:
            return self._mask_match[0].files
        return (self._mask_place,) if self._mask_place else ()

    def _masks(self, object_id: int | None) -> tuple[Masks, str]:
        size, (indices, _) = self._material.size, self._chosen
        if self._mask_match:
            masks, note = self._mask_match
            if masks.meaning.note and len(masks.ids) > 1:
                taken = "all of them" if object_id is None else f"object {object_id}"
                note = f"{note}, of which this case takes {taken} (--case)"
            return partial(read_masks, masks, object_id, range(len(indices)), size), note
        if self._mask_place is None:
            notes = "masks are the frames' alpha channel", self._alpha_meaning.note
            return self._alphas, "; ".join(filter(None, notes))
        return self._video_masks(self._mask_place)

    def _video_masks(self, path: Path) -> tuple[Masks, str]:
        """Return masks out of a video: of all frames, or of the chosen ones only."""
        facts, (indices, _) = video_facts(path), self._chosen
        total = len(self._material.times)
        if len(facts.times) == total:
            chosen, note = indices, ""
        elif len(facts.times) == len(indices):
            chosen, note = list(range(len(indices))), "the video of masks is matched to the chosen frames in order"
        else:
            raise UserError(
                f"{path}: expected a mask for each of the {total} frames of {self.root.name}, got {len(facts.times)}."
            )
        meaning = _film_meaning(path, files_identity(path), tuple(chosen), facts.has_alpha)
        masks = partial(_mask_stream, path, chosen, self._material, facts.has_alpha, meaning)
        return masks, "; ".join(filter(None, (note, meaning.note)))

    def _images(self) -> Iterator[np.ndarray]:
        indices = self._chosen[0]
        if self._material.files:
            return read_images([self._material.files[i] for i in indices], self._material.size)
        return (frame[..., :3] for frame in read_video(self.root, indices))

    @cached_property
    def _alpha_meaning(self) -> Meaning:
        census = Census(is_lossy=True)
        for alpha in self._stored_alphas():
            if alpha is not None:
                census.add(alpha)
        return census.meaning()

    def _alphas(self) -> Iterator[np.ndarray | None]:
        meaning = self._alpha_meaning
        return (None if alpha is None else meaning.mask(alpha, None) for alpha in self._stored_alphas())

    def _stored_alphas(self) -> Iterator[np.ndarray | None]:
        indices = self._chosen[0]
        if self._material.files:
            chosen = [self._material.files[i] for i in indices]
            found, size = zip(chosen, map(read_transparency, chosen), strict=True), self._material.size
            return (None if alpha is None else fit_size(alpha, size, str(file)) for file, alpha in found)
        return (frame[..., 3] for frame in read_video(self.root, indices))


def _numbered(indices: Sequence[int], masks: Masks) -> Iterator[tuple[int, np.ndarray | None]]:
    return zip(indices, masks(), strict=False)


def _thinned(times: list[float], indices: list[int], fps: float) -> list[int]:
    """Return the frames nearest to an even grid, each once."""
    grid = np.arange(times[0], times[-1] + 0.5 / fps, 1 / fps)
    after = np.searchsorted(times, grid).clip(1, max(1, len(times) - 1))
    before = after - 1
    known = np.asarray([*times, times[-1]]) if len(times) == 1 else np.asarray(times)
    nearest = np.where(grid - known[before] <= known[after] - grid, before, after)
    return [indices[i] for i in sorted(set(nearest.tolist())) if i < len(indices)]


@lru_cache(maxsize=4)
def _film_meaning(path: Path, identity: str, indices: tuple[int, ...], alpha: bool) -> Meaning:
    """Return what the shades of a film of masks mean, of a file that is known by its ``identity``."""
    census = Census(is_lossy=True)
    for shades in _film_shades(path, indices, alpha):
        census.add(shades)
    return census.meaning()


def _film_shades(path: Path, indices: Sequence[int], alpha: bool) -> Iterator[np.ndarray]:
    for frame in read_video(path, indices):
        shades = frame[..., 3] if alpha else mask_files.shades(frame[..., :3], mask_files.FILM_TINT)
        yield np.ascontiguousarray(shades)


def _mask_stream(
    path: Path, indices: Sequence[int], material: Material, alpha: bool, meaning: Meaning
) -> Iterator[np.ndarray | None]:
    for shades in _film_shades(path, indices, alpha):
        yield fit_size(meaning.mask(shades, None), material.size, str(path), material.stored)
