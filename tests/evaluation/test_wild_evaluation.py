"""Held-out frames of a video whose camera only the reconstruction knows."""

import math
from dataclasses import replace
from pathlib import Path

import moving
import pytest
import torch
from films import PROTOCOL, SELECTION, Plate

from rewild4d.baselines.empty import EmptyReconstruction
from rewild4d.datasets.video.online import Online
from rewild4d.errors import UserError
from rewild4d.evaluation import novel_views
from rewild4d.evaluation.measuring import evaluate
from rewild4d.evaluation.protocol import NovelViews, find_protocol
from rewild4d.types import Clip, Truth
from rewild4d.visualize.run_pictures import save_pictures

pytestmark = pytest.mark.usefixtures("cache")

CPU = torch.device("cpu")


@pytest.fixture
def case(tmp_path: Path) -> tuple[Clip, Truth]:
    moving.frames(tmp_path / "clip" / "frames", 24, step=0.5)
    moving.masks(tmp_path / "clip" / "masks", 24, step=0.5)
    return Online(tmp_path / "clip", fps=10).load("clip", SELECTION)


def test_held_out_frames_are_seen_with_the_reconstructions_camera(case: tuple[Clip, Truth]) -> None:
    clip, truth = case
    plate = Plate(clip)
    found = evaluate(plate, clip, truth, PROTOCOL, lambda *_: None, CPU)
    assert plate.asked == [frame.time for frame in truth.held_out]
    assert not set(plate.asked) & set(clip.times)
    assert (found.scores["iou"].value or 0) > 0.8
    empty = evaluate(EmptyReconstruction(), clip, truth, PROTOCOL, lambda *_: None, CPU)
    assert (found.scores["psnr"].value or 0) > (empty.scores["psnr"].value or 0) + 3
    shares = [float(frame.mask.mean()) for frame in truth.held_out]
    errors = [float((frame.over(1.0) - 1).square().mean()) for frame in truth.held_out]
    assert empty.scores["psnr"].per_item == pytest.approx([-10 * math.log10(error) for error in errors], abs=1e-4)
    assert min(shares) > 0.1 and empty.scores["iou"].value == 0


def test_without_any_camera_it_says_so(case: tuple[Clip, Truth]) -> None:
    clip, truth = case
    with pytest.raises(UserError, match="the frame at 0.2000 s needs a camera, but neither the data set nor"):
        evaluate(Plate(clip, knows=False), clip, truth, PROTOCOL, lambda *_: None, CPU)


def test_the_orbit_starts_at_the_reconstructions_camera(case: tuple[Clip, Truth]) -> None:
    clip = case[0]
    orbit = novel_views._Orbit(Plate(clip), clip, 1.0, NovelViews(upright=True), None)
    assert (orbit.cameras[0].width, orbit.cameras[0].height) == (64, 64)
    middle = orbit._middle()
    distances = torch.stack([(camera.center - middle).norm() for camera in orbit.cameras])
    assert torch.allclose(distances, middle.norm().expand(16))
    heights = torch.stack([camera.center[1] - middle[1] for camera in orbit.cameras])
    assert torch.allclose(heights, heights[:1])  # footage's y points up: a level circle
    blank = novel_views._Orbit(EmptyReconstruction(), clip, 1.0, NovelViews(upright=True), None)
    assert len(blank.cameras) == 16


def test_pictures_are_drawn_with_it(case: tuple[Clip, Truth], tmp_path: Path) -> None:
    clip, truth = case
    assert "orbit.mp4" in save_pictures(Plate(clip), clip, truth, tmp_path)
    assert (tmp_path / "comparison.png").stat().st_size > 1000


def test_a_protocol_for_cameras_is_refused(case: tuple[Clip, Truth], tmp_path: Path) -> None:
    reader = Online(tmp_path / "clip")
    with pytest.raises(UserError, match="expected a protocol for videos"):
        reader.load("clip", replace_selection())


def replace_selection():  # type: ignore[no-untyped-def]
    return find_protocol("artemis", "artemis-sweep-256-v1").selection


def test_digests_of_older_protocols_stay() -> None:
    """A setting that came later and is left out changes no digest."""
    old = find_protocol("artemis", "artemis-sweep-256-v1")
    assert old.selection.split is None
    assert find_protocol("davis", None).digest != find_protocol("davis", "davis-256-v2").digest
    clip = Clip("a", "b", (), 1.0, "", "", ())
    assert replace(clip, notes=("x",)).digest == clip.digest
