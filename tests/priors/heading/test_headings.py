"""Which way an animal heads: what the angle means, what the network learns from, and how a fit follows it."""

import math
from dataclasses import replace

import msgspec
import numpy as np
import pytest
import torch
from torch import Tensor
from walking import shortened, silent, walking_clip, world

from rewild4d.errors import UserError
from rewild4d.priors.config import FOOTAGE
from rewild4d.priors.fit import fit_template
from rewild4d.priors.footage import fit_footage
from rewild4d.priors.heading.examples import FRAMES, SEQUENCES, drawn
from rewild4d.priors.heading.network import (
    SECTORS,
    HeadingNetwork,
    likeliest,
    log_shares,
    middles,
    shares_around,
    wrapped,
)
from rewild4d.priors.heading.pictures import from_bytes, ground_axes, said, to_bytes
from rewild4d.priors.heading.reading import Headings, read_headings
from rewild4d.priors.heading.weights import package_weights
from rewild4d.priors.trained import Trained

DEGREES = 2 * math.pi / 360
UP = torch.tensor((0.0, 1.0, 0.0), dtype=torch.float64)


class Sure(HeadingNetwork):
    """A network that says one heading of every picture whose left half is the brighter, and else its mirror image."""

    def __init__(self, azimuth: float) -> None:
        super().__init__()
        self.azimuth = azimuth

    def forward(self, pictures: Tensor, cameras: Tensor) -> Tensor:
        left, right = (half.sum((1, 2, 3)) for half in pictures[:, :1].split(24, dim=-1))
        return shares_around(torch.where(left > right, self.azimuth, -self.azimuth)).log()


def test_a_heading_counts_from_the_direction_of_view_to_the_left() -> None:
    level = torch.tensor(((0.0, -1.0, 0.0),))  # a camera's y points down
    left, away = ground_axes(level)
    assert torch.allclose(left, torch.tensor((-1.0, 0.0, 0.0))) and torch.allclose(away, torch.tensor((0.0, 0.0, 1.0)))
    down = torch.tensor(((0.0, -math.cos(0.5), -math.sin(0.5)),))  # it looks down by half a radian
    assert torch.allclose(ground_axes(down)[1], torch.tensor((0.0, -math.sin(0.5), math.cos(0.5))), atol=1e-6)
    assert said(down, torch.tensor([True])).tolist() == [[pytest.approx(math.sin(0.5)), 1.0]]
    assert said(down, torch.tensor([False])).tolist() == [[0.0, 0.0]]


def test_shares_lie_around_the_heading_across_the_end_of_the_circle() -> None:
    azimuths = torch.tensor((-3.1, -1.0, 0.0, 0.4, 3.1))
    shares = shares_around(azimuths)
    assert torch.allclose(shares.sum(1), torch.ones(5))
    assert wrapped(likeliest(shares.log()) - azimuths).abs().max() < 1 * DEGREES
    assert torch.allclose(shares_around(-azimuths), shares.flip(1), atol=1e-6)


def test_a_picture_and_its_mirror_image_are_read_alike() -> None:
    torch.manual_seed(0)
    network, pictures, cameras = HeadingNetwork().eval(), torch.rand(3, 2, 48, 48), torch.rand(3, 2)
    direct, flipped = log_shares(network, pictures, cameras), log_shares(network, pictures.flip(-1), cameras)
    assert torch.allclose(direct, flipped.flip(1), atol=1e-6)


def test_random_animals_are_drawn_with_their_headings() -> None:
    made = drawn(np.random.default_rng(3))
    assert made.shown.shape == (SEQUENCES * FRAMES, 2, 48, 48) and made.shown.dtype == torch.uint8
    rows = torch.arange(len(made)) % 2 == 0
    mirrored = made.mirrored(rows)
    assert torch.equal(mirrored.azimuths, torch.where(rows, -made.azimuths, made.azimuths))
    assert torch.equal(mirrored.shown[0], made.shown[0].flip(-1)) and torch.equal(mirrored.shown[1], made.shown[1])
    back = from_bytes(made.shown)
    assert torch.equal(to_bytes(back), made.shown)
    assert back[:, 0].min() >= 0 and back[:, 0].max() <= 1
    # Seen from ahead or from behind an animal is narrower than from a side, in pictures that are as wide as it is long.
    solid = (back[:, 0] > 0.5).double().mean((1, 2))
    aside = made.azimuths.sin().abs()
    assert solid[aside < 0.4].mean() < solid[aside > 0.9].mean() or (aside < 0.4).sum() < 3


def test_animals_on_two_legs_are_drawn_where_a_share_is_asked_for() -> None:
    four, two = drawn(np.random.default_rng(3)), drawn(np.random.default_rng(3), two_legged=1.0)
    assert two.shown.shape == four.shown.shape and not torch.equal(two.shown, four.shown)
    assert torch.equal(four.shown, drawn(np.random.default_rng(3), two_legged=0.0).shown)
    assert two.azimuths.isfinite().all()


def test_stretched_animals_have_other_proportions() -> None:
    usual, stretched = drawn(np.random.default_rng(3)), drawn(np.random.default_rng(3), stretched=True)
    assert usual.shown.shape == stretched.shown.shape and not torch.equal(usual.shown, stretched.shown)
    assert torch.equal(stretched.shown, drawn(np.random.default_rng(3), stretched=True).shown)
    assert stretched.azimuths.isfinite().all()


@pytest.mark.parametrize("two_legged", [0.0, 1.0])
def test_the_network_of_the_package_reads_animals_that_it_did_not_learn_from(two_legged: float) -> None:
    shown = [drawn(np.random.default_rng((1, k)), two_legged) for k in range(4)]
    away = torch.cat(
        [
            wrapped(likeliest(log_shares(package_weights(), from_bytes(s.shown), s.cameras)) - s.azimuths).abs()
            for s in shown
        ]
    )
    assert away.median() < 10 * DEGREES and (away > 90 * DEGREES).double().mean() < 0.15


def test_the_distance_is_in_nats_below_the_likeliest_heading() -> None:
    scores = torch.zeros(2, SECTORS)
    scores[:, 18], scores[:, 19] = -1.0, -3.0
    ahead = torch.tensor(((0.0, 0.0, 1.0), (0.0, 0.0, 1.0)))
    found = Headings(torch.tensor([0, 2]), torch.tensor(((-1.0, 0.0, 0.0),) * 2), ahead, scores)

    def at(azimuth: float) -> Tensor:
        return torch.tensor((-math.sin(azimuth), 0.0, math.cos(azimuth))).expand(1, 3, 3)

    middle, width = float(middles()[18]), 2 * math.pi / SECTORS
    assert float(found.distance(at(middle))) == pytest.approx(1.0)
    assert float(found.distance(at(middle + width))) == pytest.approx(3.0, abs=1e-5)
    assert float(found.distance(at(middle + 0.25 * width))) == pytest.approx(0.75 * 1 + 0.25 * 3, abs=1e-4)
    assert float(found.distance(at(math.pi))) == pytest.approx(0.0, abs=1e-6), "between the last sector and the first"
    turned = torch.eye(4, dtype=torch.float64)
    turned[:3, :3] = 2.5 * torch.tensor(((0, 0, 1.0), (0, 1, 0), (-1, 0, 0)))
    local = found.in_frame(turned)
    assert torch.allclose(local.away, torch.tensor((-1.0, 0.0, 0.0))), "the world's z is the frame's -x"


def test_frames_without_a_mask_are_left_out_and_a_clip_without_any_is_refused() -> None:
    clip = walking_clip(3, "fixed")
    up, network = world()[1], HeadingNetwork().eval()
    bare = replace(clip.frames[1], mask=torch.zeros_like(clip.frames[1].mask))
    found = read_headings([clip.frames[0], bare, clip.frames[2]], range(3), up, "case", network)
    assert found.timesteps.tolist() == [0, 2] and found.scores.shape == (2, SECTORS)
    assert float(found.scores.mean(0).max()) == pytest.approx(0.0, abs=1e-6)
    sure = read_headings(clip.frames, range(3), up, "case", Sure(float(middles()[20])).eval())
    assert 2.5 < float(sure.scores.mean(0).max() - sure.scores.mean(0).min()) < 3.0, "as sure as it learns to be"
    assert torch.allclose(found.left @ up.float(), torch.zeros(2), atol=1e-5)
    with pytest.raises(UserError, match="case: expected at least one mask that shows the animal, but all 1 are empty"):
        read_headings([bare], range(1), up, "case", network)


def test_under_one_camera_the_template_turns_to_the_heading_that_is_read() -> None:
    clip, up = walking_clip(2, "fixed"), world()[1]
    config = msgspec.structs.replace(shortened(12, yaw_starts=6), heading_weight=1.0)
    camera = clip.frames[0].camera
    assert camera is not None
    view = camera.world_to_camera[:3, :3].double()
    left, away = (axis[0] for axis in ground_axes((view @ up)[None]))
    for azimuth in (0.6, -2.0):
        network = Sure(azimuth).eval()
        said_of_it = float(likeliest(read_headings(clip.frames, range(2), up, "case", network).scores.mean(0)[None]))
        assert abs(said_of_it) == pytest.approx(abs(azimuth), abs=2 * DEGREES)
        made = fit_template(clip, config=config, seed=0, log=silent, trained=Trained(headings=network))
        ahead = view @ made.object_to_world[0, :3, 2]
        turned = torch.atan2(ahead @ left, ahead @ away)
        assert abs(wrapped(turned - said_of_it)) < 10 * DEGREES
        assert "and to headings that a network reads" in made.provenance


def test_in_a_film_both_halves_turn_to_the_heading_that_is_read_and_the_network_is_told_no_cameras() -> None:
    clip, told = walking_clip(2, "fixed"), list[Tensor]()
    film = replace(clip, frames=tuple(replace(frame, camera=None) for frame in clip.frames))
    stages = tuple(msgspec.structs.replace(stage, steps=25, frames=2, size=32) for stage in FOOTAGE.stages[:2])
    config = msgspec.structs.replace(FOOTAGE, stages=stages, yaw_starts=6, view_weight=0.0, heading_weight=1.0)
    azimuth = -2.2
    network = Sure(azimuth).eval()
    network.register_forward_pre_hook(lambda _, inputs: told.append(inputs[1]))
    made = fit_footage(film, config=config, seed=0, log=silent, trained=Trained(headings=network))
    assert "and to headings that a network reads" in made.provenance
    assert made.cameras_flip is not None
    ahead, flipped = (
        [camera.world_to_camera[:3, 2] for camera in half] for half in (made.cameras, made.cameras_flip)
    )  # the object heads along its z axis
    side = math.copysign(1.0, -float(ahead[0][0]) * azimuth)  # whether the network sees it or its mirror image
    for half, sign in ((ahead, side), (flipped, -side)):
        for axis in half:
            assert abs(wrapped(torch.atan2(-axis[0], axis[2]) - sign * azimuth)) < 12 * DEGREES
    assert len(told) == 4 and not any(cameras.any() for cameras in told)


def test_where_cameras_see_several_sides_headings_are_not_followed() -> None:
    clip, config = walking_clip(3, "sweep"), shortened(1)
    plain, read = (
        fit_template(clip, config=config, seed=0, log=silent, trained=Trained(headings=network))
        for network in (None, Sure(1.0))
    )
    assert torch.equal(plain.transforms, read.transforms) and "headings" not in read.provenance
