"""Pictures and films as cameras and programs write them, read by `score` as a viewer shows them."""

from pathlib import Path

import cv2
import moving
import numpy as np
import pytest
from pictures import GREY, Call, flat, noise, write
from PIL import Image, ImageOps

from rewild4d.datasets.images import ORIENTATION
from rewild4d.metrics.image import PSNR_CAP


@pytest.mark.parametrize("turn", range(1, 9))
def test_pictures_are_upright(score: Call, tmp_path: Path, turn: int) -> None:
    """A photograph that was stored turned, with a tag that says how, is the picture that a viewer shows."""
    soft = cv2.resize(noise(5, (5, 6)), (48, 40), interpolation=cv2.INTER_CUBIC)
    tags = Image.Exif()
    tags[ORIENTATION] = turn
    (tmp_path / "p").mkdir()
    Image.fromarray(soft).save(tmp_path / "p" / "a.jpg", quality=95, exif=tags)
    shown = np.asarray(ImageOps.exif_transpose(Image.open(tmp_path / "p" / "a.jpg")))
    write(tmp_path / "t" / "a.png", shown[..., ::-1])
    found = score("--pred", tmp_path / "p", "--truth", tmp_path / "t", "--only", "psnr")
    assert found["scores"]["psnr"]["value"] > 40


def test_one_grey_that_means_transparent(score: Call, tmp_path: Path) -> None:
    """Such a file and one with an alpha channel show the same picture on any background."""
    grey = np.where(GREY[..., 0] < 128, 7, 200).astype(np.uint8)
    (tmp_path / "p").mkdir()
    Image.fromarray(grey).save(tmp_path / "p" / "a.png", transparency=7)
    alpha = np.where(grey == 7, 0, 255).astype(np.uint8)
    write(tmp_path / "t" / "a.png", np.dstack((grey, grey, grey, alpha)))
    found = score("--pred", tmp_path / "p", "--truth", tmp_path / "t", "--only", "psnr", "--background", 0)
    assert found["scores"]["psnr"]["value"] == PSNR_CAP


def test_fill_bytes_before_a_marker_are_legal(score: Call, tmp_path: Path) -> None:
    """ITU T.81, B.1.1.2."""
    write(tmp_path / "t" / "a.jpg", flat(120, 90, 60))
    whole = (tmp_path / "t" / "a.jpg").read_bytes()
    (tmp_path / "p").mkdir()
    (tmp_path / "p" / "a.jpg").write_bytes(whole[:2] + b"\xff\xff" + whole[2:])
    found = score("--pred", tmp_path / "p", "--truth", tmp_path / "t", "--only", "psnr")
    assert found["scores"]["psnr"]["value"] == PSNR_CAP


def test_a_video_of_changing_rate_has_each_frame_once(score: Call, tmp_path: Path) -> None:
    for i in range(8):
        write(tmp_path / "t" / "v" / f"{i:05d}.png", flat(20 + 25 * i, 20 + 25 * i, 20 + 25 * i, size=(32, 32)))
    (tmp_path / "p").mkdir()
    slower = "setpts='if(lt(N,4),N,4+(N-4)*3)/(25*TB)'"
    moving.film(
        tmp_path / "p" / "v.mp4", tmp_path / "t" / "v", "-vf", slower, "-fps_mode", "passthrough", "-enc_time_base",
        "1:1000", "-c:v", "libx264", "-qp", 0, "-pix_fmt", "yuv444p", fps=25,
    )  # fmt: skip
    found = score("--pred", tmp_path / "p", "--truth", tmp_path / "t", "--only", "psnr")
    assert found["scores"]["psnr"]["count"] == 8 and min(found["scores"]["psnr"]["per_item"]) > 40


def test_a_video_of_wide_pixels_is_what_people_see_and_told(score: Call, tmp_path: Path) -> None:
    """Pixels of 2:1 show a frame of 32x16 as one of 64x16."""
    for i in range(4):
        write(tmp_path / "s" / f"{i:05d}.png", flat(20, 60, 90, size=(16, 32)))
        write(tmp_path / "t" / "v" / f"{i:05d}.png", flat(20, 60, 90, size=(16, 64)))
    (tmp_path / "p").mkdir()
    moving.film(
        tmp_path / "p" / "v.mp4",
        tmp_path / "s",
        "-vf",
        "setsar=2/1",
        "-c:v",
        "libx264",
        "-qp",
        0,
        "-pix_fmt",
        "yuv444p",
    )
    found = score("--pred", tmp_path / "p", "--truth", tmp_path / "t", "--only", "psnr")
    assert found["scores"]["psnr"]["value"] > 40
    assert any("pixels made square: 32x16 stretched to 64x16" in note for note in found["notes"])
