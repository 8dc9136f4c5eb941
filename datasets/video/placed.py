"""A video whose frames are used as they are: squares that the data set cut itself, or whole frames with cameras.

Nothing is cut around the animal here. A frame is scaled, and where it has to be square it is padded on both sides.
"""

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch

from rewild4d.contracts import Selection
from rewild4d.datasets.images import Window, target_size
from rewild4d.datasets.video.splits import is_held_out, scores_shown
from rewild4d.datasets.video.travel import TravelMeter
from rewild4d.datasets.video.wild import LEAST_AREA, LEAST_FRAMES, Video, told
from rewild4d.errors import UserError
from rewild4d.files import atomic, cache_folder, digest
from rewild4d.types import Camera, Clip, Frame, Keypoints, Truth

_CACHE_VERSION = "1"


def split_placed(video: Video, selection: Selection) -> tuple[Clip, Truth]:
    """Return the frames that a method gets and those that are scored, with the camera or the crop of each.

    Which are held out is told by a frame's place among all frames of the video (`Moment.place`), so that files that are
    missing move nothing.

    Raises:
        UserError: too few usable frames, files that cannot be read, or a selection for other videos.
    """
    known = all(moment.camera is not None for moment in video.moments)
    cameras, split = "known" if known else "unknown", selection.split
    if selection.framing == "crop" or selection.cameras != cameras or not isinstance(split, tuple):
        raise UserError(
            f"{video.title}: expected a protocol that takes these frames as they are (cameras = '{cameras}', framing = "
            "'full' or 'letterbox', split = [shown, held out])."
        )
    frames, missing = _usable(video, selection)
    places = [video.moments[row].place for row in frames.rows]
    held_out = [row for row, place in zip(frames.rows, places, strict=True) if is_held_out(place, split)]
    shown = frames.only([row for row in frames.rows if row not in held_out])
    hidden = shown if scores_shown(split) else frames.only(held_out)
    notes = (*video.notes, missing, _said(selection, len(shown), len(hidden)))
    travel = None if known else _between(frames.travel, shown.rows)
    parts = (shown.digest(),) if travel is None else (shown.digest(), travel)
    clip = Clip(
        video.name, video.species, tuple(shown), video.fps / selection.stride, video.licence, digest(*parts),
        tuple(note for note in notes if note), start=frames.start, travel=travel,
    )  # fmt: skip
    return clip, Truth(hidden, None, hidden.digest())


def _usable(video: Video, selection: Selection) -> tuple["PlacedFrames", str]:
    """Return the frames that a selection asks for and that show the animal, and a sentence on those that do not."""
    most = selection.frames if selection.frames is not None else np.inf
    asked = [
        row for row, moment in enumerate(video.moments)
        if 0 <= moment.place < most and moment.place % selection.stride == 0
    ]  # fmt: skip
    every = PlacedFrames(video, selection, asked)
    seen = [row for row in asked if every.area(row) >= LEAST_AREA]
    if len(seen) < LEAST_FRAMES:
        raise UserError(
            f"{video.title}: expected at least {LEAST_FRAMES} frames with a mask of the animal, got {len(seen)} of "
            f"{len(asked)}."
        )
    return every.only(seen), told(video, [row for row in asked if row not in seen], "without the animal left out")


def _said(selection: Selection, shown: int, hidden: int) -> str:
    if scores_shown(selection.split):
        return f"all {shown} frames are shown and scored: nothing is held out, as this protocol has it"
    return "" if hidden else f"none of its {shown} frames is held out: nothing can be scored"


def _between(travel: np.ndarray, rows: Sequence[int]) -> torch.Tensor:
    """Add up the motion from one of these rows to the next, [len(rows) - 1, 2]."""
    reached = np.concatenate((np.zeros((1, 2)), np.cumsum(travel, axis=0)))
    return torch.from_numpy(np.diff(reached[list(rows)], axis=0).astype(np.float32))


class PlacedFrames(Sequence[Frame]):
    """Some frames of a video, from a memory map on access.

    Args:
        video: whose frames; decoded once for a size and framing.
        selection: gives both, and the threshold of masks.
        rows: indices of moments, ascending.
    """

    def __init__(self, video: Video, selection: Selection, rows: Sequence[int]) -> None:
        self.video, self.selection, self.rows = video, selection, list(rows)
        folder = _decoded(video, selection)
        self._rgba, self.travel = np.load(folder / "rgba.npy", mmap_mode="r"), np.load(folder / "travel.npy")
        self.start = video.moments[self.rows[0]].time if self.rows else 0.0

    def only(self, rows: Sequence[int]) -> "PlacedFrames":
        """Return other rows of the same video; time starts with the first of those here."""
        found = PlacedFrames(self.video, self.selection, rows)
        found.start = self.start
        return found

    def area(self, row: int) -> int:
        """Return the pixels of the animal in an image."""
        return int((self._mask(row) > (0.5 if self.selection.mask_threshold is None else 0.0)).sum())

    def __len__(self) -> int:
        return len(self.rows)

    def __getitem__(self, index: Any) -> Any:
        if isinstance(index, slice):
            return [self[item] for item in range(*index.indices(len(self)))]
        row = self.rows[index]
        moment, mask = self.video.moments[row], torch.from_numpy(self._mask(row))[None]
        rgb = torch.from_numpy(self._rgba[row, ..., :3].astype(np.float32) / 255).permute(2, 0, 1) * mask
        camera = moment.camera and _framed(moment.camera, self.selection)
        return Frame(moment.time - self.start, camera, rgb.contiguous(), mask, 0, moment.crop, self._keypoints(row))

    def digest(self) -> str:
        """Return SHA-256 over times, cameras, crops, keypoints, pixels and the threshold of the masks."""
        parts: list[str | torch.Tensor | np.ndarray] = [repr(self.selection.mask_threshold)]
        for row in self.rows:
            moment, points = self.video.moments[row], self._keypoints(row)
            parts += [repr(moment.time - self.start), repr(moment.crop), self._rgba[row]]
            parts += [moment.camera.world_to_camera, moment.camera.intrinsics] if moment.camera else []
            parts += [points.points, points.visible] if points else []
            parts += [points.confidence] if points and points.confidence is not None else []
        return digest(*parts)

    def _mask(self, row: int) -> np.ndarray:
        """Return a mask, soft or solid above the threshold, float32 [h, w]."""
        soft, threshold = self._rgba[row, ..., 3].astype(np.float32) / 255, self.selection.mask_threshold
        return soft if threshold is None else (soft > threshold).astype(np.float32)

    def _keypoints(self, row: int) -> Keypoints | None:
        found, window = self.video.moments[row].keypoints, _window(self.video.size, self.selection)
        if found is None:
            return None
        width, height = target_size(self.video.size, self.selection)
        scale = found.points.new_tensor((width / window.width, height / window.height))
        points = (found.points - found.points.new_tensor((window.left, window.top))) * scale
        return Keypoints(found.names, points, found.visible, found.confidence)


def _window(size: tuple[int, int], selection: Selection) -> Window:
    """Return the part of a frame that an image shows: all of it, or the square around it."""
    if selection.framing == "full":
        return Window(0, 0, *size)
    side = max(size)
    return Window((size[0] - side) // 2, (size[1] - side) // 2, side, side)


def _framed(camera: Camera, selection: Selection) -> Camera:
    """Return the camera of an image, from that of the whole frame."""
    size = camera.width, camera.height
    return _window(size, selection).camera(camera, *target_size(size, selection))


def _decoded(video: Video, selection: Selection) -> Path:
    """Return the folder with all frames of a video at the size of a selection, made where it is not there yet.

    rgba.npy holds straight colours and soft masks, uint8 [T, h, w, 4]; travel.npy the motion of the animal over the
    background in pixels of these images, zero where cameras are known, [T - 1, 2].
    """
    parts = [_CACHE_VERSION, video.identity, str(selection.size), selection.framing]
    folder = cache_folder() / "placed" / digest(*parts)[:32]
    if (folder / "rgba.npy").is_file():
        return folder
    (width, height), window = target_size(video.size, selection), _window(video.size, selection)
    meter = TravelMeter() if video.moments[0].camera is None else None
    header = {"descr": "|u1", "fortran_order": False, "shape": (len(video.moments), height, width, 4)}
    with atomic(folder / "rgba.npy") as temporary, temporary.open("wb") as file:
        np.lib.format.write_array_header_1_0(file, header)
        count = 0
        for image, mask in _pairs(video):
            file.write(_scaled(np.dstack((image, mask)), window, (width, height)).tobytes())
            if meter:
                meter.add(image, mask)
            count += 1
        if count < len(video.moments):
            raise UserError(f"{video.title}: expected {len(video.moments)} frames to read, got {count}: it is cut off.")
        steps = meter.result().numpy() if meter else np.zeros((count - 1, 2), np.float32)
        with atomic(folder / "travel.npy") as travel, travel.open("wb") as other:
            np.save(other, steps * (width / window.width))
    return folder


def _pairs(video: Video) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Return every frame with its mask, in pixels of the frame."""
    for image, mask in zip(video.images(), video.masks(), strict=False):
        yield image, np.zeros(image.shape[:2], np.uint8) if mask is None else mask


def _scaled(rgba: np.ndarray, window: Window, size: tuple[int, int]) -> np.ndarray:
    """Return a window of an image, black and empty beyond its border, at another size, uint8 [h, w, 4]."""
    across, down = -window.left, -window.top
    padded = cv2.copyMakeBorder(
        rgba, down, window.height - down - rgba.shape[0], across, window.width - across - rgba.shape[1],
        cv2.BORDER_CONSTANT, value=(0, 0, 0, 0),
    )  # fmt: skip
    if (window.width, window.height) == size:
        return padded
    return cv2.resize(padded, size, interpolation=cv2.INTER_AREA if size[0] < window.width else cv2.INTER_LINEAR)
