"""Measure masks that are made from one box, or from none, against a film's true masks (tracking.md).

python docs/experiments/tracking.py DAVIS camel cows               # --tool track, the box of the first true mask
python docs/experiments/tracking.py DAVIS camel cows --no-box
python docs/experiments/tracking.py DAVIS camel cows --mask        # the first true mask
python docs/experiments/tracking.py DAVIS camel cows --rough
"""

import sys
import time
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
import torch

from rewild4d.datasets.masking.grabcut import rough_masks
from rewild4d.datasets.masking.makers import Unmasked
from rewild4d.datasets.masking.tracking import track_masks
from rewild4d.metrics.silhouette import boundary_f


def read(path: Path, how: int) -> np.ndarray:
    image = cv2.imread(str(path), how)
    assert image is not None, path
    return image


def matte(mask: np.ndarray) -> torch.Tensor:
    return torch.from_numpy(mask.astype(np.float32))[None, None]


def row(root: Path, name: str, flags: set[str]) -> str:
    """Measure one film: mean and lowest IoU of its frames, boundary F, seconds a frame, and frames below 0.9."""
    files = sorted((root / "JPEGImages" / "480p" / name).glob("*.jpg"))
    truth = [
        read(root / "Annotations" / "480p" / name / f"{file.stem}.png", cv2.IMREAD_GRAYSCALE) > 127 for file in files
    ]

    def images() -> Iterator[np.ndarray]:
        return (cv2.cvtColor(read(file, cv2.IMREAD_COLOR), cv2.COLOR_BGR2RGB) for file in files)

    left, top, width, height = cv2.boundingRect(truth[0].astype(np.uint8))
    boxes = {} if "--no-box" in flags else {0: (float(left), float(top), float(width), float(height))}
    marks = {0: np.where(truth[0], 1, -1).astype(np.int8)} if "--mask" in flags else {}
    stems = tuple(file.stem for file in files)
    source = Unmasked(name, stems, truth[0].shape[::-1], images, {} if marks else boxes, marks)
    began = time.monotonic()
    masks = [mask > 127 for mask in (rough_masks if "--rough" in flags else track_masks)(source)]
    seconds = (time.monotonic() - began) / len(files)
    scores = [(mask & true).sum() / (mask | true).sum() for mask, true in zip(masks, truth, strict=True)]
    low = [index for index, score in enumerate(scores) if score < 0.9]
    contour = np.mean([boundary_f(matte(mask), matte(true)).item() for mask, true in zip(masks, truth, strict=True)])
    return (
        f"{name}: IoU {np.mean(scores):.3f} ({min(scores):.3f}), boundary F {contour:.3f}, {seconds:.2f} s a frame, "
        f"below 0.9: {low}"
    )


if __name__ == "__main__":
    words = [word for word in sys.argv[1:] if not word.startswith("--")]
    for film in words[1:]:
        print(row(Path(words[0]), film, set(sys.argv[1:]) - set(words)), flush=True)
