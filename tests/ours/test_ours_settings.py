"""The settings that a preset gives: by the length of the clip, and by whether its cameras are known."""

import math
from dataclasses import replace

import msgspec
import pytest
import torch
from toys import TINY

from rewild4d.config import load_preset
from rewild4d.ours.config import Config
from rewild4d.ours.evidence import sees_one_side
from rewild4d.ours.method import Ours
from rewild4d.ours.schedule import for_clip_of_ours
from rewild4d.priors.kinematics import rotation_about
from rewild4d.transforms import camera_in_object
from rewild4d.types import Clip, Prior

CPU = torch.device("cpu")


def test_settings_follow_the_length_of_the_clip() -> None:
    standard, paper = (load_preset("ours", Config, name) for name in ("standard", "paper"))

    def octaves(frames: int) -> int:
        return for_clip_of_ours(standard, frames).pose.frequencies

    assert [octaves(frames) for frames in (2, 24, 48, 2 * 48, 72)] == [4, 4, 4 + 1, 4 + 2, 4 + 2]
    fixed = msgspec.structs.replace(standard, pose=msgspec.structs.replace(standard.pose, octave_frames=0))
    assert for_clip_of_ours(fixed, 96).pose.frequencies == 4
    assert for_clip_of_ours(standard, 12).iterations == standard.iterations
    assert [for_clip_of_ours(paper, frames).iterations for frames in (12, 15, 16)] == [10_000, 10_000, 20_000]
    # A saved fit holds plain numbers: it is the same again whatever the clip that it is read beside.
    made = for_clip_of_ours(paper, 12)
    assert for_clip_of_ours(made, 300) == made


def test_what_is_beyond_the_paper_differs_from_standard_in_these_alone() -> None:
    standard, beyond = (load_preset("ours", Config, name) for name in ("standard", "beyond"))
    own = msgspec.structs.replace
    assert beyond == own(
        standard,
        pose=own(standard.pose, turns=True),
        geometry=own(standard.geometry, limb_plane=100.0, sideways=1000.0, temporal=0.2, still=0.0),
        loss=own(standard.loss, isolated=False),
        prior=own(standard.prior, pull_turn=0.07),
        rates=own(standard.rates, deform=(2e-3, 1e-5)),
        density=own(standard.density, cap=14_000, end=0.9),
        one_side=own(standard.one_side, when="known"),
        footage=own(standard.footage, turns=True, turns_rate=4e-4, search_limbs=0.12, steps_per_frame=125),
    )
    assert standard.loss.isolated and standard.geometry.limb_plane == standard.geometry.sideways == 0


def test_where_one_side_is_seen_beyond_keeps_what_the_prior_knows_of_the_others() -> None:
    beyond = for_clip_of_ours(load_preset("ours", Config, "beyond"), 24)
    held = for_clip_of_ours(load_preset("ours", Config, "beyond"), 24, one_sided=True)
    changed = {name for name in beyond.__struct_fields__ if getattr(beyond, name) != getattr(held, name)}
    assert changed == {"canonical", "skin", "pose", "prior", "rates", "density", "geometry", "one_side"}
    assert (held.canonical.samples, held.density.cap, held.geometry.temporal) == (12_000, 16_000, 5.0)
    assert (beyond.canonical.max_scale, held.canonical.max_scale) == (0.05, 0.009)
    assert held.skin.holds and held.prior.untold and not beyond.skin.holds and not beyond.prior.untold
    assert beyond.pose.turns and not held.pose.turns, "one side does not tell turns"
    assert for_clip_of_ours(held, 300, one_sided=True).skin == held.skin, "a saved fit stays as it is"


def test_films_keep_it_only_where_it_is_asked_for_and_the_paper_never_does() -> None:
    beyond, standard = (load_preset("ours", Config, name) for name in ("beyond", "standard"))
    always = msgspec.structs.replace(beyond, one_side=msgspec.structs.replace(beyond.one_side, when="always"))
    assert not for_clip_of_ours(beyond, 24, filmed=True, one_sided=True).skin.holds
    film = for_clip_of_ours(always, 24, filmed=True, one_sided=True)
    assert film.skin.holds and film.prior.pull_until == film.footage.pull_until and film.iterations == 24 * 125
    assert for_clip_of_ours(standard, 24, one_sided=True) == for_clip_of_ours(standard, 24)


@pytest.mark.parametrize(("degrees", "one_sided"), [(0.0, True), (75.0, True), (85.0, False), (360.0, False)])
def test_one_side_is_within_forty_degrees_of_the_mean(toy: tuple[Clip, Prior], degrees: float, one_sided: bool) -> None:
    _, prior = toy
    cameras = []
    for angle in torch.linspace(0, math.radians(degrees), 7).double():
        turned = torch.eye(4, dtype=torch.float64)
        turned[:3, :3] = rotation_about(1, angle[None])[0]
        cameras.append(camera_in_object(prior.cameras[0], turned))
    assert sees_one_side(replace(prior, cameras=tuple(cameras))) == one_sided


def test_in_films_beyond_turns_joints_of_each_frame_and_searches_limbs() -> None:
    known, film = (
        for_clip_of_ours(load_preset("ours", Config, "beyond"), 24, filmed=filmed) for filmed in (False, True)
    )
    assert (known.rates.turns, known.pose.search_limbs) == (1e-4, 0)
    assert film.pose.turns and (film.rates.turns, film.pose.search_limbs, film.iterations) == (4e-4, 0.12, 3000)
    assert for_clip_of_ours(film, 24, filmed=True) == film
    assert for_clip_of_ours(load_preset("ours", Config, "beyond"), 90, filmed=True).iterations == 90 * 125
    plain = for_clip_of_ours(load_preset("ours", Config, "standard"), 24, filmed=True)
    assert not plain.pose.turns and not plain.pose.search_limbs


def test_settings_follow_whether_the_cameras_are_known() -> None:
    quick, standard, paper = (load_preset("ours", Config, name) for name in ("quick", "standard", "paper"))
    made = for_clip_of_ours(standard, 24, filmed=True)
    assert (made.geometry.temporal, made.geometry.rigid) == (5.0, 0.2)
    assert (made.rates.pose, made.rates.deform, made.prior.pull_until) == ((7e-4, 1e-5), (2e-3, 1e-5), 0.35)
    assert made.iterations == 24 * 250
    assert made.geometry.still == standard.geometry.still
    assert for_clip_of_ours(made, 24, filmed=True) == made
    assert for_clip_of_ours(quick, 24, filmed=True) == for_clip_of_ours(quick, 24)
    known, film = (for_clip_of_ours(paper, 24, filmed=filmed) for filmed in (False, True))
    assert (known.prior.blend, known.prior.pull) == (False, 0.0), "the paper: both off on Artemis"
    assert film.prior == msgspec.structs.replace(known.prior, blend=True, pull=1.0, pull_until=0.2)
    assert (film.prior.blend_until, film.prior.pull_until) == (7_000 / 20_000, 4_000 / 20_000)
    rest = {"prior": known.prior, "footage": known.footage}
    assert msgspec.structs.replace(film, **rest) == known, "and nothing else differs"


def test_a_short_run_of_the_paper_ends_its_stages_at_the_same_steps() -> None:
    short = for_clip_of_ours(load_preset("ours", Config, "paper"), 12, filmed=True)
    ends = short.prior.blend_until, short.prior.pull_until, short.geometry.until
    assert [end * short.iterations for end in ends] == [7_000, 4_000, 10_000]


def test_own_cameras_change_nothing_where_cameras_are_known(toy: tuple[Clip, Prior]) -> None:
    """A prior of known cameras has exact mirror images for its flip cameras, so both groups show the same views."""
    clip, prior = toy
    pose = msgspec.structs.replace(TINY.pose, encoding="view")
    drawn = []
    for cameras in ("both", "own"):
        config = msgspec.structs.replace(TINY, pose=pose, cameras=cameras)
        made = Ours().fit(clip, prior, config=config, seed=0, device=CPU, log=lambda *_: None, workdir=None)
        drawn.append(made.at(clip.times[1]).means)
    assert torch.equal(*drawn)
