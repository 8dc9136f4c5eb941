"""Named points that people annotated: BADJA's joints on DAVIS, and COCO-like ones as in APTv2 and APT-36K."""

from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

import torch
from torch import Tensor

from rewild4d.datasets.keypoints.entries import Entry, LeftOut, Unusable, numbers, short, shown
from rewild4d.errors import UserError
from rewild4d.foreign.texts import read_json
from rewild4d.types import Crop, Keypoints

BADJA = {
    8: "right_front_upper", 9: "right_front_middle", 10: "right_front_paw",
    12: "left_front_upper", 13: "left_front_middle", 14: "left_front_paw", 15: "neck",
    18: "right_hind_upper", 19: "right_hind_middle", 20: "right_hind_paw",
    22: "left_hind_upper", 23: "left_hind_middle", 24: "left_hind_paw",
    25: "tail_start", 28: "tail_middle", 31: "tail_tip", 32: "jaw", 33: "nose", 35: "right_ear", 36: "left_ear",
}  # fmt: skip
"""The joints that BADJA annotates (of its 37) and what we call them."""
BADJA_SIZE = (1920, 1080)
"""BADJA's joints are (row, column) in frames of this size."""
APT = (
    "left_eye", "right_eye", "nose", "neck", "root_of_tail", "left_shoulder", "left_elbow", "left_front_paw",
    "right_shoulder", "right_elbow", "right_front_paw", "left_hip", "left_knee", "left_back_paw", "right_hip",
    "right_knee", "right_back_paw",
)  # fmt: skip
"""The keypoints of APTv2, APT-36K and AP-10K."""


OfFrames = tuple[list[Keypoints | None], str]
"""The keypoints of each frame of a video, and a sentence on what their file holds but is not used ("" for nothing)."""


def badja_joints(entry: Entry) -> tuple[str, list[tuple[float, float]], list[bool]]:
    """Return the stem of the frame of BADJA's entry, and (column, row) and visibility of every joint.

    Positions are in a frame of `BADJA_SIZE`, pixel centres at +0.5. An entry that lacks one of them is `Unusable`.
    """
    path, joints, visible = entry.get("image_path"), entry.get("joints"), entry.get("visibility")
    if not isinstance(path, str):
        raise Unusable("have no image_path", shown(entry, "image_path"))
    if not isinstance(joints, list) or not joints:
        raise Unusable("have no joints", shown(entry, "joints"))
    if not isinstance(visible, list) or len(visible) != len(joints):
        raise Unusable("have no visibility for each joint", shown(entry, "visibility"))
    places = [numbers(joint) for joint in joints]
    wrong = next((number for number, place in enumerate(places) if len(place) != 2), None)
    if wrong is not None:
        raise Unusable("have a joint that is no pair of numbers", f"joint {wrong} {short(joints[wrong])}")
    return Path(path).stem, [(column + 0.5, row + 0.5) for row, column in places], [bool(value) for value in visible]


def bounded(
    names: Sequence[str], points: Tensor, seen: Tensor, size: tuple[int, int], confidence: Tensor | None = None
) -> Keypoints:
    """Return keypoints [n, 2] (column, row), of which those outside their frame (width, height) are not visible."""
    seen = seen & inside(points, size)
    # what is not finite would spread through arithmetic that weighs it with zero
    return Keypoints(tuple(names), torch.where(torch.isfinite(points), points, -1.0), seen, confidence)


def inside(points: Tensor, size: tuple[int, int]) -> Tensor:
    """Return which points lie in their frame, bool, [n]; one that is not finite does not."""
    return ((points >= 0) & (points <= torch.tensor(size))).all(dim=1)


def not_used(path: Path, found: Sequence[Keypoints | None], size: tuple[int, int], left: LeftOut) -> str:
    """Describe a file's points outside their frames (of ``size``, width and height) and the entries left out, or ""."""
    count = sum(int((~inside(keypoints.points, size)).sum()) for keypoints in found if keypoints is not None)
    outside = [f"{count} keypoints outside their frame taken as not visible"] if count else []
    return "; ".join([*outside, *(f"{path.name}: {sentence}" for sentence in left.told())])


def read_badja(path: Path, stems: Sequence[str], size: tuple[int, int]) -> OfFrames:
    """Return BADJA's joints of one sequence, those outside the frame not visible.

    Args:
        path: joint_annotations/<sequence>.json.
        stems: of the frames that are used, in order.
        size: width and height of the frames that are used.

    Raises:
        UserError: no such file, or not what BADJA writes.
    """
    content, left = read_json(path, "BADJA's joints in JSON"), LeftOut()
    named = {}
    if isinstance(content, list):
        named = dict(left.usable(content, partial(_named_joints, size=size)))
    if not named:
        reasons = "; ".join(left.told()) or "no list of such"
        raise UserError(f"{path}: expected BADJA's list of image_path, joints[37] and visibility[37], got {reasons}.")
    found = [named.get(stem) for stem in stems]
    return found, not_used(path, found, size, left)


def _named_joints(entry: Entry, size: tuple[int, int]) -> tuple[str, Keypoints]:
    stem, places, visible = badja_joints(entry)
    if len(places) <= max(BADJA):
        raise Unusable("have fewer joints than 37", f"{len(places)} joints")
    scale = torch.tensor((size[0] / BADJA_SIZE[0], size[1] / BADJA_SIZE[1]))
    points, seen = torch.tensor([places[i] for i in BADJA]) * scale, torch.tensor([visible[i] for i in BADJA])
    # a joint that nobody saw may lie anywhere, which nobody need be told
    points[~seen & ~inside(points, size)] = 0.0
    return stem, bounded(tuple(BADJA.values()), points, seen, size)


def coco_keypoints(values: Sequence[float], names: Sequence[str], size: tuple[int, int]) -> tuple[Keypoints, int]:
    """Return keypoints from (x, y, v) of each, [3 n], and how many lay outside the image: those are not visible."""
    table = torch.tensor(values, dtype=torch.float32).reshape(len(names), 3)
    seen = table[:, 2] > 0
    found = bounded(names, table[:, :2] + 0.5, seen, size)
    return found, int((seen & ~found.visible).sum())


def in_crop(keypoints: Keypoints | None, crop: Crop, size: int) -> Keypoints | None:
    """Return the same points in the pixels of a crop."""
    return keypoints and replace(keypoints, points=crop.from_original(keypoints.points, size))
