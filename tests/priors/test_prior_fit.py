"""The fit finds a known animal again, in a world that is turned, scaled and shifted at random."""

import math
from dataclasses import replace

import pytest
import torch
from torch import Tensor
from walking import QUICK, WORLD_SCALE, shortened, silent, walking_clip, world

from rewild4d.errors import UserError
from rewild4d.priors.bodies.quadruped import QUADRUPED
from rewild4d.priors.fit import fit_template
from rewild4d.priors.hypotheses import Hypotheses, cosine_series
from rewild4d.priors.overlay import overlay
from rewild4d.priors.search import mask_rays, single_view, trajectory, up_directions
from rewild4d.priors.silhouettes import outline, rasterized, splat
from rewild4d.transforms import look_at
from rewild4d.types import Camera

pytestmark = pytest.mark.usefixtures("one_thread")


def angle(a: Tensor, b: Tensor) -> float:
    cosine = torch.nn.functional.cosine_similarity(a, b, dim=0).clamp(-1, 1)
    return float(torch.rad2deg(torch.arccos(cosine)))


def test_a_spine_is_bent_sideways_by_its_mean_yaw_and_roll_alone() -> None:
    guesses = Hypotheses.start(QUADRUPED, torch.eye(3).repeat(2, 1, 1), torch.zeros(6, 3))
    guesses.angles[1, 0, 2, 1] = 4.0  # the neck's yaw, of 8 bones with yaw and roll
    guesses.angles[:, 1:, 2, 1] = 5.0  # swings to and fro
    guesses.angles[:, :, 2, 0] = 6.0  # nods
    guesses.angles[:, :, 10, 1] = 7.0  # a leg
    assert guesses.sideways().tolist() == [0.0, 4.0**2 / 16]


def test_a_known_animal_is_found_again() -> None:
    clip = walking_clip(8, "sweep")
    prior = fit_template(clip, config=shortened(25, yaw_starts=8), seed=0, log=silent)
    truth, up = world()
    found = prior.object_to_world[:, :3, :3].mean(0)
    assert angle(found[:, 2], truth[:3, 2]) < 10 and angle(found[:, 1], up) < 10
    assert prior.quality["mask_iou"] > 0.8 and prior.quality["facing_margin"] > 0
    assert prior.quality["starts"] == 8 and {f"start_{k:02d}_cost" for k in range(8)} < prior.quality.keys()
    assert float(found[:, 1].norm()) == pytest.approx(WORLD_SCALE, rel=0.1)
    extent = prior.vertices.amax(0) - prior.vertices.amin(0)
    assert float(extent.norm()) == pytest.approx(5.0, abs=1e-4)
    assert overlay(clip, prior, [0, 5]).shape == (2, 3, 96, 128)


def test_the_same_seed_gives_the_same_prior() -> None:
    clip = walking_clip(4, "sweep")
    first, second = (fit_template(clip, config=shortened(2), seed=5, log=silent) for _ in range(2))
    assert first.digest == second.digest
    assert first.object_to_world.shape == (4, 4, 4) and len(first.cameras_flip) == 4


def test_progress_counts_up_to_its_total() -> None:
    seen: list[tuple[int, int]] = []

    def log(step: int, total: int, _: object) -> None:
        seen.append((step, total))

    fit_template(walking_clip(3, "sweep"), config=shortened(1), seed=0, log=log)
    assert seen == [(step, len(QUICK.stages)) for step in range(1, len(QUICK.stages) + 1)]


def test_an_empty_mask_is_bridged_and_only_empty_masks_are_an_error() -> None:
    clip = walking_clip(4, "sweep")
    empty = [replace(frame, mask=torch.zeros_like(frame.mask)) for frame in clip.frames]
    bridged = replace(clip, frames=(*clip.frames[:2], empty[2], clip.frames[3]))
    assert torch.isfinite(fit_template(bridged, config=shortened(1), seed=0, log=silent).transforms).all()
    with pytest.raises(UserError, match="made/walk: expected at least one mask that shows the animal, but all 4"):
        fit_template(replace(clip, frames=tuple(empty)), config=shortened(1), seed=0, log=silent)


def test_a_frame_without_a_camera_is_one_sentence() -> None:
    clip = walking_clip(3, "sweep")
    blind = replace(clip, frames=(*clip.frames[:2], replace(clip.frames[2], camera=None)))
    with pytest.raises(UserError, match="expected a camera for every frame, but the frame at 0.083"):
        fit_template(blind, config=shortened(1), seed=0, log=silent)


def test_up_is_square_to_all_cameras_and_the_path_passes_the_animal() -> None:
    clip = walking_clip(12, "sweep")
    truth, up = world()
    rays = mask_rays(clip.frames, list(range(12)), clip.name)
    (found,) = up_directions(rays, (20.0,))
    assert angle(found, up) < 0.1
    path = trajectory(rays, 12)
    assert float((path - truth[:3, 3]).norm(dim=1).max()) < 0.5 * WORLD_SCALE


def test_one_camera_that_does_not_move_leaves_several_ups_and_a_finite_path() -> None:
    clip = walking_clip(4, "fixed")
    rays = mask_rays(clip.frames, list(range(4)), clip.name)
    ups = up_directions(rays, (5.0, 20.0, 40.0))
    elevation = math.degrees(math.atan2(2.5, 9))
    assert len(ups) == 3 and min(angle(found, world()[1]) for found in ups) < abs(20 - elevation) + 1
    assert torch.isfinite(trajectory(rays, 4)).all()


def test_a_camera_that_does_not_look_at_the_origin_sees_the_animal_as_far_away_as_the_origin() -> None:
    clip = walking_clip(4, "fixed")
    rays = mask_rays(clip.frames, list(range(4)), clip.name)
    sight, aside = rays.directions.mean(0), rays.downs.mean(0)
    for start, depth in ((-3 * sight, 3.0), (-0.1 * sight - 2 * aside, 0.01**0.5 * 401**0.5), (2 * sight, 2.0)):
        moved = replace(rays, centers=start.expand(4, 3))
        path = trajectory(moved, 4)
        assert float(((path - start) @ sight).mean()) == pytest.approx(depth, rel=0.02)


def test_only_a_single_direction_of_view_is_a_gaze_and_it_is_told_in_the_working_frame() -> None:
    truth = world()[0]
    still, ring = (mask_rays(walking_clip(4, kind).frames, list(range(4)), "") for kind in ("fixed", "sweep"))
    assert single_view(ring, truth) is None
    gaze = single_view(still, truth)
    # the camera stands at (9 sin 0.8, 2.5, 9 cos 0.8) in the animal's frame and looks at its middle
    inward = -torch.tensor((9 * math.sin(0.8), 2.5, 9 * math.cos(0.8)))
    assert gaze is not None and float(gaze.norm()) == pytest.approx(1.0, abs=1e-5) and angle(gaze, inward) < 5


def test_heading_is_free_but_leaning_and_turning_over_time_cost() -> None:
    guesses = Hypotheses.start(QUADRUPED, torch.eye(3).expand(3, 3, 3), torch.zeros(8, 3))
    guesses.rotation[0, 0, 1] = guesses.rotation[1, 0, 0] = guesses.rotation[2, 1, 1] = 1.0
    assert guesses.penalties()[3].tolist() == pytest.approx([0.0, 1.0, 1.0])
    turned = torch.tensor((math.sin(0.35), 0.0, math.cos(0.35)))
    assert torch.allclose(guesses.heading()[0], turned, atol=1e-5)


def test_one_blob_is_a_round_gaussian_of_its_projected_size() -> None:
    intrinsics = torch.tensor(((50.0, 0.0, 16.0), (0.0, 50.0, 16.0), (0.0, 0.0, 1.0)))
    image = splat(torch.tensor(((0.0, 0.0, 5.0),)), torch.tensor((0.3,)), intrinsics, 32)
    density = -torch.log1p(-image)
    sigma2 = (0.3 * 50 / 5) ** 2 + 0.3
    assert float(density[15, 20] / density[15, 15]) == pytest.approx(
        math.exp(-(4.5**2 - 0.5**2) / 2 / sigma2), rel=1e-3
    )
    assert torch.allclose(image, image.T, atol=1e-6)


@pytest.mark.parametrize("size", [64, 128])
def test_flat_gaussians_on_the_surface_have_its_outline(size: int) -> None:
    template = QUADRUPED.build()
    eye = torch.tensor((5.0, 3.0, 6.0), dtype=torch.float64)
    focal, half = 1.35 * size, size / 2
    intrinsics = torch.tensor(((focal, 0, half), (0, focal, half), (0, 0, 1)), dtype=torch.float64)
    camera = Camera(look_at(eye, 0 * eye, torch.tensor((0.0, 1.0, 0.0)).double()), intrinsics, size, size)
    matrix = camera.world_to_camera.float()
    vertices = (template.vertices @ matrix[:3, :3].T + matrix[:3, 3])[None, None].requires_grad_()
    _, matte = rasterized(vertices, template.quads, intrinsics.float()[None], size)
    assert matte.shape == (1, 1, size, size)
    drawn, wanted = matte[0, 0] > 0.5, torch.from_numpy(outline(template.vertices, template.faces, camera)) > 127
    assert float((drawn & wanted).sum() / (drawn | wanted).sum()) > 0.93
    matte.sum().backward()
    assert vertices.grad is not None and bool(torch.isfinite(vertices.grad).all()) and float(vertices.grad.norm()) > 0


def test_cosines_start_with_a_constant_and_damp_fast_motion() -> None:
    series = cosine_series(16, 8)
    assert torch.equal(series[:, 0], torch.ones(16))
    peaks = series.abs().amax(0)
    assert bool((peaks.diff() < 0).all()) and float(peaks[4]) == pytest.approx(math.cos(math.pi / 8) / 2)


def test_legs_that_swing_backwards_on_the_ground_are_a_gait_and_time_reversed_they_are_none() -> None:
    guesses = Hypotheses.start(QUADRUPED, torch.eye(3).expand(2, 3, 3), torch.zeros(16, 3))
    # the series' second term falls over time; a positive angle about x takes a hanging foot backwards
    guesses.angles[:, 1, [10, 13, 16, 19], 0] = torch.tensor((-1.0, 1.0))[:, None]
    forwards, backwards = guesses.backward_gait().tolist()
    assert forwards < -0.5 and backwards == pytest.approx(-forwards, abs=1e-5)
    still = Hypotheses.start(QUADRUPED, torch.eye(3)[None], torch.zeros(16, 3))
    assert float(still.backward_gait()) == pytest.approx(0.0, abs=1e-6)
