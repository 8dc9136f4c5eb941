"""`score` on what cannot be scored: one sentence with the path, what was expected and what came; nothing written."""

from pathlib import Path

import cv2
import numpy as np
import pytest
from pictures import clips, flat, noise, refused, write

from rewild4d.evaluation.networks import Networks


@pytest.fixture(autouse=True)
def no_networks(monkeypatch: pytest.MonkeyPatch) -> None:
    """Nothing here gets as far as a network."""
    missing = dict.fromkeys(("lpips-alex", "lpips-vgg", "kid", "fvd"), "none in this test")
    monkeypatch.setattr(
        "rewild4d.evaluation.networks.load_networks", lambda families, device: Networks(missing=missing)
    )


def damaged(image: np.ndarray) -> bytes:
    return cv2.imencode(".png", image)[1].tobytes()[:-20]


@pytest.mark.parametrize(
    ("name", "content", "sentence"),
    [
        ("a.png", damaged(noise(1)), "a.png: expected a whole image, got a PNG"),
        ("a.png", b"", "a.png: expected a whole image, got an empty file"),
        ("a.png", flat(0, 0, 0, size=(40, 47)), "a.png: expected 48x40 pixels like"),
        ("b.png", noise(1), "expected the 1 names of"),
        ("a.npy", np.full((40, 48, 3), np.nan), "a.npy: expected values in [0, 1], got a NaN"),
        ("a.npy", np.full((40, 48, 3), 255.0), "a.npy: expected values in [0, 1], got 255 to 255"),
        (
            "a.npy",
            np.zeros((3, 40, 48)),
            "a.npy: expected an array [h, w], [h, w, 3] or [h, w, 4], got float64 [3, 40, 48]",
        ),
        (
            "a.npy",
            np.zeros((40, 48), dtype=np.int64),
            "a.npy: expected floats in [0, 1] or unsigned integers, got int64",
        ),
        ("a.npy", np.array([{"a": 1}], dtype=object), "a.npy: expected a whole .npy array of numbers, but:"),
        ("a.npy", b"\x93NUMPY", "a.npy: expected a whole .npy array of numbers, but:"),
        ("a.txt", b"", "expected images (.png, .jpg, .jpeg, .npy), folders of frames or videos"),
        (None, b"", "got an empty folder"),
    ],
)
def test_bad_predictions_are_one_sentence(
    capsys: pytest.CaptureFixture[str], tmp_path: Path,
    name: str | None, content: bytes | np.ndarray, sentence: str,
) -> None:  # fmt: skip
    write(tmp_path / "t" / "a.png", noise(0))
    (tmp_path / "p").mkdir()
    if isinstance(content, np.ndarray):
        write(tmp_path / "p" / str(name), content)
    elif name:
        (tmp_path / "p" / name).write_bytes(content)
    out = tmp_path / "out.json"
    words = ["--pred", tmp_path / "p", "--truth", tmp_path / "t", "--out", out]
    if name == "b.png":  # a shared name, and one that is not
        write(tmp_path / "p" / "a.png", noise(1))
    assert sentence in refused(capsys, *words)
    assert not out.exists()


@pytest.mark.parametrize(
    ("mask", "sentence"),
    [
        (flat(1)[..., 0], "expected a mask that is white (255, or 1.0) inside, got no value above 1 of 255"),
        (flat(0, 0, 128), "got no value above 38.3 of 255"),  # DAVIS's first palette colour
        (flat(255, size=(40, 40))[..., 0], "a.png: expected 48x40 pixels like"),
    ],
)
def test_bad_masks_are_one_sentence(
    capsys: pytest.CaptureFixture[str], tmp_path: Path, mask: np.ndarray, sentence: str
) -> None:
    write(tmp_path / "t" / "a.png", noise(0))
    write(tmp_path / "m" / "a.png", mask)
    words = ["--pred", tmp_path / "t", "--truth", tmp_path / "t"]
    assert sentence in refused(capsys, *words, "--masks", tmp_path / "m")
    assert sentence in refused(capsys, *words, "--pred-masks", tmp_path / "m")


def test_folders_that_do_not_fit_are_one_sentence(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    images, two = write(tmp_path / "t" / "a.png", noise(0)).parent, clips(tmp_path / "c", "ab", 2, 0)
    write(tmp_path / "mixed" / "a.png", noise(0))
    clips(tmp_path / "mixed", "ab", 2, 0)
    write(tmp_path / "twice" / "a.png", noise(0))
    write(tmp_path / "twice" / "a.jpg", noise(0))
    (tmp_path / "hollow" / "a").mkdir(parents=True)
    video = tmp_path / "v.mp4"
    video.write_bytes(b"nothing")
    for words, sentence in (
        ([tmp_path / "none", images], "none: expected a folder of images or clips, but: No such file or directory"),
        ([images, two], "expected clips like"),
        ([tmp_path / "mixed", images], "expected either images or clips, got a.png beside a"),
        ([tmp_path / "twice", images], "expected one image of that name, but there is a.jpg too"),
        ([tmp_path / "hollow", two], "expected a clip's frames (.png, .jpg, .jpeg, .npy), got none"),
        ([video, two], "v.mp4: expected a video that ffmpeg can read, got a damaged or another file"),
        ([tmp_path / "a.ply", images], "score: expected two .ply files or none"),
        ([images, images, "--only", "psn"], "unknown score 'psn'. Did you mean 'psnr'?"),
        ([images, images, "--background", "2"], "--background: expected a grey level from 0 to 1, got 2"),
        ([images, images, "--fps", "0"], "--fps: expected a number above 0, got 0"),
        ([images, images, "--device", "tpu"], "--device: expected auto, cpu or cuda, got 'tpu'"),
        ([images, images, "--out", video / "x.json"], "expected a folder that can be written"),
        ([images, images, "--out", images], "expected the name of a file to write, but it is a folder"),
        ([images, images, "--unpaired", "--only", "psnr"], "--unpaired: expected kid or fvd among --only, got psnr"),
    ):
        assert sentence in refused(capsys, "--pred", words[0], "--truth", words[1], *words[2:])
