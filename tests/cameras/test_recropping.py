"""Cameras beside frames that the prior's filter left out: images there were cut by other squares than the line says."""

import math
from dataclasses import replace

import pytest
import torch
from prior_files import a_prior

from rewild4d.cameras.recropping import add_cameras, crop_between, recropped
from rewild4d.ours.motion import camera_between, frame_position
from rewild4d.priors.motion import world_camera
from rewild4d.priors.placing import in_crops, known_frames, with_cameras
from rewild4d.running import provenance
from rewild4d.types import Camera, Clip, Crop, Frame, Splats, Truth

SIZE, LEFT_OUT = 32, 4
POINT = torch.tensor((0.3, 0.1, -0.4), dtype=torch.float64)


def film(count: int = 10) -> Clip:
    """Crops of 64x64 frames at 24 a second that run after an animal ever faster and grow."""
    frames = [
        Frame(i / 24, None, torch.zeros(3, SIZE, SIZE), torch.ones(1, SIZE, SIZE), 0,
              Crop(2.0 + 0.2 * i * i, 4.0, 40.0 + 0.1 * i, 64, 64))
        for i in range(count)
    ]  # fmt: skip
    return Clip("cut/out", "none", tuple(frames), 24.0, "CC0", "", travel=torch.ones(count - 1, 2))


def without(clip: Clip, row: int) -> Clip:
    return clip.only([i for i in range(len(clip.frames)) if i != row])


class Known:
    """A method that keeps the cameras of the images that it was shown."""

    def __init__(self, shown: Clip) -> None:
        self.times = torch.tensor(shown.times, dtype=torch.float64)
        self.cameras = tuple(frame.camera for frame in shown.frames)

    def at(self, time: float) -> Splats:
        raise NotImplementedError

    def camera(self, time: float) -> Camera | None:
        return camera_between(self.cameras, frame_position(self.times, time))

    def save(self, folder: object) -> None: ...


def test_the_square_between_two_frames_lies_on_their_line_and_ends_with_the_clip() -> None:
    clip = without(film(), LEFT_OUT)
    assert crop_between(clip, 3 / 24) == clip.frames[3].crop
    halfway = crop_between(clip, 4 / 24)
    assert halfway is not None and (halfway.width, halfway.height) == (64, 64)
    # half-way between frames 3 and 5: 2 + 0.2 (9 + 25) / 2, and 40 + 0.1 x 4
    assert (halfway.left, halfway.side) == (pytest.approx(2 + 0.2 * 17), pytest.approx(40.4))
    assert crop_between(clip, -1.0) == clip.frames[0].crop and crop_between(clip, 9.0) == clip.frames[-1].crop
    whole = replace(clip, frames=tuple(replace(frame, crop=None) for frame in clip.frames))
    assert crop_between(whole, 0.0) is None


def test_a_point_is_at_one_place_of_the_original_frame_whatever_square_shows_it() -> None:
    clip = film()
    shown, frame = without(clip, LEFT_OUT), clip.frames[LEFT_OUT]
    expected = crop_between(shown, frame.time)
    assert frame.crop is not None and expected is not None
    whole = a_prior([0.4], [-0.4]).cameras[0]
    assert (whole.width, whole.height) == (64, 64)
    camera = recropped(expected.cropped_camera(whole, SIZE), shown, frame)
    pixel = frame.crop.to_original(camera.project(POINT)[0], SIZE)
    assert torch.allclose(pixel, whole.project(POINT)[0], atol=1e-9)
    before = frame.crop.to_original(expected.cropped_camera(whole, SIZE).project(POINT)[0], SIZE)
    assert float((before - pixel).norm()) > 0.1  # what it would be else
    nothing_missing = expected.cropped_camera(whole, SIZE)
    assert recropped(nothing_missing, clip, frame) is nothing_missing


def test_cameras_of_all_frames_agree_where_the_priors_filter_left_one_out() -> None:
    """Of a whole-frame camera that turns evenly, every moment is exact but for the turn within two frames."""
    clip, even = film(), [0.01 * t for t in range(10)]
    whole = a_prior(even, [-angle for angle in even])
    rows = [row for row in range(10) if row != LEFT_OUT]
    prior = in_crops(whole, clip)
    prior = replace(
        prior, times=prior.times[rows], cameras=tuple(prior.cameras[row] for row in rows),
        cameras_flip=tuple(prior.cameras_flip[row] for row in rows), object_to_world=prior.object_to_world[rows],
        transforms=prior.transforms[rows], transforms_flip=prior.transforms_flip[rows],
    )  # fmt: skip
    shown = with_cameras(known_frames(clip, prior), prior)
    assert shown.guessed_cameras and not clip.guessed_cameras
    assert len(shown.frames) == 9 and shown.travel is not None and shown.travel[3].tolist() == [2, 2]

    def error(frame: Frame, camera: Camera | None) -> float:
        assert camera is not None and frame.crop is not None
        place = frame.crop.to_original(camera.project(POINT)[0], SIZE)
        return float((place - whole.cameras[round(frame.time * 24)].project(POINT)[0]).norm())

    for frame in with_cameras(clip, prior).frames:
        assert error(frame, frame.camera) < 0.02
    dropped = clip.frames[LEFT_OUT]
    assert error(dropped, world_camera(prior, dropped.time)) > 0.1
    placed, truth = add_cameras(Known(shown), clip, Truth((dropped, clip.frames[7]), None, ""), shown)
    assert all(error(frame, frame.camera) < 0.02 for frame in (*placed.frames, *truth.held_out))
    assert [len(part) for part in (truth.held_out, truth.held_out[:1])] == [2, 1]
    nobody = add_cameras(Known(clip), clip, Truth((dropped,), None, ""), shown)
    assert nobody[0].frames == clip.frames and nobody[1].held_out[0] is dropped


def test_a_record_knows_what_its_method_was_not_shown() -> None:
    clip = film()
    shown = without(clip, LEFT_OUT)
    said = provenance.left_out(clip, shown)
    assert said == {"left_out": [LEFT_OUT]} and provenance.shown_clip(clip, said).times == shown.times
    assert provenance.left_out(clip, clip) == provenance.left_out(clip, None) == {}
    assert provenance.shown_clip(clip, {}) is clip
    assert math.isclose(clip.only([0, 9]).times[1], 9 / 24)


def test_a_camera_between_two_crops_is_that_of_the_square_between_them() -> None:
    """A square that grows by a half and moves by its side, for one camera of the whole frame."""
    whole = a_prior([0.4], [-0.4]).cameras[0]
    first, last = Crop(2.0, 4.0, 40.0, 64, 64), Crop(42.0, 14.0, 60.0, 64, 64)
    ends = [crop.cropped_camera(whole, SIZE) for crop in (first, last)]
    for part in (0.25, 0.5):
        square = Crop(2.0 + 40 * part, 4.0 + 10 * part, 40.0 + 20 * part, 64, 64)
        found = camera_between(ends, part)
        assert found is not None
        torch.testing.assert_close(found.intrinsics, square.cropped_camera(whole, SIZE).intrinsics, atol=1e-9, rtol=0)
