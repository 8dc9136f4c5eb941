"""Write films of zoo animals in the layout of CoP3D, with known cameras: to try the reader, and to see the format."""

import gzip
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from rewild4d.datasets.builtin import filming
from rewild4d.datasets.builtin.zoo import animals
from rewild4d.datasets.builtin.zoo.kinds import NAMES
from rewild4d.datasets.cop3d.annotations import FRAMES, SEQUENCES
from rewild4d.datasets.cop3d.cameras import FORMATS, from_opencv
from rewild4d.datasets.cop3d.reader import CATEGORIES
from rewild4d.datasets.rigs.studio import Progress
from rewild4d.errors import UserError
from rewild4d.files import replaced_folder

MARKER = "made-by-rewild4d.txt"
SOFT = 0.7
"""Standard deviation in pixels by which mattes are blurred: CoP3D's masks are probabilities."""
QUALITY = 95
"""Of the JPEG images."""


def write_cop3d(
    out: Path, seeds: Sequence[int], frames: int, size: tuple[int, int], intrinsics_format: str = FORMATS[0],
    progress: Progress | None = None,
) -> list[Path]:  # fmt: skip
    """Write one sequence for each seed, complete or not at all; there are no point clouds.

    Args:
        out: the new folder, or an earlier one of this function.
        seeds: of cats and dogs of the zoo.
        frames: of each sequence.
        size: width and height of the images.
        intrinsics_format: one of `cameras.FORMATS`.
        progress: called after every image.

    Returns:
        The folders of the sequences.

    Raises:
        UserError: a seed of another animal, or a folder that holds something else.
    """
    kinds = [animals.draw(seed).kind for seed in seeds]
    for seed, kind in zip(seeds, kinds, strict=True):
        if kind not in CATEGORIES:
            pets = [number for number in animals.DEVELOPMENT if NAMES[number % len(NAMES)] in CATEGORIES]
            raise UserError(
                f"--seeds: expected cats and dogs, as CoP3D has ({', '.join(map(str, pets[:6]))}, ...), got {seed}, "
                f"a {kind}."
            )
    names = [f"{kind}/{seed}_{frames}_{frames}" for seed, kind in zip(seeds, kinds, strict=True)]
    entries: dict[str, list[dict[str, Any]]] = {kind: [] for kind in kinds}
    with replaced_folder(out, MARKER, "an earlier one of `make cop3d`") as building:
        (building / MARKER).write_text(f"{animals.LICENCE}\nseeds {' '.join(map(str, seeds))}\n")
        for count, (seed, name) in enumerate(zip(seeds, names, strict=True)):
            for folder in ("images", "masks"):
                (building / name / folder).mkdir(parents=True)
            for number, shot in enumerate(filming.film(seed, frames, *size)):
                entries[name.partition("/")[0]].append(_write_frame(building, name, number, shot, intrinsics_format))
                if progress:
                    progress(count * frames + number + 1, len(seeds) * frames)
        for kind, found in entries.items():
            _write_annotations(building / kind, kind, found, frames)
    return [out / name for name in names]


def _write_frame(root: Path, name: str, number: int, shot: filming.Shot, intrinsics_format: str) -> dict[str, Any]:
    """Write the image and the mask of a frame, and return its annotation; files are numbered from 1, every second."""
    file = f"frame{2 * number + 1:06d}"
    image, mask = f"{name}/images/{file}.jpg", f"{name}/masks/{file}.png"
    soft = cv2.GaussianBlur(shot.alpha, (0, 0), SOFT)
    cv2.imwrite(str(root / image), cv2.cvtColor(shot.rgb, cv2.COLOR_RGB2BGR), [cv2.IMWRITE_JPEG_QUALITY, QUALITY])
    cv2.imwrite(str(root / mask), soft)
    return {
        "sequence_name": name.partition("/")[2],
        "frame_number": number,
        "frame_timestamp": number / animals.FPS,
        "image": {"path": image, "size": list(shot.alpha.shape)},
        "depth": None,
        "mask": {"path": mask, "mass": float(soft.sum(dtype=np.float64) / 255)},
        "viewpoint": from_opencv(shot.camera, intrinsics_format),
        "meta": None,
    }


def _write_annotations(folder: Path, kind: str, entries: Sequence[dict[str, Any]], frames: int) -> None:
    names = list(dict.fromkeys(entry["sequence_name"] for entry in entries))
    sequences = [
        {"sequence_name": name, "category": kind, "video": {"path": "", "length": frames / animals.FPS},
         "point_cloud": None, "viewpoint_quality_score": None}
        for name in names
    ]  # fmt: skip
    for file, content in ((FRAMES, list(entries)), (SEQUENCES, sequences)):
        (folder / file).write_bytes(gzip.compress(json.dumps(content).encode(), mtime=0))
    frames_listed = [[entry["sequence_name"], entry["frame_number"], entry["image"]["path"]] for entry in entries]
    subsets = {"train": frames_listed[::2], "val": [], "test": frames_listed[1::2]}
    (folder / "set_lists").mkdir()
    (folder / "set_lists" / "set_lists_manyview_0.json").write_text(json.dumps(subsets))
