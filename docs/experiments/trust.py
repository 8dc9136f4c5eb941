"""Judge true, predicted and spoilt masks of films whose true ones are known (trust.md).

python docs/experiments/trust.py DAVIS camel cows
"""

import sys
from collections.abc import Callable, Sequence
from pathlib import Path

import cv2
import numpy as np

from rewild4d.datasets.masking.trust import MaskTrust

Spoil = Callable[[Sequence[np.ndarray], int], np.ndarray]
"""All true masks, uint8 [h, w], and the number of a frame -> its spoilt mask."""


def grown(share: float) -> Spoil:
    """Grow (or shrink) by a share of the root of the area."""

    def spoil(masks: Sequence[np.ndarray], index: int) -> np.ndarray:
        mask = masks[index]
        pixels = max(1, int(abs(share) * np.sqrt((mask > 0).sum())))
        kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * pixels + 1,) * 2)
        return cv2.dilate(mask, kernel) if share > 0 else cv2.erode(mask, kernel)

    return spoil


def shifted(share: float) -> Spoil:
    """Shift by a share of the root of the area to the right, and by half of it down."""

    def spoil(masks: Sequence[np.ndarray], index: int) -> np.ndarray:
        pixels = int(share * np.sqrt((masks[index] > 0).sum()))
        return np.roll(masks[index], (pixels // 2, pixels), axis=(0, 1))

    return spoil


def cut(left: float = 0.0, right: float = 1.0, bottom: float = 1.0, every: int = 1) -> Spoil:
    """Keep a part of the box, as shares of it, in every so many frames."""

    def spoil(masks: Sequence[np.ndarray], index: int) -> np.ndarray:
        x, y, width, height = cv2.boundingRect(masks[index])
        kept = np.zeros_like(masks[index])
        kept[: y + int(bottom * height), x + int(left * width) : x + int(right * width)] = 255
        return np.minimum(masks[index], kept) if index % every == every - 1 else masks[index]

    return spoil


KINDS: dict[str, Spoil] = {
    "true": lambda masks, index: masks[index],
    "smaller by 3 %": grown(-0.03),
    "smaller by 5 %": grown(-0.05),
    "smaller by 10 %": grown(-0.1),
    "larger by 5 %": grown(0.05),
    "larger by 10 %": grown(0.1),
    "shifted by 5 %": shifted(0.05),
    "shifted by 10 %": shifted(0.1),
    "shifted by 20 %": shifted(0.2),
    "left quarter missing": cut(left=0.25),
    "right quarter missing": cut(right=0.75),
    "lower third missing": cut(bottom=0.7),
    "left third missing in every second frame": cut(left=1 / 3, every=2),
    "of the frame twelve later": lambda masks, index: masks[(index + 12) % len(masks)],
    "inverted": lambda masks, index: 255 - masks[index],
}


def read(path: Path, how: int) -> np.ndarray:
    image = cv2.imread(str(path), how)
    assert image is not None, path
    return image


def judge(root: Path, name: str) -> None:
    """Print a line for each kind: mean IoU with the true masks, and the verdict."""
    files = sorted((root / "JPEGImages" / "480p" / name).glob("*.jpg"))
    stems = [file.stem for file in files]
    truth = [read(root / "Annotations" / "480p" / name / f"{stem}.png", cv2.IMREAD_GRAYSCALE) for stem in stems]
    predicted = root / "predicted_masks" / "osvos" / name
    kinds = dict(KINDS)
    if predicted.is_dir():
        kinds["of OSVOS"] = lambda _, index: np.where(read(predicted / f"{stems[index]}.png", 0) > 0, 255, 0).astype(
            "u1"
        )
    for kind, spoil in kinds.items():
        found, overlaps = MaskTrust(len(files)), []
        for index, file in enumerate(files):
            mask, true = spoil(truth, index), truth[index] > 127
            found.add(index, read(file, cv2.IMREAD_COLOR)[..., ::-1], mask)
            overlaps.append(((mask > 127) & true).sum() / ((mask > 127) | true).sum())
        print(f"{name} | {kind} | {np.mean(overlaps):.2f} | {found.verdict(stems)}", flush=True)


if __name__ == "__main__":
    for film in sys.argv[2:]:
        judge(Path(sys.argv[1]), film)
