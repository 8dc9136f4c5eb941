"""Whether masks can be trusted: good ones are never red, every kind of bad one is told."""

from collections.abc import Callable
from pathlib import Path

import cv2
import moving
import numpy as np
import pytest

from rewild4d.contracts import Verdict
from rewild4d.datasets.masking import trust
from rewild4d.datasets.masking.trust import MaskTrust
from rewild4d.datasets.video.online import Online
from rewild4d.metrics.weights import is_here

SIZE = (384, 256)
COUNT = 12
LABELS = [f"frame {number}" for number in range(COUNT)]


@pytest.fixture(params=["with the network", "without"])
def network(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> bool:
    """Red things stand out; or the weights are not here."""
    monkeypatch.setattr(trust, "is_here", lambda _: request.param != "without")
    monkeypatch.setattr(trust, "load_weights", lambda _: None)
    monkeypatch.setattr(trust, "Saliency", lambda _: lambda image: (image[..., 0] > 150).astype(np.float32))
    return request.param != "without"


def true(number: int) -> np.ndarray:
    return moving.mask(number, SIZE)


def picture(number: int) -> np.ndarray:
    noise = np.random.default_rng(0).integers(0, 25, SIZE[::-1])[..., None]
    return np.clip(moving.image(number, SIZE).astype(int) + noise, 0, 255).astype(np.uint8)


def judged(mask_of: Callable[[int], np.ndarray | None]) -> Verdict:
    found = MaskTrust(COUNT)
    for number in range(COUNT):
        found.add(number, picture(number), mask_of(number))
    return found.verdict(LABELS)


def grown(mask: np.ndarray, pixels: int) -> np.ndarray:
    kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * abs(pixels) + 1,) * 2)
    return cv2.dilate(mask, kernel) if pixels > 0 else cv2.erode(mask, kernel)


def without_head(mask: np.ndarray) -> np.ndarray:
    left, _, width, _ = cv2.boundingRect(mask)
    cut = mask.copy()
    cut[:, left + 3 * width // 4 :] = 0
    return cut


def test_true_masks_are_green(network: bool) -> None:
    verdict = judged(true)
    assert verdict.level == "green" and verdict.about == "masks"
    assert ("was not looked at" in verdict.reason) == (not network)


@pytest.mark.usefixtures("network")
@pytest.mark.parametrize(
    ("level", "said", "mask_of"),
    [
        ("red", "too small, or shifted: the picture's edges lie outside theirs", lambda n: grown(true(n), -5)),
        ("red", "too large, or shifted: the picture's edges lie inside theirs", lambda n: grown(true(n), 9)),
        ("red", "the animal lies all along the image's border; invert", lambda n: 255 - true(n)),
        ("red", "none of the frames that were looked at has a mask", lambda n: None if n % 2 else 0 * true(n)),
    ],
)
def test_bad_masks_are_red_with_and_without_the_network(
    level: str, said: str, mask_of: Callable[[int], np.ndarray | None]
) -> None:
    verdict = judged(mask_of)
    assert verdict.level == level and said in str(verdict)


@pytest.mark.parametrize("network", ["with the network"], indirect=True)
@pytest.mark.usefixtures("network")
def test_masks_beside_the_animal_are_not_trusted() -> None:
    assert judged(lambda number: np.roll(true(number), 60, axis=1)).level == "red"


@pytest.mark.parametrize("network", ["with the network"], indirect=True)
@pytest.mark.usefixtures("network")
def test_a_missing_head_is_told_with_its_frame() -> None:
    verdict = judged(lambda number: without_head(true(number)))
    assert verdict.level == "yellow"
    assert "of what stands out lies outside them (head, legs or a rider?), first in frame 0" in verdict.reason
    assert "--marks" in verdict.advice


@pytest.mark.parametrize("network", ["without"], indirect=True)
@pytest.mark.usefixtures("network")
def test_masks_that_jump_are_told() -> None:
    verdict = judged(lambda number: without_head(true(number)) if number % 2 else true(number))
    assert verdict.level == "yellow" and "they jump: motion carries only" in verdict.reason


def test_check_says_first_whether_masks_can_be_trusted(tmp_path: Path) -> None:
    frames, masks = tmp_path / "frames", tmp_path / "masks"
    for number in range(COUNT):
        moving.save(frames / f"{number:05d}.png", picture(number))
        moving.save(masks / f"{number:05d}.png", 255 - true(number))
    first = Online(frames, masks=masks).check()[0]
    assert first.level == "warning" and first.message.startswith("masks: red: the animal lies all along")
    assert Online(frames, masks=masks).judge_masks("frames").level == "red"


@pytest.mark.parametrize("name", ["camel", "cows"])
def test_true_masks_of_real_films_are_green_and_headless_ones_are_told(davis: Path, name: str) -> None:
    """Every bad kind on all frames: docs/experiments/trust.md."""
    if not is_here("u2netp"):
        pytest.skip("no weights of u2netp: rewild4d-bench weights fetch u2netp")
    files = sorted((davis / "JPEGImages" / "480p" / name).glob("*.jpg"))[::10]
    found = {kind: MaskTrust(len(files)) for kind in ("true", "cut")}
    for number, file in enumerate(files):
        image = cv2.imread(str(file))
        mask = cv2.imread(str(davis / "Annotations/480p" / name / f"{file.stem}.png"), cv2.IMREAD_GRAYSCALE)
        assert image is not None and mask is not None
        found["true"].add(number, image[..., ::-1], mask)
        found["cut"].add(number, image[..., ::-1], without_head(mask))
    labels = [file.stem for file in files]
    # One frame in ten: masks are no longer like those before.
    assert found["true"].verdict(labels).level != "red"
    assert found["cut"].verdict(labels).level != "green"


@pytest.mark.usefixtures("network")
@pytest.mark.parametrize(
    ("level", "mask_of"),
    [
        ("yellow", lambda n: 0 * true(n) if n == 5 else true(n)),
        ("yellow", lambda n: without_head(without_head(true(n))) if n == 5 else true(n)),
        ("green", lambda n: None if n == 5 else true(n)),
        ("green", lambda n: 0 * true(n) if n == 11 else true(n)),
    ],
    ids=["lost between others", "smaller in one frame by 44 %", "a frame without a mask", "gone at the end"],
)
def test_masks_that_are_lost_or_jump_are_told(level: str, mask_of: Callable[[int], np.ndarray | None]) -> None:
    verdict = judged(mask_of)
    assert verdict.level == level
    assert ("the animal is lost, or its mask jumps, in " in str(verdict)) == (level == "yellow")
