"""A known animal before a camera nobody knows is found again, and what people add to the masks is understood."""

import math
from dataclasses import replace

import msgspec
import pytest
import torch

from rewild4d.errors import UserError
from rewild4d.priors.bodies.quadruped import QUADRUPED
from rewild4d.priors.bodies.tetrapod import MIRROR, PARENTS
from rewild4d.priors.config import FOOTAGE, PriorConfig
from rewild4d.priors.footage import Evidence, fit_footage
from rewild4d.priors.judge import joint_scores
from rewild4d.priors.kinematics import pose
from rewild4d.priors.landmarks import LANDMARKS, Marks, landmark_pixels, load_mapping, mapping_names, marks
from rewild4d.priors.motion import camera_at
from rewild4d.priors.overlay import save_overlay
from rewild4d.priors.placing import in_crops, resized, with_cameras
from rewild4d.priors.silhouettes import outline
from rewild4d.priors.views import DISTANCE, ELEVATION, ELEVATION_SPREAD, WINDOW, Views, fauna_camera, windows
from rewild4d.transforms import axis_angle_to_matrix, look_at, skin_points
from rewild4d.types import Camera, Clip, Crop, Frame, Keypoints, Prior

pytestmark = pytest.mark.usefixtures("one_thread")

AZIMUTH = 115.0
"""Of the first true camera, degrees from the head towards the animal's left; it grows by four a frame."""


def shortened(steps: tuple[int, ...]) -> PriorConfig:
    stages = tuple(
        msgspec.structs.replace(stage, steps=count, frames=6)
        for stage, count in zip(FOOTAGE.stages, steps, strict=True)
    )
    return msgspec.structs.replace(FOOTAGE, stages=stages, yaw_starts=8)


@pytest.fixture(scope="module")
def walk() -> tuple[Clip, list[Camera], Marks]:
    """A walking template seen from its left, its true cameras in the object frame, and where its landmarks are."""
    template = QUADRUPED.build(QUADRUPED.proportions(neck_length=1.1, tail_length=0.7, body_length=2.0))
    frames, cameras, points, count = [], [], [], 6
    for t in range(count):
        angles, phase = torch.zeros(20, 3), 2 * math.pi * t / count
        for top, offset in ((10, 0.0), (13, math.pi), (16, 0.0), (19, math.pi)):
            angles[top, 0] = 0.4 * math.sin(phase + offset)
        transforms = pose(angles, template.bones[:, 0], PARENTS)
        turn = math.radians(AZIMUTH + 4 * t)
        eye = 14 * torch.tensor((math.sin(turn), 0.2, math.cos(turn)), dtype=torch.float64)
        intrinsics = torch.tensor(((180.0, 0.0, 60.0), (0.0, 180.0, 44.0), (0.0, 0.0, 1.0)), dtype=torch.float64)
        up = torch.tensor((0.0, 1.0, 0.0), dtype=torch.float64)
        camera = Camera(look_at(eye, torch.tensor((0.0, -0.5, 0.0)).double(), up), intrinsics, 120, 88)
        posed = skin_points(template.vertices, template.weights, transforms)
        mask = torch.from_numpy(outline(posed, template.faces, camera)).float()[None] / 255
        frames.append(Frame(t / 24, None, mask.expand(3, -1, -1), mask))
        cameras.append(camera)
        ends = torch.einsum("jab,jkb->jka", transforms[:, :3, :3], template.bones) + transforms[:, None, :3, 3]
        points.append(camera.project(ends.double())[0].float())
    rows = [(t, bone) for t in range(count) for bone in (0, 8, 11, 14, 17)]
    moments, bones = (torch.tensor(column) for column in zip(*rows, strict=True))
    pixels = torch.stack([points[t][bone, 1] for t, bone in rows])
    return (
        Clip("made/walk", "none", tuple(frames), 24.0, "CC0", ""),
        cameras,
        Marks(moments, bones, torch.ones(len(rows)), pixels),
    )


@pytest.fixture(scope="module")
def fitted(walk: tuple[Clip, list[Camera], Marks]) -> Prior:
    # the animal heads to the left and away, which is up in the image of a camera above it
    travel = torch.tensor((-6.0, -1.0)).expand(5, 2)
    return fit_footage(walk[0], config=shortened((12, 16, 12, 6)), seed=0, log=silent, said=Evidence(None, travel))


def silent(*_: object) -> None:
    return None


def azimuth(camera: Camera) -> float:
    return math.degrees(math.atan2(float(camera.center[0]), float(camera.center[2])))


def apart(a: float, b: float) -> float:
    return abs((a - b + 180) % 360 - 180)


def test_cameras_of_a_known_animal_are_found_again_for_both_sequences(walk, fitted) -> None:  # type: ignore[no-untyped-def]
    clip, cameras, found = walk
    errors = [apart(azimuth(a), azimuth(b)) for a, b in zip(fitted.cameras, cameras, strict=True)]
    assert max(errors) < 30
    mirrored = [apart(azimuth(a), -azimuth(b)) for a, b in zip(fitted.cameras_flip, cameras, strict=True)]
    assert max(mirrored) < 30
    assert fitted.quality["mask_iou"] > 0.72 and fitted.quality["mask_iou_flip"] > 0.72
    scores = joint_scores(fitted, clip.frames, found)
    assert fitted.provenance.endswith("cameras unknown, with the animal's travel, seed 0.")
    assert scores["facing"] == 1.0 and scores["facing_frames"] == 6 and scores["pck"] > 0.7


def test_the_object_frame_is_the_world_and_cameras_have_no_roll(walk, fitted) -> None:  # type: ignore[no-untyped-def]
    assert torch.equal(fitted.object_to_world, torch.eye(4, dtype=torch.float64).expand(6, 4, 4))
    for camera in fitted.cameras:
        rotation = camera.world_to_camera[:3, :3]
        assert float((rotation @ rotation.T - torch.eye(3)).abs().max()) < 1e-9
        assert abs(float(rotation[0, 1])) < 1e-5
    posed = with_cameras(walk[0], fitted)
    placed = posed.frames[3].camera
    assert placed is not None
    torch.testing.assert_close(placed.world_to_camera, fitted.cameras[3].world_to_camera)


def test_a_camera_between_two_frames_lies_between_theirs(fitted: Prior) -> None:
    assert torch.allclose(camera_at(fitted, 2 / 24).world_to_camera, fitted.cameras[2].world_to_camera)
    first, second = fitted.cameras[2].world_to_camera, fitted.cameras[3].world_to_camera
    between = camera_at(fitted, 2.25 / 24).world_to_camera
    assert torch.allclose(between[:3, 3], 0.75 * first[:3, 3] + 0.25 * second[:3, 3])
    assert camera_at(fitted, 9.0).intrinsics.equal(fitted.cameras[-1].intrinsics)


def test_a_prior_of_whole_frames_serves_crops_and_other_sizes(walk, fitted) -> None:  # type: ignore[no-untyped-def]
    clip, crop = walk[0], Crop(10.0, -4.0, 96.0, 120, 88)
    small = replace(clip, frames=tuple(replace(f, crop=crop, mask=torch.zeros(1, 64, 64)) for f in clip.frames))
    cropped, point = in_crops(fitted, small), torch.tensor((0.3, 0.1, -0.4), dtype=torch.float64)
    whole, part = fitted.cameras[1].project(point)[0], cropped.cameras[1].project(point)[0]
    assert torch.allclose(part, (whole - torch.tensor((10.0, -4.0))) * (64 / 96))
    flipped, part = fitted.cameras_flip[1].project(point)[0], cropped.cameras_flip[1].project(point)[0]
    # in the flipped image the crop is at 120 - 10 - 96 and shows the flipped crop
    assert torch.allclose(part, (flipped - torch.tensor((14.0, -4.0))) * (64 / 96))
    assert torch.allclose(
        resized(fitted, 240, 176).cameras[0].project(point)[0], 2 * fitted.cameras[0].project(point)[0]
    )
    with pytest.raises(UserError, match="expected crops of 120x88 frames .* got a whole frame"):
        in_crops(fitted, clip)


def test_an_overlay_is_a_picture_and_a_video(walk, fitted, tmp_path) -> None:  # type: ignore[no-untyped-def]
    files = save_overlay(walk[0], fitted, tmp_path / "prior.npz", side=64)
    assert [file.name for file in files] == ["prior.png", "prior.mp4"] and all(file.stat().st_size for file in files)


def test_keypoints_pull_a_guess_to_them(walk: tuple[Clip, list[Camera], Marks]) -> None:
    clip, _, found = walk
    # one step a round: what differs is the choice between starts, and joints say where the head is
    config = shortened((12, 6, 3, 1))
    prior = fit_footage(clip, config=config, seed=0, log=silent, said=Evidence(found))
    assert joint_scores(prior, clip.frames, found)["facing"] == 1.0


def test_only_empty_masks_are_one_sentence(walk: tuple[Clip, list[Camera], Marks]) -> None:
    clip = walk[0]
    empty = replace(clip, frames=tuple(replace(f, mask=torch.zeros_like(f.mask)) for f in clip.frames))
    with pytest.raises(UserError, match="made/walk: expected at least one mask that shows the animal, but all 6 are"):
        fit_footage(empty, config=shortened((1, 1, 1, 1)), seed=0, log=silent)


@pytest.mark.parametrize("count", [1, 2])
def test_very_short_clips_and_a_gap_are_fitted(walk: tuple[Clip, list[Camera], Marks], count: int) -> None:
    clip = walk[0]
    frames = clip.frames[:count]
    if count == 2:
        frames = (frames[0], replace(frames[1], mask=torch.zeros_like(frames[1].mask)), clip.frames[2])
    prior = fit_footage(replace(clip, frames=frames), config=shortened((1, 1, 1, 1)), seed=0, log=silent)
    assert len(prior.cameras) == len(frames) and torch.isfinite(prior.transforms).all()


def test_windows_follow_the_box_and_bridge_a_gap() -> None:
    masks = torch.zeros(5, 1, 40, 60)
    for t in range(5):
        masks[t, 0, 10:20, 10:30] = 1.0
    masks[2] = 0
    boxes = windows(tuple(Frame(t / 24, None, m.expand(3, -1, -1), m) for t, m in enumerate(masks)))
    assert torch.allclose(boxes, torch.tensor((20.0, 15.0, WINDOW * 20), dtype=torch.float64).expand(5, 3))
    camera = fauna_camera(boxes[0], 60, 40)
    half = DISTANCE * math.tan(math.radians(12.5))
    corner, depth = camera.project(torch.tensor((half, half, 0.0), dtype=torch.float64))
    assert corner.tolist() == pytest.approx([20 + WINDOW * 10, 15 - WINDOW * 10]) and float(depth) == DISTANCE


def test_marks_project_like_the_prior_that_a_guess_becomes(fitted: Prior) -> None:
    guess = Views.start(QUADRUPED, torch.eye(3)[None], torch.zeros(1, 3))
    bones = torch.tensor((0, 8, 4))
    found = Marks(torch.zeros(3, dtype=torch.long), bones, torch.tensor((1.0, 0.5, 0.0)), torch.zeros(3, 2))
    template = QUADRUPED.build(unit=False)
    rest = template.bones[bones, 0] + found.along[:, None] * (template.bones[bones, 1] - template.bones[bones, 0])
    turn = guess.roots()[0, 0]
    seen = rest @ turn[:3, :3].T
    wanted = torch.stack((seen[:, 0], -seen[:, 1]), -1) / (DISTANCE - seen[:, 2:])
    assert torch.allclose(guess.projected(found)[0], wanted, atol=1e-5)
    assert landmark_pixels(fitted, found).shape == (3, 2)


def test_a_guess_reflected_in_depth_has_the_same_outline_from_afar() -> None:
    generator = torch.Generator().manual_seed(0)
    guess = Views.start(QUADRUPED, axis_angle_to_matrix(torch.tensor(((0.0, 0.7, 0.0),))), torch.zeros(8, 3))
    guess.rotation = torch.randn(guess.rotation.shape, generator=generator) * torch.tensor((1.0, 0.0))
    guess.rotation[..., 0, 1] = -ELEVATION / ELEVATION_SPREAD  # eye level
    guess.angles = 0.5 * torch.randn(guess.angles.shape, generator=generator)
    both = guess.with_depth_mirrored()
    assert torch.allclose(both.heading()[0] * torch.tensor((1.0, 1.0, -1.0)), both.heading()[1], atol=1e-5)
    bones = torch.arange(20)
    for moment in (0, 5):
        here = torch.full((20,), moment)
        plain = both.projected(Marks(here, bones, torch.ones(20), torch.zeros(20, 2)))[0]
        swapped = both.projected(Marks(here, torch.tensor(MIRROR), torch.ones(20), torch.zeros(20, 2)))[1]
        # the same but for perspective: a depth of one unit in ten
        assert torch.allclose(plain, swapped, atol=0.06) and float((plain - swapped).abs().mean()) < 0.02


def test_a_folded_head_and_a_raised_tail_cost() -> None:
    guesses = Views.start(QUADRUPED, torch.eye(3).expand(3, 3, 3), torch.zeros(4, 3))
    guesses.angles[1, 0, 2, 0] = guesses.angles[1, 0, 1, 0] = -4.0  # about x backwards: over the back
    guesses.angles[2, 0, 6, 0] = guesses.angles[2, 0, 5, 0] = 4.0
    plain, folded, raised = guesses.carriage().tolist()
    assert plain == 0.0 and folded > 0.1 and raised > 0.01


def test_mappings_name_landmarks_and_mirrored_marks_swap_sides() -> None:
    assert mapping_names() == ["aptv2", "badja", "superanimal-quadruped"]
    for name in mapping_names():
        assert set(load_mapping(name).values()) <= set(LANDMARKS)
    points = Keypoints(("left_elbow", "right_hip", "nose", "tuft"), torch.tensor(((1.0, 2), (3, 4), (5, 6), (7, 8))),
                       torch.tensor((True, True, False, True)))  # fmt: skip
    found = marks([None, points], load_mapping("aptv2"))
    assert found.frames.tolist() == [1, 1] and found.bones.tolist() == [9, 16]
    flipped = found.mirrored(10)
    assert flipped.bones.tolist() == [MIRROR[9], MIRROR[16]] and flipped.pixels.tolist() == [[9, 2], [7, 4]]
    assert len(marks([None], load_mapping("badja"))) == 0
    with pytest.raises(UserError, match="badjo"):
        load_mapping("badjo")
