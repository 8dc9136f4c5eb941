"""Named points of the template, and the files that map annotated keypoints to them."""

from collections.abc import Sequence
from dataclasses import dataclass
from importlib import resources
from pathlib import Path

import torch
from torch import Tensor

from rewild4d.errors import UserError, shown, unknown_name
from rewild4d.foreign.texts import read_toml
from rewild4d.priors.bodies.tetrapod import MIRROR
from rewild4d.priors.kinematics import moved
from rewild4d.types import Keypoints, Prior


def _landmarks() -> dict[str, tuple[int, float]]:
    body = {
        "nose": (0, 1.0), "jaw": (0, 0.8), "eye": (0, 0.35), "poll": (0, 0.0), "neck": (1, 0.0), "withers": (3, 1.0),
        "back": (3, 0.0), "hips": (6, 0.0), "tail_root": (6, 1.0), "tail_middle": (5, 1.0), "tail_tip": (4, 1.0),
    }  # fmt: skip
    legs = {
        f"{end}_{side}_{joint}": (foot + up, along)
        for (end, side), foot in {
            ("front", "left"): 8, ("rear", "left"): 11, ("rear", "right"): 14, ("front", "right"): 17,
        }.items()
        for joint, up, along in (("top", 2, 0.0), ("upper", 1, 0.0), ("lower", 0, 0.0), ("foot", 0, 1.0))
    }  # fmt: skip
    return body | legs


LANDMARKS = _landmarks()
"""Bone of each point and the share of its length from start (the pivot, 0) to end (1). On legs: "top" is the shoulder
or hip, "upper" the elbow or stifle, "lower" the wrist or hock."""
FRONT = tuple(name for name in LANDMARKS if name.startswith("front_")) + ("nose", "jaw", "eye", "poll", "neck")
REAR = tuple(name for name in LANDMARKS if name.startswith("rear_")) + ("tail_root",)


@dataclass(frozen=True)
class Marks:
    """Keypoints as points of the template.

    Attributes:
        frames: index of the frame of each mark, int64, [m].
        bones: int64, [m].
        along: share of the bone's length, [m].
        pixels: annotated position in the frame's pixels, [m, 2].
    """

    frames: Tensor
    bones: Tensor
    along: Tensor
    pixels: Tensor

    def mirrored(self, width: int) -> "Marks":
        """Return the marks of the horizontally flipped frames."""
        flipped = torch.stack((width - self.pixels[:, 0], self.pixels[:, 1]), dim=1)
        return Marks(self.frames, torch.tensor(MIRROR)[self.bones], self.along, flipped)

    def chosen(self, rows: Tensor) -> "Marks":
        """Return some of the marks, by index or bool, [m]."""
        return Marks(*(value[rows] for value in vars(self).values()))

    def __len__(self) -> int:
        return len(self.frames)


def mapping_names() -> list[str]:
    """Return names of the mapping files that come with the package."""
    folder = resources.files("rewild4d.priors") / "mappings"
    return sorted(file.name.removesuffix(".toml") for file in folder.iterdir() if file.name.endswith(".toml"))


def load_mapping(name: str) -> dict[str, str]:
    """Return the landmark of each keypoint name, from one of our files or a TOML file with a table [points].

    Raises:
        UserError: no such mapping, not TOML, or a landmark that does not exist.
    """
    file = resources.files("rewild4d.priors") / "mappings" / f"{name}.toml"
    if not file.is_file():
        file = Path(name)
        if file.suffix != ".toml" or not file.is_file():
            raise unknown_name("keypoint mapping", name, [*mapping_names(), "<your own>.toml"])
    pairs = read_toml(file, "a TOML file with a table [points]").get("points")
    if not isinstance(pairs, dict) or not all(isinstance(value, str) for value in pairs.values()):
        raise UserError(f"{name}: expected a table [points] of names in quotes, got {shown(pairs)}.")
    for value in pairs.values():
        if value not in LANDMARKS:
            raise unknown_name(f"landmark in the mapping {name}", value, LANDMARKS)
    return pairs


def marks(keypoints: Sequence[Keypoints | None], mapping: dict[str, str]) -> Marks:
    """Return all visible keypoints that the mapping names, of all frames (None: without any)."""
    rows, pixels = [], []
    for frame, points in enumerate(keypoints):
        if points is None:
            continue
        for name, pixel, visible in zip(points.names, points.points.tolist(), points.visible.tolist(), strict=True):
            if visible and name in mapping:
                rows.append((frame, *LANDMARKS[mapping[name]]))
                pixels.append(pixel)
    frames, bones, along = torch.tensor(rows, dtype=torch.float32).reshape(-1, 3).unbind(1)
    return Marks(frames.long(), bones.long(), along, torch.tensor(pixels, dtype=torch.float32).reshape(-1, 2))


def landmark_pixels(prior: Prior, found: Marks) -> Tensor:
    """Project the prior's points of the marks to pixels, [m, 2]; the marks' frames are rows of the prior."""
    start, end = prior.bones[found.bones].unbind(1)
    rest = start + found.along[:, None] * (end - start)
    posed = moved(rest, prior.transforms[found.frames, found.bones])
    shown = [prior.cameras[int(row)].project(point.double())[0] for row, point in zip(found.frames, posed, strict=True)]
    return torch.stack(shown) if shown else torch.zeros(0, 2, dtype=torch.float64)
