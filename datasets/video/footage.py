"""List folders of images or of clips in natural order, match them by name, read them on demand.

A folder holds either images, or clips: subfolders of frames, or video files. An image is a PNG, a JPEG or an .npy array
[h, w], [h, w, 3] or [h, w, 4] (floats in [0, 1], or unsigned integers over their full range).
"""

import math
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any, TypeVar

import imageio.v2 as imageio
import numpy as np
import torch
from torch import Tensor

from rewild4d.datasets.images import read_picture
from rewild4d.datasets.video.video_file import read_video, video_facts
from rewild4d.errors import UserError
from rewild4d.files import natural
from rewild4d.foreign.reading import FILM, read_array, require_room

IMAGES = (".png", ".jpg", ".jpeg", ".npy")
VIDEOS = (".mp4", ".mov", ".avi", ".mkv", ".webm")
LUMINANCE = np.array((0.299, 0.587, 0.114), dtype=np.float32)
WHITE = 0.5
"""A mask is inside from here on; one that has values, but none as large, was made for another convention."""

T = TypeVar("T")


@dataclass(frozen=True)
class Picture:
    """One image as its file holds it.

    Attributes:
        label: its path, or the video's path and the frame.
        rgb: straight colour in [0, 1], float32, [3, h, w].
        alpha: straight alpha in [0, 1], float32, [1, h, w]; None where the file has none.
    """

    label: str
    rgb: Tensor
    alpha: Tensor | None

    def over(self, background: float) -> Tensor:
        """Return the image on a grey level; as it is where it has no alpha, [3, h, w]."""
        if self.alpha is None:
            return self.rgb
        return (self.rgb * self.alpha + (1 - self.alpha) * background).clamp(0, 1)


@dataclass(frozen=True)
class Reel:
    """Images in order: a folder of image files, or a video.

    Attributes:
        path: the folder or the video file.
        files: the image files; empty for a video.
        fps: of a video; None for files.
    """

    path: Path
    files: tuple[Path, ...]
    fps: float | None = None

    def __len__(self) -> int:
        return len(self.files) or len(_video_frames(self.path))

    def label(self, index: int) -> str:
        """Return the path of an image; for a video with the frame behind it."""
        return str(self.files[index]) if self.files else f"{self.path}, frame {index}"

    def picture(self, index: int) -> Picture:
        """Return one image.

        Raises:
            UserError: it cannot be read, is damaged, or holds other than numbers in [0, 1].
        """
        rgb, alpha = self._read(index)
        return Picture(self.label(index), _planes(rgb), None if alpha is None else _planes(alpha))

    def matte(self, index: int) -> Tensor:
        """Return one image as a mask: its alpha where that is not opaque, else its luminance, [1, h, w] in [0, 1].

        Raises:
            UserError: as `picture`, or a mask whose inside is not white: labels, palette indices, 0 and 1 in bytes.
        """
        rgb, alpha = self._read(index)
        values = rgb @ LUMINANCE if alpha is None or bool((alpha == 1).all()) else alpha
        if 0 < float(values.max()) < WHITE:
            raise UserError(
                f"{self.label(index)}: expected a mask that is white (255, or 1.0) inside, "
                f"got no value above {255 * float(values.max()):.3g} of 255."
            )
        return _planes(values)

    def _read(self, index: int) -> tuple[np.ndarray, np.ndarray | None]:
        """Return the colour [h, w, 3] and alpha [h, w] or None, float32 in [0, 1]."""
        if not self.files:
            frame = _video_frames(self.path)[index] / np.float32(255)
            return frame[..., :3], frame[..., 3] if frame.shape[2] == 4 else None
        path = self.files[index]
        return _read_array(path) if path.suffix.lower() == ".npy" else read_picture(path)


@dataclass(frozen=True)
class Footage:
    """What a path holds: one reel of images that need not be a clip, or clips."""

    path: Path
    clips: bool
    reels: tuple[Reel, ...]


def open_footage(path: Path) -> Footage:
    """List what a folder (or a single video file) holds; nothing is decoded.

    Raises:
        UserError: no such folder, nothing in it that can be read, or images and clips mixed.
    """
    if path.is_file() and path.suffix.lower() in VIDEOS:
        return Footage(path, True, (_video(path),))
    entries = _entries(path)
    files = _of_kind(entries, IMAGES)
    clips = [_clip(entry) for entry in entries if entry.is_dir() or entry.suffix.lower() in VIDEOS]
    if files and clips:
        raise UserError(f"{path}: expected either images or clips, got {files[0].name} beside {clips[0].path.name}.")
    if not files and not clips:
        raise UserError(
            f"{path}: expected images ({', '.join(IMAGES)}), folders of frames or videos ({', '.join(VIDEOS)}), "
            f"got {f'{len(entries)} other files' if entries else 'an empty folder'}."
        )
    return Footage(path, not files, tuple(clips) or (Reel(path, tuple(files)),))


def match_reels(ours: Footage, theirs: Footage, in_order: bool = False) -> tuple[list[Reel], list[str]]:
    """Return the reels of ``ours`` in the order of ``theirs``, matched by name; and a note where order had to do.

    Args:
        ours: clips or images.
        theirs: the same.
        in_order: match in sorted order where no name is shared and the counts agree.

    Raises:
        UserError: one holds images and the other clips, or the names do not match.
    """
    if ours.clips != theirs.clips:
        kinds = ["clips" if side.clips else "images" for side in (ours, theirs)]
        raise UserError(f"{ours.path}: expected {kinds[1]} like {theirs.path}, got {kinds[0]}.")
    if not ours.clips or len(ours.reels) == len(theirs.reels) == 1:
        return list(ours.reels), []
    return _match(ours.reels, theirs.reels, lambda reel: reel.path.stem, (ours.path, theirs.path), in_order)


def match_images(ours: Reel, theirs: Reel, in_order: bool = False) -> tuple[Reel, list[str]]:
    """Return ``ours`` with its images in the order of ``theirs``, matched by name; and a note where order had to do.

    Args:
        ours: a clip or a folder of images.
        theirs: the same.
        in_order: match in sorted order where no name is shared and the counts agree.

    Raises:
        UserError: the names do not match, or a video has another number of frames.
    """
    if ours.files and theirs.files:
        files, notes = _match(ours.files, theirs.files, lambda file: file.stem, (ours.path, theirs.path), in_order)
        return Reel(ours.path, tuple(files)), notes
    if len(ours) != len(theirs):
        raise UserError(f"{ours.path}: expected {len(theirs)} frames like {theirs.path}, got {len(ours)}.")
    return ours, []


def _match(
    ours: Sequence[T], theirs: Sequence[T], name: Callable[[T], str], paths: tuple[Path, Path], in_order: bool
) -> tuple[list[T], list[str]]:
    """Return ``ours`` in the order of ``theirs``: by name, or in order if asked for and no name is shared."""
    our_path, their_path = paths
    by_name = {name(item): item for item in ours}
    wanted = [name(item) for item in theirs]
    missing = [word for word in wanted if word not in by_name]
    extra = [word for word in by_name if word not in set(wanted)]
    if not missing and not extra:
        return [by_name[word] for word in wanted], []
    if len(missing) == len(extra) == len(wanted):
        first = f"{next(iter(by_name))} with {wanted[0]}"
        if in_order:
            return list(ours), [f"{our_path} and {their_path} share no name: matched in sorted order, {first} first"]
        raise UserError(
            f"{our_path}: expected the {len(wanted)} names of {their_path}, but they share none; --pair order matches "
            f"them in sorted order, {first} first."
        )
    faults = [f"none for {missing[0]}" if missing else "", f"{extra[0]} too many" if extra else ""]
    raise UserError(
        f"{our_path}: expected the {len(wanted)} names of {their_path}, got {len(by_name)}: "
        f"{' and '.join(fault for fault in faults if fault)}."
    )


def _clip(path: Path) -> Reel:
    if not path.is_dir():
        return _video(path)
    files = _of_kind(_entries(path), IMAGES)
    if not files:
        raise UserError(f"{path}: expected a clip's frames ({', '.join(IMAGES)}), got none.")
    return Reel(path, tuple(files))


def _entries(folder: Path) -> list[Path]:
    """Return what a folder holds in natural order (2 before 10), hidden entries left out."""
    try:
        found = [entry for entry in folder.iterdir() if not entry.name.startswith(".")]
    except OSError as error:
        raise UserError(f"{folder}: expected a folder of images or clips, but: {error.strerror}.") from error
    return sorted(found, key=natural)


def _of_kind(entries: Sequence[Path], suffixes: Sequence[str]) -> list[Path]:
    files = [entry for entry in entries if entry.suffix.lower() in suffixes and not entry.is_dir()]
    names: dict[str, Path] = {}
    for file in files:
        if file.stem in names:
            raise UserError(f"{file}: expected one image of that name, but there is {names[file.stem].name} too.")
        names[file.stem] = file
    return files


def _planes(image: np.ndarray) -> Tensor:
    """[h, w, c] or [h, w] -> [c, h, w]."""
    return torch.from_numpy(np.ascontiguousarray(np.atleast_3d(image), dtype=np.float32)).permute(2, 0, 1)


def _read_array(path: Path) -> tuple[np.ndarray, np.ndarray | None]:
    """Return the colour and alpha of an .npy array, as `read_picture` gives them."""
    values = read_array(path, "a whole .npy array of numbers")
    if values.size == 0 or values.dtype.kind not in "bfu":
        raise UserError(f"{path}: expected floats in [0, 1] or unsigned integers, got {_described(values)}.")
    if values.ndim not in (2, 3) or (values.ndim == 3 and values.shape[2] not in (3, 4)):
        raise UserError(f"{path}: expected an array [h, w], [h, w, 3] or [h, w, 4], got {_described(values)}.")
    scaled = values.astype(np.float32) / (np.iinfo(values.dtype).max if values.dtype.kind == "u" else 1)
    if not bool(((scaled >= 0) & (scaled <= 1)).all()):
        found = "a NaN" if np.isnan(scaled).any() else f"{scaled.min():g} to {scaled.max():g}"
        raise UserError(f"{path}: expected values in [0, 1], got {found}.")
    if scaled.ndim == 2:
        return np.repeat(scaled[..., None], 3, axis=2), None
    return scaled[..., :3], scaled[..., 3] if scaled.shape[2] == 4 else None


def _described(values: np.ndarray) -> str:
    return f"{values.dtype} {list(values.shape)}"


def _video(path: Path) -> Reel:
    """Return a video; its frame rate is read now, its frames later."""
    with _reader(path) as reader:
        return Reel(path, (), float(reader.get_meta_data()["fps"]))


@lru_cache(maxsize=4)
def _video_frames(path: Path) -> list[np.ndarray]:
    """Return every frame, each once at any frame rate, uint8 [h, w, 3], or [h, w, 4] where any is transparent anywhere.

    Four videos are kept: a prediction, its truth and their masks.
    """
    with _reader(path) as reader:
        about = reader.get_meta_data()
    seconds, step = about["duration"], 1 / about["fps"]
    (width, height), said = about["size"], seconds / step if math.isfinite(seconds / step) else 0.0
    kind = "a film whose frames are held together"
    require_room(path, round(said) * width * height * 4, kind, FILM)
    facts = video_facts(path)
    require_room(path, len(facts.times) * facts.width * facts.height * 4, kind, FILM)
    shown = facts.times[-1] + step
    if facts.is_stamped and shown < 0.9 * seconds - step:
        raise UserError(f"{path}: expected {seconds:.2f} s as its header says, got {shown:.2f} s: it is cut off.")
    channels = 4 if facts.has_alpha else 3
    return [frame[..., :channels] for frame in read_video(path)]


@contextmanager
def _reader(path: Path) -> Iterator[Any]:
    try:
        with imageio.get_reader(path, format="ffmpeg") as reader:  # type: ignore[arg-type]
            yield reader
    except (OSError, RuntimeError, ValueError) as error:
        raise UserError(f"{path}: expected a video that ffmpeg can read, got a damaged or another file.") from error
