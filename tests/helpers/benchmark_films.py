"""Small folders in the layouts of AiM and CoP3D, of the walking animal of `moving`."""

import gzip
import json
from pathlib import Path
from typing import Any

import moving
import numpy as np

from rewild4d.datasets.cop3d.cameras import from_opencv
from rewild4d.transforms import look_at
from rewild4d.types import Camera

TRACK = "dog/-a_b-c_d-e_0012_003"
"""A YouTube id of 11 characters that has both signs, a clip of four digits."""
BOX = (-20, -16, 108, 112)
"""A square of the film that leaves its frames of 320 x 180: 128 pixels to a side, where the crops have 64."""
SIDE = 64
POINT = (40.0, 30.0)
"""Column and row of every keypoint in the crops."""


def aim(root: Path, count: int = 8, first: int = 3, track: str = TRACK) -> Path:
    """Write a track of AiM; returns its folder."""
    for number in range(first, first + count):
        start = root / track / f"{number:08d}"
        moving.save(Path(f"{start}_rgb.png"), moving.image(number, (SIDE, SIDE)))
        moving.save(Path(f"{start}_mask.png"), moving.mask(number, (SIDE, SIDE)))
        rows = [f"{POINT[0]:.6f} {POINT[1]:.6f} {0.9 if row else 0.2:.6f}" for row in range(17)]
        Path(f"{start}_keypoint.txt").write_text("\n".join(rows) + "\n")
        said = {"crop_box_xyxy": BOX, "video_frame_width": 320, "video_frame_height": 180, "clip_frame_id": number}
        Path(f"{start}_metadata.json").write_text(json.dumps(said))
    (root / track / f"{Path(track).name}_info.json").write_text(json.dumps({"fps": 10, "video_title": "a dog"}))
    return root / track


def camera(frame: int) -> Camera:
    """The camera of a frame of `cop3d`: it goes around the animal and has two focal lengths."""
    import torch

    angle = 0.1 * frame
    eye = torch.tensor((3 * np.sin(angle), 0.4, 3 * np.cos(angle)), dtype=torch.float64)
    pose = look_at(eye, torch.zeros(3, dtype=torch.float64), torch.tensor((0.0, 1.0, 0.0)).double())
    width, height = moving.SIZE
    intrinsics = torch.tensor(((100.0, 0, width / 2 + 3), (0, 90, height / 2 - 2), (0, 0, 1))).double()
    return Camera(pose, intrinsics, width, height)


def cop3d(root: Path, count: int = 20, form: str = "ndc_norm_image_bounds", sequence: str = "1_2_3") -> Path:
    """Write a sequence of CoP3D's dogs, whose masks are 0, 128 and 255; returns the data set's folder."""
    entries = []
    for number in range(count):
        image, mask = (f"dog/{sequence}/{kind}/frame{2 * number + 1:06d}.png" for kind in ("images", "masks"))
        solid = moving.mask(number)
        soft = np.where((solid == 0) & (np.roll(solid, 3, axis=1) > 0), np.uint8(128), solid)
        moving.save(root / image, moving.image(number))
        moving.save(root / mask, soft)
        entries.append({
            "sequence_name": sequence, "frame_number": number, "frame_timestamp": number / 20,
            "image": {"path": image, "size": list(solid.shape)}, "mask": {"path": mask, "mass": 1.0}, "depth": None,
            "viewpoint": from_opencv(camera(number), form), "meta": None,
        })  # fmt: skip
    write_jgz(root / "dog" / "frame_annotations.jgz", entries)
    said = {"sequence_name": sequence, "category": "dog", "video": {"path": "x", "length": count / 4}}
    write_jgz(root / "dog" / "sequence_annotations.jgz", [said])
    return root


def write_jgz(path: Path, content: Any) -> Path:
    path.write_bytes(gzip.compress(json.dumps(content).encode(), mtime=0))
    return path


def changed_frames(root: Path, **changes: Any) -> None:
    """Change every frame's annotation; "viewpoint" has its own fields changed."""
    path = root / "dog" / "frame_annotations.jgz"
    entries = json.loads(gzip.decompress(path.read_bytes()))
    for entry in entries:
        for name, value in changes.items():
            entry[name] = entry[name] | value if isinstance(value, dict) else value
    write_jgz(path, entries)
