"""Named points that people annotated: BADJA's joints on DAVIS, and COCO-like ones as in APTv2 and APT-36K."""

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch

from rewild4d.errors import UserError
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


def read_json(path: Path) -> Any:
    """The contents of a JSON file.

    Raises:
        UserError: it is missing or no JSON.
    """
    try:
        return json.loads(path.read_bytes())
    except OSError as error:
        raise UserError(f"{path}: expected a JSON file, but: {error.strerror}.") from error
    except (ValueError, RecursionError) as error:
        raise UserError(f"{path}: expected JSON, but it cannot be parsed ({error}).") from error


def read_badja(path: Path, size: tuple[int, int]) -> dict[str, Keypoints]:
    """BADJA's joints of one sequence, by the stem of the frame.

    Args:
        path: joint_annotations/<sequence>.json.
        size: width and height of the frames that are used.

    Raises:
        UserError: no such file, or not what BADJA writes.
    """
    found = {}
    try:
        for entry in read_json(path):
            joints, visible = entry["joints"], entry["visibility"]
            points = [(joints[i][1], joints[i][0]) for i in BADJA]
            scale = torch.tensor((size[0] / BADJA_SIZE[0], size[1] / BADJA_SIZE[1]))
            seen = torch.tensor([bool(visible[i]) for i in BADJA])
            centres = (torch.tensor(points, dtype=torch.float32) + 0.5) * scale
            found[Path(entry["image_path"]).stem] = Keypoints(tuple(BADJA.values()), centres, seen)
    except (KeyError, TypeError, IndexError, AttributeError, ValueError) as error:
        raise UserError(
            f"{path}: expected BADJA's list of image_path, joints[37] and visibility[37], got another ({error!r})."
        ) from error
    return found


def coco_keypoints(values: Sequence[float], names: Sequence[str], size: tuple[int, int]) -> tuple[Keypoints, int]:
    """One annotation's keypoints; those outside the image are taken as not visible.

    Args:
        values: x, y, v of each, [3 n].
        names: [n].
        size: width and height of the image.

    Returns:
        The keypoints and how many lay outside the image.

    Raises:
        ValueError: another count of numbers.
    """
    if len(values) != 3 * len(names):
        raise ValueError(f"expected {3 * len(names)} numbers for {len(names)} keypoints, got {len(values)}")
    table = torch.tensor(values, dtype=torch.float32).reshape(len(names), 3)
    points, marked = table[:, :2] + 0.5, table[:, 2] > 0
    inside = ((points >= 0) & (points <= torch.tensor(size))).all(dim=1) & torch.isfinite(points).all(dim=1)
    return Keypoints(tuple(names), points, marked & inside), int((marked & ~inside).sum())


def in_crop(keypoints: Keypoints | None, crop: Crop, size: int) -> Keypoints | None:
    """The same points in the pixels of a crop."""
    if keypoints is None:
        return None
    return Keypoints(keypoints.names, crop.from_original(keypoints.points, size), keypoints.visible)
