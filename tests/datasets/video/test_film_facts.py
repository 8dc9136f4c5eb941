"""Films of high dynamic range, of fields, of uneven frame rates: frames are what people see, and it is told."""

from pathlib import Path

import moving
import numpy as np
import pytest

from rewild4d.datasets.video.online import Online
from rewild4d.datasets.video.video_file import read_video, video_facts

COUNT = 6
WIDTH, HEIGHT = moving.SIZE


def plain(folder: Path, *how: object, count: int = COUNT) -> Path:
    """A film of the moving animal."""
    folder.mkdir(exist_ok=True)
    return moving.film(folder / "a.mp4", moving.frames(folder / "frames", count), "-crf", 1, *how)


def high_range(film: Path, curve: str) -> Path:
    """The same film as a telephone stores it: ten bits, Rec. 2020, white at 203 cd/m2."""
    path = film.with_name(f"{curve}.mp4")
    colors = "range=pc:colorspace=gbr:color_primaries=bt709:color_trc=bt709"
    bright = f"zscale=t=linear,zscale=p=bt2020,zscale=t={curve}:m=bt2020nc:r=tv:npl=203"
    tags = ("-color_primaries", "bt2020", "-color_trc", curve, "-colorspace", "bt2020nc")
    moving.ffmpeg(
        "-i", film.parent / "frames" / "%05d.png", "-vf", f"setparams={colors},format=gbrpf32le,{bright}",
        "-pix_fmt", "yuv444p10le", "-c:v", "libx264", "-crf", 1, *tags, path,
    )  # fmt: skip
    return path


@pytest.mark.parametrize(("curve", "name"), [("smpte2084", "PQ"), ("arib-std-b67", "HLG")])
def test_high_dynamic_range_is_brought_to_the_colours_that_people_see(curve: str, name: str, tmp_path: Path) -> None:
    film = high_range(plain(tmp_path), curve)
    assert video_facts(film).changes == (f"{name}, high dynamic range: brought to sRGB's, 203 cd/m2 as white",)
    frames = list(read_video(film))
    assert len(frames) == COUNT
    for index, frame in enumerate(frames):
        error = np.abs(frame[..., :3].astype(int) - moving.image(index))
        assert np.median(error) <= 4 and error.mean() < 8, "read as they are stored, greens are off by 30"


def fields(film: Path, count: int) -> Path:
    """A film of fields: the upper lines of one moment, the lower ones of the next."""
    path = film.with_name("fields.mp4")
    moving.ffmpeg(
        "-i", film, "-vf", "tinterlace=interleave_top,setfield=tff", "-flags", "+ildct+ilme", "-x264opts", "tff=1",
        "-c:v", "libx264", "-crf", 1, "-pix_fmt", "yuv444p", "-frames:v", count // 2, path,
    )  # fmt: skip
    return path


def combing(image: np.ndarray) -> float:
    """How much each line differs from the mean of its neighbours, of all that differs from line to line."""
    lines = image[..., 0].astype(float)
    return float(np.abs(lines[1:-1] - (lines[:-2] + lines[2:]) / 2).mean() / np.abs(lines[2:] - lines[:-2]).mean())


def test_fields_become_whole_frames(tmp_path: Path) -> None:
    """The animal moves by 3 pixels a field."""
    tmp_path.joinpath("frames").mkdir()
    for index in range(12):
        moving.save(tmp_path / "frames" / f"{index:05d}.png", moving.image(index, step=3.0))
    film = fields(moving.film(tmp_path / "a.mp4", tmp_path / "frames", "-crf", 1, "-pix_fmt", "yuv444p"), 12)
    facts, frames = video_facts(film), list(read_video(film))
    assert len(facts.times) == len(frames) == 6
    assert facts.changes == (
        "interlaced: each frame is made whole from its first field and what lies between the second's",
    )
    true = moving.image(4, step=3.0)  # the first field of the third frame
    woven = np.where(np.arange(HEIGHT)[:, None, None] % 2, moving.image(5, step=3.0), true)
    assert combing(frames[2]) < 1.2 * combing(true) < 0.6 * combing(woven)
    assert np.abs(frames[2][..., :3].astype(int) - true).mean() < 0.7 * np.abs(woven.astype(int) - true).mean()


def test_chosen_frames_are_those_of_the_whole_film(tmp_path: Path) -> None:
    for film in (plain(tmp_path), fields(plain(tmp_path / "b", "-pix_fmt", "yuv420p", count=12), 12)):
        every = list(read_video(film))
        for chosen in ([0], [2, 3], [1, 4], [5], [0, 5]):
            found = list(read_video(film, chosen))
            assert len(found) == len(chosen)
            assert all((frame == every[index]).all() for frame, index in zip(found, chosen, strict=True))


def test_an_uneven_frame_rate_is_told_and_kept(tmp_path: Path) -> None:
    """A telephone drops every third frame of ten a second."""
    film = plain(tmp_path, "-vf", "select=mod(n\\,3)", "-fps_mode", "vfr", count=9)
    facts = video_facts(film)
    assert facts.times == pytest.approx([0, 0.1, 0.3, 0.4, 0.6, 0.7], abs=1e-3)
    assert facts.pace == "the frame rate varies, 5 to 10 a second: each frame keeps its own time"
    masks = moving.masks(tmp_path / "masks", 6)
    assert facts.pace in Online(film, masks=masks).video("a").notes
