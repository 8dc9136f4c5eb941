"""Videos whose pixels are not square are stretched to what people see, masks and keypoints too, and it is told."""

from pathlib import Path

import cv2
import moving
import numpy as np
import pytest

from rewild4d.datasets.video.footage import open_footage
from rewild4d.datasets.video.online import Online
from rewild4d.datasets.video.video_file import read_video, video_facts
from rewild4d.errors import UserError

pytestmark = pytest.mark.usefixtures("cache")

WIDTH, HEIGHT = moving.SIZE
TOLD = f"pixels made square: {WIDTH}x{HEIGHT} stretched to {2 * WIDTH}x{HEIGHT}"


def film(folder: Path, aspect: str, name: str = "a.mp4") -> Path:
    """A film of five frames whose header says how wide a pixel is over its height."""
    frames = moving.frames(folder / f"{name}-frames", count=5)
    return moving.film(folder / name, frames, "-crf", 10, "-pix_fmt", "yuv420p", "-vf", f"setsar={aspect}")


def wide(image: np.ndarray) -> np.ndarray:
    stretched: np.ndarray = cv2.resize(image, (2 * WIDTH, HEIGHT), interpolation=cv2.INTER_LINEAR)
    return stretched


@pytest.mark.parametrize(
    ("aspect", "width"), [("2/1", 2 * WIDTH), ("1/2", WIDTH // 2), ("8/9", round(WIDTH * 8 / 9)), ("1/1", WIDTH)]
)
def test_frames_have_the_shape_that_people_see(aspect: str, width: int, tmp_path: Path) -> None:
    path = film(tmp_path, aspect)
    facts = video_facts(path)
    assert (facts.width, facts.height, facts.stored) == (width, HEIGHT, moving.SIZE)
    assert {frame.shape for frame in read_video(path)} == {(HEIGHT, width, 4)}
    assert facts.changes == (() if width == WIDTH else (f"pixels made square: 96x64 stretched to {width}x64",))


def test_a_turned_film_is_stretched_across_what_was_down(tmp_path: Path) -> None:
    path = tmp_path / "turned.mp4"
    moving.ffmpeg("-display_rotation", 90, "-i", film(tmp_path, "2/1"), "-c", "copy", path)
    facts = video_facts(path)
    # upright the frame is 64x96, and its pixels are half as wide as high
    assert facts.stored == (HEIGHT, WIDTH) and (facts.width, facts.height) == (HEIGHT // 2, WIDTH)


@pytest.mark.parametrize(("inner", "outer", "width"), [("1/1", "3:1", 2 * WIDTH), ("2/1", "3:2", WIDTH)])
def test_what_the_container_says_counts(inner: str, outer: str, width: int, tmp_path: Path) -> None:
    """96x64 pixels are a picture of 3:2 where they are square, of 3:1 where they are twice as wide as high."""
    path = tmp_path / "b.mp4"
    moving.ffmpeg("-i", film(tmp_path, inner), "-c", "copy", "-aspect", outer, path)
    assert (video_facts(path).width, next(read_video(path)).shape[1]) == (width, width)


def test_masks_of_either_shape_fit_and_the_record_is_told(tmp_path: Path) -> None:
    path = film(tmp_path, "2/1")
    moving.masks(tmp_path / "narrow", count=5)
    for i in range(5):
        moving.save(tmp_path / "wide" / f"{i:05d}.png", wide(moving.mask(i)))
    square = moving.film(tmp_path / "m.mp4", tmp_path / "narrow", "-crf", 10, "-pix_fmt", "yuv420p")
    for masks in (tmp_path / "narrow", tmp_path / "wide", square):
        video = Online(path, masks=masks).video("a")
        assert video.size == (2 * WIDTH, HEIGHT) and TOLD in video.notes
        for index, (image, mask) in enumerate(zip(video.images(), video.masks(), strict=True)):
            assert image.shape[:2] == (HEIGHT, 2 * WIDTH) and mask is not None
            right = wide(moving.mask(index)) > 127
            assert ((mask > 127) == right).mean() > 0.98
            assert ((image[..., 0] > image[..., 1]) == right).mean() > 0.98  # the animal is red, its meadow green
    moving.masks(tmp_path / "other", count=5, size=(HEIGHT, WIDTH))
    with pytest.raises(UserError, match="expected a mask of 192x64 pixels like its frame .*, got 64x96"):
        list(Online(path, masks=tmp_path / "other").video("a").masks())


def test_keypoints_are_stretched_like_the_frames(tmp_path: Path) -> None:
    """Programs that make them count in the pixels that a file stores."""
    moving.masks(tmp_path / "m", count=5)
    (tmp_path / "k.csv").write_text("scorer,net,net\nbodyparts,nose,nose\ncoords,x,y\n0,30,20\n")
    video = Online(film(tmp_path, "2/1"), masks=tmp_path / "m", keypoints=tmp_path / "k.csv").video("a")
    points = video.moments[0].keypoints
    assert points is not None and points.points.tolist() == [[2 * 30.5, 20.5]]
    assert "keypoints stretched like the frames" in video.notes


def test_scored_videos_are_squared_too(tmp_path: Path) -> None:
    (reel,) = open_footage(film(tmp_path, "2/1")).reels
    assert reel.picture(0).rgb.shape == (3, HEIGHT, 2 * WIDTH)


def test_pixels_that_no_camera_has_are_one_sentence(tmp_path: Path) -> None:
    with pytest.raises(UserError, match=r"a\.mp4: expected pixels that are about square, got some of 50:1"):
        video_facts(film(tmp_path, "50/1"))
