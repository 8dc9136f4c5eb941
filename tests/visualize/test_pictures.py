"""Pictures of a run: back in the original frame, and once around the animal, upright."""

import math
from dataclasses import replace
from pathlib import Path

import imageio.v2 as imageio
import moving
import numpy as np
import pytest
import torch
from films import SELECTION, Plate
from signposts import CROP, TURNED, UP, Posed, Signpost, clip_of, seen_from

from rewild4d.baselines.empty import EmptyReconstruction
from rewild4d.cameras.recropping import all_moments
from rewild4d.contracts import DatasetReader
from rewild4d.datasets.video.aptv2 import AptV2
from rewild4d.datasets.video.davis import Davis
from rewild4d.datasets.video.online import Online
from rewild4d.errors import UserError
from rewild4d.running.conformance import tiny_case
from rewild4d.types import Clip, Crop
from rewild4d.visualize import original_view, turntable
from rewild4d.visualize.original_view import original_frames, save_original_view
from rewild4d.visualize.pictures import PANEL, over
from rewild4d.visualize.run_pictures import comparison, save_pictures
from rewild4d.visualize.turntable import Framing, find_framing, four_views, orbit_frames

pytestmark = pytest.mark.usefixtures("cache")


@pytest.fixture(scope="module", autouse=True)
def kernels() -> None:
    """Loaded from the usual cache, before each test gets one of its own."""
    post = Signpost(seen_from((1.0, 0.2, 0.0)))
    over(post.at(0.0), post.camera(0.0))


def footage(root: Path) -> tuple[DatasetReader, Clip]:
    """A reader and all its moments."""
    moving.frames(root / "clip" / "frames", 24, step=0.5)
    moving.masks(root / "clip" / "masks", 24, step=0.5)
    reader = Online(root / "clip", fps=10)
    return reader, all_moments(*reader.load("clip", SELECTION))


def test_readers_give_the_whole_frames_of_all_moments(tmp_path: Path) -> None:
    online, _ = footage(tmp_path)
    readers = {
        "clip": (online, 0.5),
        "camel": (Davis(moving.davis(tmp_path / "davis")), 1.0),
        "easy/29wolf/v1C1@3": (AptV2(moving.apt(tmp_path / "apt")), 1.0),
    }
    for name, (reader, step) in readers.items():
        clip, truth = reader.load(name, SELECTION)
        shown = original_frames(reader, clip, SELECTION)
        assert shown is not None
        wholes = list(shown)
        assert len(wholes) == len(clip.frames) + len(truth.held_out)
        for frame, whole in zip(all_moments(clip, truth).frames, wholes, strict=True):
            index = round(frame.time * (24 if name == "camel" else 10))
            off = [np.abs(whole - moving.image(i, step=step).astype(float)).mean() for i in range(24)]
            assert whole.dtype == np.uint8 and off.index(min(off)) == index and min(off) < 3
    assert original_frames(object(), clip, SELECTION) is None  # type: ignore[arg-type]


def test_the_matte_lies_where_the_animal_was(tmp_path: Path) -> None:
    clip = footage(tmp_path)[1]
    for frame in clip.frames[::6]:
        assert frame.crop is not None
        matte = original_view._original_matte(frame.mask, frame.crop)[0].numpy() > 0.5
        true = moving.mask(round(frame.time * 10), step=0.5) > 0
        assert matte.shape == moving.SIZE[::-1]
        assert (matte & true).sum() / (matte | true).sum() > 0.93
    large = original_view._original_matte(torch.ones(1, 64, 64), Crop(-200.0, 0.0, 2000.0, 3840, 2161))
    assert large.shape == (1, 540, 960)
    assert int((large[0, 270] > 0.5).sum()) == pytest.approx(1800 / 4, abs=2), "the crop reaches 200 pixels over"


def test_the_render_takes_the_animals_place_and_nothing_else(tmp_path: Path) -> None:
    reader, clip = footage(tmp_path)
    whole = next(iter(original_frames(reader, clip, SELECTION) or ()))
    true = torch.from_numpy(moving.mask(0, step=0.5) > 0)
    image = torch.from_numpy(whole).permute(2, 0, 1).float() / 255
    blank = original_view._beside(EmptyReconstruction(), clip.frames[0], whole)
    factor = math.ceil(PANEL / moving.SIZE[0])
    left, right = (side[:, ::factor, ::factor] for side in blank.chunk(2, dim=2))
    assert torch.equal(left, image)
    inner = -torch.nn.functional.max_pool2d(-true[None].float(), 3, 1, 1)[0] > 0
    outer = torch.nn.functional.max_pool2d(true[None].float(), 5, 2 // 2, 2)[0] > 0
    assert torch.allclose(right[:, inner], torch.ones(1)) and torch.equal(right[:, ~outer], image[:, ~outer])
    plate = original_view._beside(Plate(clip), clip.frames[0], whole).chunk(2, dim=2)[1][:, ::factor, ::factor]
    assert float((plate - image)[:, inner].abs().mean()) < 0.08, "the same animal in the same place"
    assert float((right - image)[:, inner].abs().mean()) > 0.4


def test_the_film_and_the_sheet(tmp_path: Path) -> None:
    reader, clip = footage(tmp_path)
    wholes = original_frames(reader, clip, SELECTION)
    assert save_original_view(Plate(clip), clip, wholes, tmp_path) == ["original.mp4", "original.png"]
    film = list(iter(imageio.get_reader(tmp_path / "original.mp4").iter_data()))
    assert len(film) == len(clip.frames) and film[0].shape == (4 * 64, 2 * 4 * 96, 3)
    sheet = imageio.imread(tmp_path / "original.png")
    assert sheet.shape == (24 + 3 * 240, 4 * 360, 3)
    save_original_view(Plate(clip), clip, None, tmp_path)
    assert imageio.imread(tmp_path / "original.png").shape == (24 + 3 * 240, 2 * 360, 3)
    assert imageio.get_reader(tmp_path / "original.mp4").get_data(0)[:4, :4].min() > 250, "on white"
    with pytest.raises(UserError, match="expected 24 original frames for its pictures, got 3"):
        save_original_view(Plate(clip), clip, list(original_frames(reader, clip, SELECTION) or ())[:3], tmp_path)
    still = tiny_case().clip
    assert save_original_view(EmptyReconstruction(), still, None, tmp_path / "none") == []
    assert not (tmp_path / "none").exists()


def middle_of(image: torch.Tensor, channel: int) -> tuple[float, float] | None:
    """Column and row of the middle of one pure colour, or None."""
    others = [other for other in range(3) if other != channel]
    found = (image[channel] > 0.6) & (image[others].amax(0) < 0.45)
    rows, columns = torch.nonzero(found, as_tuple=True)
    return (float(columns.double().mean()), float(rows.double().mean())) if len(rows) > 10 else None


def panels(image: torch.Tensor) -> list[torch.Tensor]:
    assert image.shape == (3, 24 + PANEL, 4 * PANEL)
    return list(image[:, 24:].chunk(4, dim=2))


@pytest.mark.parametrize("toward", [(-1.0, 0.5, 0.4), (1.0, 0.5, 0.4)])
def test_four_sides_begin_with_the_one_the_camera_saw(toward: tuple[float, float, float]) -> None:
    cameras = seen_from(toward)
    clip = clip_of(cameras, CROP)
    framing = find_framing(Signpost(cameras), clip, None)
    assert framing is not None and framing.known
    seen = "left" if toward[0] > 0 else "right"
    other = "right" if seen == "left" else "left"
    titles = list(turntable._sides(framing))
    assert titles == [f"{seen} side (the camera's)", "front", f"{other} side", "behind"]
    assert next(iter(turntable._sides(replace(framing, steady=0.6)))) == f"{seen} side", "it walked around"
    side, front, far, behind = panels(four_views(Signpost(cameras), clip, framing))
    red = [middle_of(panel, 0) for panel in (side, far)]
    # From its right an animal looks to the right, from its left to the left.
    ahead = 1 if seen == "right" else -1
    assert red[0] is not None and ahead * (red[0][0] - PANEL / 2) > 50
    assert red[1] is not None and ahead * (red[1][0] - PANEL / 2) < -50
    for panel in (side, front, far, behind):
        green = middle_of(panel, 1)
        assert green is not None and green[1] < PANEL / 2 - 15, "above the middle: upright"
    blue = [middle_of(panel, 2) for panel in (front, behind)]
    assert blue[0] is not None and blue[0][0] > PANEL / 2 + 20, "its left is on our right when it faces us"
    assert blue[1] is not None and blue[1][0] < PANEL / 2 - 20


def test_a_skinned_shape_brings_its_own_axes() -> None:
    cameras = seen_from((-1.0, 0.2, 0.0))
    posed = Posed(cameras, TURNED)
    framing = find_framing(posed, clip_of(cameras, None), None)
    assert framing is not None and framing.known
    torch.testing.assert_close(framing.axes[0], TURNED.T)
    (side, *_) = panels(four_views(posed, clip_of(cameras, None), framing))
    green = middle_of(side, 1)
    assert green is not None and green[1] < PANEL / 2 - 15


def test_where_nobody_knows_what_is_ahead_it_says_quarters() -> None:
    cameras = seen_from((-1.0, 0.5, 0.4))
    clip = clip_of(cameras, None)
    framing = find_framing(Signpost(cameras), clip, UP)
    assert framing is not None and not framing.known and framing.azimuth == pytest.approx(0, abs=0.05)
    torch.testing.assert_close(framing.axes[0, 1], UP)
    torch.testing.assert_close(framing.axes[0] @ framing.axes[0].T, torch.eye(3).double())
    assert float(torch.linalg.det(framing.axes[0])) == pytest.approx(1)


def test_the_turn_starts_at_the_camera_follows_the_animal_and_closes() -> None:
    cameras = seen_from((-1.0, 0.3, 0.2), count=24)
    clip, post = clip_of(cameras, CROP), Signpost(cameras, step=0.1)
    framing = find_framing(post, clip, None)
    assert isinstance(framing, Framing)
    images = list(orbit_frames(post, clip, framing))
    assert len(images) == 72 and images[0].shape == (3, PANEL, PANEL)
    rows = []
    for image in images[::6]:
        dark = (image.amin(0) < 0.8).nonzero().double()
        assert dark[:, 0].min() > 2 and dark[:, 0].max() < PANEL - 3, "all of it is in the picture"
        assert dark[:, 1].min() > 2 and dark[:, 1].max() < PANEL - 3
        rows.append(float(dark[:, 0].mean()))
    assert max(rows) - min(rows) < PANEL / 8, "upright: it does not swing"
    first = framing.camera(0, framing.azimuth).center - framing.middles[0]
    given = cameras[0.0].center - framing.middles[0]
    assert float(first @ given / first.norm() / given.norm()) > 0.9


def test_frames_that_are_shown_and_scored_are_drawn_once() -> None:
    case = tiny_case()
    two = comparison(EmptyReconstruction(), case.clip, replace(case.truth, held_out=case.clip.frames))
    four = comparison(EmptyReconstruction(), case.clip, case.truth)
    assert two.shape[2] == four.shape[2] / 2


def test_nothing_is_drawn_as_white(tmp_path: Path) -> None:
    case = tiny_case()
    assert find_framing(EmptyReconstruction(), case.clip, None) is None
    names = save_pictures(EmptyReconstruction(), case.clip, case.truth, tmp_path)
    assert names == ["comparison.png", "input.mp4", "orbit.mp4", "orbit.png"]
    assert imageio.imread(tmp_path / "orbit.png").shape == (24 + PANEL, 4 * PANEL, 3)
    assert imageio.imread(tmp_path / "orbit.png")[24:].min() == 255
