"""A video of an animal and its masks, made into a clip and a truth: usable frames, split, crops, cache.

Every reader of real videos describes what it has as a `Video`; from there on all of them are alike. Frames without the
animal, and those where the image's border cuts it, are kept out, and the clip says so.
"""

import json
from collections.abc import Callable, Collection, Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from rewild4d.contracts import Selection
from rewild4d.datasets.keypoints.keypoints import in_crop
from rewild4d.datasets.masking.facts import MaskFacts, mask_facts
from rewild4d.datasets.video.crops import cut, follow, lost_share
from rewild4d.datasets.video.splits import scores_shown, split_frames
from rewild4d.datasets.video.travel import TravelMeter
from rewild4d.errors import UserError
from rewild4d.files import atomic, cache_folder, digest, file_state, write_text
from rewild4d.foreign.texts import read_json
from rewild4d.types import Camera, Clip, Crop, Frame, Keypoints, Truth

LEAST_FRAMES = 4
"""Usable frames without which nothing is reconstructed: three to learn from and one to test."""
LEAST_AREA = 64
"""Pixels of mask below which a frame counts as one without the animal."""
TWIN = 0.5
"""A second part above this share of the largest may be a second animal."""
LOST = 0.02
"""Share of the animal outside the crop of a held-out frame above which it is told."""
_CACHE_VERSION = "4"

Masks = Callable[[], Iterator[np.ndarray | None]]


@dataclass(frozen=True)
class Moment:
    """One frame of a video before anything is cut.

    Attributes:
        label: what a sentence calls it: a file's name or "frame 12".
        time: seconds from the start of the video.
        keypoints: annotated points in the original frame's pixels.
        place: number among all frames of the video, missing ones too, where the data set counts them.
        camera: world camera of the frame where the data set knows it.
        crop: which square of an original frame it is, where the data set cut it.
    """

    label: str
    time: float
    keypoints: Keypoints | None = None
    place: int = -1
    camera: Camera | None = None
    crop: Crop | None = None


@dataclass(frozen=True)
class Video:
    """A video with masks, to be read from start to end as often as needed.

    Attributes:
        title: what a sentence calls it: its path.
        name: of the case.
        species: free text.
        fps: frames per second, on average.
        licence: of the data.
        identity: text that changes with everything that decides the frames; for the cache.
        size: width and height of the frames.
        moments: in the order of time.
        images: every moment's frame, uint8 [h, w, 3].
        masks: every moment's mask, uint8 [h, w], or None where it has none.
        true_masks: by which held-out frames are judged where they are better known than ``masks``.
        notes: what was assumed, a sentence each.
        masks_without: ``masks`` where those of the given moments decide nothing for others; None: they never do.
    """

    title: str
    name: str
    species: str
    fps: float
    licence: str
    identity: str
    size: tuple[int, int]
    moments: tuple[Moment, ...]
    images: Callable[[], Iterator[np.ndarray]]
    masks: Masks
    true_masks: Masks | None = None
    notes: tuple[str, ...] = ()
    masks_without: Callable[[Collection[int]], Masks] | None = None

    @property
    def is_placed(self) -> bool:
        """Whether the data set says where each frame is: its camera, or the crop that it is (`placed`)."""
        return all(moment.camera is not None or moment.crop is not None for moment in self.moments)


@dataclass(frozen=True)
class Layout:
    """Which frames of a video are used, how, and where they are cut.

    Attributes:
        used: indices of moments, ascending.
        tested: which of them are held out, bool for each.
        crops: of each.
        notes: what was left out and why, a sentence each.
        travel: x and y of the animal's motion over the background from each frame that is not held out to the next of
            them, pixels of the original frames; empty until the frames were looked at.
    """

    used: tuple[int, ...]
    tested: tuple[bool, ...]
    crops: tuple[Crop, ...]
    notes: tuple[str, ...]
    travel: tuple[tuple[float, float], ...] = ()

    @property
    def shown(self) -> list[int]:
        """Rows of the frames that are not held out."""
        return [row for row, tested in enumerate(self.tested) if not tested]


def split_video(video: Video, selection: Selection) -> tuple[Clip, Truth]:
    """Return the frames that a method gets and those that are held out, cut around the animal.

    Cameras are None: nobody knows them (`contracts.Reconstruction.camera`).

    Raises:
        UserError: too few usable frames, or files that cannot be read.
    """
    split = selection.split
    is_split = isinstance(split, tuple) or (split is not None and split >= 2)
    if selection.framing != "crop" or selection.cameras != "unknown" or not is_split:
        raise UserError(
            f"{video.title}: expected a protocol for videos (cameras = 'unknown', framing = 'crop', split = 2 or more)."
        )
    if selection.frames is not None or selection.mask_threshold is not None:
        raise UserError(f"{video.title}: expected a protocol without 'frames' and 'mask_threshold', which cuts frames.")
    layout, folder = _laid_out(video, selection)
    rgba = np.load(folder / "rgba.npy", mmap_mode="r")
    shown = _Frames(video, layout, rgba, layout.shown)
    held_out = [row for row, tested in enumerate(layout.tested) if tested]
    hidden = _Frames(video, layout, rgba, layout.shown if scores_shown(split) else held_out)
    sides = torch.tensor([layout.crops[row].side for row in layout.shown[1:]])
    # in pixels of the crop that each step leads to
    travel = torch.tensor(layout.travel).reshape(-1, 2) * (selection.size / sides)[:, None]
    clip = Clip(
        video.name, video.species, tuple(shown), video.fps / selection.stride, video.licence,
        digest(shown.digest(), travel), (*video.notes, *layout.notes),
        start=video.moments[layout.used[0]].time, travel=travel,
    )  # fmt: skip
    return clip, Truth(hidden, None, hidden.digest())


def usable(
    video: Video, facts: Sequence[MaskFacts | None], stride: int = 1, least: int = 1
) -> tuple[list[int], tuple[str, ...]]:
    """Return indices of the frames that show the whole animal, and what was left out and why, a sentence each.

    Frames that the image's border cuts stay where most are like that. Fewer than ``least`` frames are a `UserError`.

    Args:
        video: whose frames.
        facts: of each moment's mask; None where there is none.
        stride: of the frames that are looked at.
        least: how many frames there must be.
    """
    kept = range(0, len(facts), stride)
    seen = {i: fact for i in kept if (fact := facts[i]) and fact.box and fact.area >= LEAST_AREA}
    missing = [i for i in kept if facts[i] is None]
    empty = [i for i in kept if facts[i] is not None and i not in seen]
    is_cut = [i for i in seen if seen[i].is_cut]
    used, cut_note = [i for i in seen if not seen[i].is_cut], "where the image's border cuts the animal left out"
    if len(used) < max(LEAST_FRAMES, len(seen) // 4):
        used, cut_note = [*seen], "where the image's border cuts the animal kept, because most are like that"
    twins = [i for i in used if seen[i].second > TWIN]
    twin_note = "with two parts of like size (two animals?) taken as one animal (--parts main takes one)"
    notes = (
        told(video, missing, "without a mask left out"),
        told(video, empty, "without the animal left out"),
        told(video, is_cut, cut_note),
        told(video, twins, twin_note),
    )
    if len(used) < least:
        reasons = [f"{len(missing)} have no mask" if missing else "", f"{len(empty)} an empty one" if empty else ""]
        said = " and ".join(reason for reason in reasons if reason)
        raise UserError(
            f"{video.title}: expected at least {least} frame{'s' * (least > 1)} with a mask of the animal, got "
            f"{len(used)} of {len(kept)}{f' ({said})' if said else ''}."
        )
    return used, tuple(note for note in notes if note)


def original_images(video: Video, selection: Selection) -> Iterator[np.ndarray]:
    """Return the whole frames behind the images, held-out ones too, in the order of time, uint8 [h, w, 3]."""
    used = {*_laid_out(video, selection)[0].used}
    return (image for index, image in enumerate(video.images()) if index in used)


def _laid_out(video: Video, selection: Selection) -> tuple[Layout, Path]:
    """Return the layout of a video and the folder of its cut frames, made where they are not there yet."""
    parts = [_CACHE_VERSION, video.identity, str(selection.size), str(selection.stride), str(selection.split)]
    folder = cache_folder() / "wild" / digest(*parts)[:32]
    if not (folder / "rgba.npy").is_file():
        layout = lay_out(video, _facts(video.masks), selection)
        if video.masks_without:  # which are held out is known now
            video = replace(video, masks=video.masks_without(set(layout.used) - {layout.used[i] for i in layout.shown}))
            layout = replace(layout, crops=_crops(video, _facts(video.masks), layout.used, layout.tested))
        _fill(video, layout, selection.size, folder)
    return _read_layout(folder / "layout.json"), folder


def lay_out(video: Video, facts: Sequence[MaskFacts | None], selection: Selection) -> Layout:
    """Choose frames and crops from the facts of each moment's mask; too few usable frames are a `UserError`."""
    used, notes = usable(video, facts, selection.stride, LEAST_FRAMES)
    tested = split_frames(len(used), selection.split or len(used))
    return Layout(tuple(used), tuple(tested), _crops(video, facts, used, tested), notes)


def _facts(masks: Masks) -> list[MaskFacts | None]:
    return [None if mask is None else mask_facts(mask) for mask in masks()]


def _crops(
    video: Video, facts: Sequence[MaskFacts | None], used: Sequence[int], tested: Sequence[bool]
) -> tuple[Crop, ...]:
    """Return the crops of the used frames, from what the masks of those say that are not held out."""
    shown = [
        (i, fact.box) for i, test in zip(used, tested, strict=True) if not test and (fact := facts[i]) and fact.box
    ]
    times = [video.moments[i].time for i, _ in shown]
    return tuple(follow(times, [box for _, box in shown], [video.moments[i].time for i in used], video.size))


def told(video: Video, indices: Sequence[int], what: str) -> str:
    """Return a sentence about some frames of a video, "" about none."""
    return listed([moment.label for moment in video.moments], indices, what)


def listed(labels: Sequence[str], indices: Sequence[int], what: str) -> str:
    """Return a sentence about some frames of so many labels, with runs as ranges; "" about none."""
    if not indices:
        return ""
    runs: list[list[int]] = []
    for index in indices:
        if runs and index == runs[-1][1] + 1:
            runs[-1][1] = index
        else:
            runs.append([index, index])
    names = [labels[a] if a == b else f"{labels[a]} to {labels[b]}" for a, b in runs]
    named = ", ".join(names[:6]) + (", ..." if len(names) > 6 else "")
    return f"{len(indices)} of {len(labels)} frames {what}: {named}"


def _fill(video: Video, layout: Layout, size: int, folder: Path) -> None:
    """Cut every used frame and write the cache; the images are written last and say that it is complete."""
    place = {index: row for row, index in enumerate(layout.used)}
    lost: list[int] = []
    meter, written = TravelMeter(), 0
    truths = video.true_masks() if video.true_masks else iter([None] * len(video.moments))
    header = {"descr": "|u1", "fortran_order": False, "shape": (len(layout.used), size, size, 4)}
    with atomic(folder / "rgba.npy") as temporary, temporary.open("wb") as file:
        np.lib.format.write_array_header_1_0(file, header)
        for index, (image, mask, truth) in enumerate(zip(video.images(), video.masks(), truths, strict=False)):
            row = place.get(index)
            if row is None or mask is None:
                continue
            judged = truth if layout.tested[row] and truth is not None else mask
            crop = layout.crops[row]
            file.write(cut(image, judged, crop, size).tobytes())
            written += 1
            if not layout.tested[row]:
                meter.add(image, mask)
            elif lost_share(judged, crop) > LOST:
                lost.append(index)
        if written < len(layout.used):
            raise UserError(f"{video.title}: expected {len(layout.used)} frames to cut, got {written}: it is cut off.")
        note = told(video, lost, f"held out reach over their crop with more than {LOST:.0%} of the animal")
        notes, travel = (*layout.notes, note) if note else layout.notes, tuple(meter.result().tolist())
        write_text(folder / "layout.json", json.dumps(asdict(replace(layout, notes=notes, travel=travel))))


def _read_layout(path: Path) -> Layout:
    parts = read_json(path, "the layout of a video")
    crops = tuple(Crop(**values) for values in parts.pop("crops"))
    return Layout(crops=crops, **{name: tuple(values) for name, values in parts.items()})


def files_identity(*files: Path | None) -> str:
    """Return the path, size and time of change of some files, as text."""
    return digest(*(file_state(file) for file in files if file is not None))


class _Frames(Sequence[Frame]):
    """Some of the used frames, from the memory map on access."""

    def __init__(self, video: Video, layout: Layout, rgba: np.ndarray, rows: Sequence[int]) -> None:
        moments = [video.moments[layout.used[row]] for row in rows]
        start = video.moments[layout.used[0]].time
        self._rows, self._rgba = rows, rgba
        self._times = [moment.time - start for moment in moments]
        self._crops = [layout.crops[row] for row in rows]
        self._keypoints = [
            in_crop(moment.keypoints, crop, rgba.shape[1]) for moment, crop in zip(moments, self._crops, strict=True)
        ]

    def __len__(self) -> int:
        return len(self._rows)

    def __getitem__(self, index: Any) -> Any:
        if isinstance(index, slice):
            return [self[item] for item in range(*index.indices(len(self)))]
        rgba = torch.from_numpy(self._rgba[self._rows[index]].astype(np.float32) / 255)
        rgba = rgba.permute(2, 0, 1).contiguous()
        return Frame(self._times[index], None, rgba[:3], rgba[3:], 0, self._crops[index], self._keypoints[index])

    def digest(self) -> str:
        """Return SHA-256 over times, crops, keypoints and pixels."""
        parts: list[str | torch.Tensor | np.ndarray] = []
        for row, time, crop, points in zip(self._rows, self._times, self._crops, self._keypoints, strict=True):
            parts += [repr(time), repr(crop), self._rgba[row]]
            parts += [points.points, points.visible] if points else []
        return digest(*parts)
