"""Small images and clips on disk, and a command that refuses them."""

from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
from calling import call

Call = Callable[..., dict]  # type: ignore[type-arg]
"""`score` with these words, and what it prints."""


def refused(capsys: pytest.CaptureFixture[str], *words: object) -> str:
    """The one sentence that a refused command leaves on standard error (behind its progress)."""
    code = call("score", *words)
    out, err = capsys.readouterr()
    assert (code, out) == (2, "")
    assert "Traceback" not in err
    said = err[err.index("rewild4d-bench: ") :].strip()
    assert len(said.splitlines()) == 1
    return said


def flat(*color: int, size: tuple[int, int] = (40, 48), dtype: type = np.uint8) -> np.ndarray:
    """One colour, OpenCV's channel order, [h, w, c]."""
    return np.full((*size, len(color)), color, dtype=dtype)


def noise(seed: int, size: tuple[int, int] = (40, 48)) -> np.ndarray:
    return np.random.default_rng(seed).integers(0, 256, (*size, 3), dtype=np.uint8)


GREY = noise(0)[..., :1]


def write(path: Path, image: np.ndarray) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    if path.suffix == ".npy":
        np.save(path, image)
    else:
        assert cv2.imwrite(str(path), image)
    return path


def with_alpha(image: np.ndarray, rows: slice, columns: slice) -> np.ndarray:
    alpha = np.zeros((*image.shape[:2], 1), dtype=np.uint8)
    alpha[rows, columns] = 255
    return np.concatenate((image, alpha), axis=2)


def clips(folder: Path, names: str, frames: int, seed: int) -> Path:
    for i, name in enumerate(names):
        for frame in range(frames):
            write(folder / name / f"{frame}.png", noise(1000 * seed + 100 * i + frame, (16, 16)))
    return folder
