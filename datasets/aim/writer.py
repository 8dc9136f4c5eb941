"""Write films of zoo animals in the layout of AiM: to try the reader, and to see the format (`files`)."""

import json
from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np

from rewild4d.datasets.aim.files import FPS
from rewild4d.datasets.builtin import filming
from rewild4d.datasets.builtin.zoo import animals
from rewild4d.datasets.rigs.studio import Progress
from rewild4d.errors import UserError
from rewild4d.files import replaced_folder

MARKER = "made-by-rewild4d.txt"
SIDE = 512
"""Width and height of a crop."""
FIRST = 3
"""Number of the first frame: a track need not start with its clip."""
GAP = 5
"""Frames at either end whose crop box is not averaged; the others are over one more on each side."""
CATEGORIES = {"stag": "deer"}
"""Kinds of the zoo that AiM calls otherwise."""
SCORE = 0.9
"""Of every keypoint: they are projections of the skeleton, whether the camera sees them or not."""


def write_aim(
    out: Path, seeds: Sequence[int], frames: int, size: tuple[int, int], side: int = SIDE,
    progress: Progress | None = None,
) -> list[Path]:  # fmt: skip
    """Write one track for each seed, complete or not at all; depth, flow and occlusion pictures are left out.

    Args:
        out: the new folder, or an earlier one of this function.
        seeds: of the zoo's animals.
        frames: of each track.
        size: width and height of the film.
        side: of the crops in pixels.
        progress: called after every image.

    Returns:
        The folders of the tracks.

    Raises:
        UserError: no such seed, or a folder that holds something else.
    """
    drawn = [animals.draw(seed) for seed in seeds]
    names = [f"{CATEGORIES.get(animal.kind, animal.kind)}/zoo_-{animal.seed:06d}_001_001" for animal in drawn]
    with replaced_folder(out, MARKER, "an earlier one of `make aim`") as building:
        (building / MARKER).write_text(f"{animals.LICENCE}\nseeds {' '.join(map(str, seeds))}\n")
        for count, (seed, name) in enumerate(zip(seeds, names, strict=True)):
            (building / name).mkdir(parents=True)
            shots = []
            for shot in filming.film(seed, frames, *size):
                shots.append(shot)
                if progress:
                    progress(count * frames + len(shots), len(seeds) * frames)
            _write_track(building / name, shots, side)
    return [out / name for name in names]


def _write_track(folder: Path, shots: Sequence[filming.Shot], side: int) -> None:
    if not all((shot.alpha > 127).any() for shot in shots):
        raise UserError(f"{folder}: expected a film in which the animal can be seen; --size makes it larger.")
    boxes = crop_boxes([shot.alpha for shot in shots])
    for number, (shot, box) in enumerate(zip(shots, boxes, strict=True), FIRST):
        start = folder / f"{number:08d}"
        mask = np.where(shot.alpha > 127, 255, 0).astype(np.uint8)
        cv2.imwrite(f"{start}_rgb.png", cv2.cvtColor(_cut(shot.rgb, box, side), cv2.COLOR_RGB2BGR))
        cv2.imwrite(f"{start}_mask.png", np.where(_cut(mask, box, side) > 127, 255, 0).astype(np.uint8))
        left, top, right, bottom = box
        points = (shot.joints[:, :2] - (left, top)) * (side / np.array((right - left, bottom - top)))
        scores = SCORE * shot.joints[:, 2:]
        np.savetxt(f"{start}_keypoint.txt", np.hstack((np.where(scores > 0, points, 0), scores)), fmt="%.6f")
        seconds = number / FPS
        said = {
            "video_frame_id": number, "video_frame_time": seconds, "clip_frame_id": number, "clip_frame_time": seconds,
            "crop_box_xyxy": list(box), "video_frame_height": shot.alpha.shape[0],
            "video_frame_width": shot.alpha.shape[1], "crop_height": side, "crop_width": side,
        }  # fmt: skip
        Path(f"{start}_metadata.json").write_text(json.dumps(said, indent=4))
    video, clip, _ = folder.name.rsplit("_", 2)
    info = {"video_id": video, "clip_id": f"{video}_{clip}", "track_id": folder.name, "fps": FPS}
    (folder / f"{folder.name}_info.json").write_text(json.dumps(info, indent=4))


def crop_boxes(mattes: Sequence[np.ndarray]) -> list[tuple[int, int, int, int]]:
    """Return AiM's squares around the animal: left, top, right, bottom in whole pixels of the film.

    Side sqrt(2 w h) of the mask's box, about its middle; then the mean over `GAP` + 1 frames before and after, but not
    for the first and last `GAP` (briannlongzhao/Animal-in-Motion, models/animal_tracker.py:417-491 @ c94ad47).
    """
    raw = []
    for matte in mattes:
        rows, columns = np.nonzero(matte > 127)
        low, high = np.array((columns.min(), rows.min())), np.array((columns.max(), rows.max()))
        half = np.sqrt(2 * np.prod((high - low).astype(float))) / 2
        middle = (low + high) / 2
        raw.append(np.concatenate((middle - half, middle + half)).astype(int))
    found, last = [], len(raw) - 1
    for frame, box in enumerate(raw):
        if GAP <= frame <= last - GAP:
            box = np.mean(raw[max(0, frame - GAP - 1) : frame + GAP + 2], axis=0).astype(int)
        found.append((int(box[0]), int(box[1]), int(box[2]), int(box[3])))
    return found


def _cut(image: np.ndarray, box: tuple[int, int, int, int], side: int) -> np.ndarray:
    """Return a box of an image, zero beyond its border, scaled to a square."""
    left, top, right, bottom = box
    height, width = image.shape[:2]
    beyond = max(0, -left, -top, right - width, bottom - height)
    padded = cv2.copyMakeBorder(image, beyond, beyond, beyond, beyond, cv2.BORDER_CONSTANT, value=0)
    return cv2.resize(padded[top + beyond : bottom + beyond, left + beyond : right + beyond], (side, side))
