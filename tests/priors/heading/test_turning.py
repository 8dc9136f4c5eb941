"""How an animal turns: the path through what a network reads, and guesses that turn along it."""

import math
from dataclasses import replace

import msgspec
import numpy as np
import pytest
import torch
from torch import Tensor
from walking import shortened, silent, walking_clip

from rewild4d.priors import fit, footage
from rewild4d.priors.bodies.quadruped import QUADRUPED
from rewild4d.priors.config import FOOTAGE
from rewild4d.priors.heading.network import SECTORS, HeadingNetwork, shares_around
from rewild4d.priors.heading.reading import Headings
from rewild4d.priors.heading.turning import PACE, along, turning
from rewild4d.priors.hypotheses import Hypotheses
from rewild4d.priors.search import facings
from rewild4d.priors.trained import Trained
from rewild4d.priors.views import Views

DEGREES = math.pi / 180
LEAST = 40 * DEGREES


def read(angles: Tensor, times: list[int] | None = None, yaw: float = 0.0) -> Headings:
    """Return sure readings of headings about y, from z to x, by cameras that look along z turned by ``yaw``."""
    count = len(angles)
    away = torch.tensor((math.sin(yaw), 0.0, math.cos(yaw))).expand(count, 3)
    left = torch.tensor((math.cos(yaw), 0.0, -math.sin(yaw))).expand(count, 3)  # as azimuths count: from away to left
    scores = (0.5 * shares_around(angles - yaw) + 0.5 / SECTORS).log()
    return Headings(torch.tensor(times or range(count)), left, away, scores - scores.mean(0).max())


@pytest.mark.parametrize("yaw", [0.0, 2.0])
def test_a_turn_by_a_right_angle_and_back_is_found_across_the_end_of_the_circle(yaw: float) -> None:
    turn = 45 * DEGREES * (1 - torch.cos(2 * math.pi * torch.arange(16) / 16))
    found = turning(read(turn + 2.6, yaw=yaw), 16, LEAST)
    assert (found - (turn - turn.mean())).abs().max() < 8 * DEGREES
    assert float(found.mean()) == pytest.approx(0.0, abs=1e-6)


def test_readings_that_waver_and_single_ones_of_the_other_end_are_no_turn() -> None:
    wavering = 15 * DEGREES * torch.sin(2.0 * torch.arange(16))
    assert torch.equal(turning(read(wavering), 16, LEAST), torch.zeros(16))
    assert float(turning(read(wavering), 16, 0.0).abs().max()) > 5 * DEGREES, "what the least turn leaves out"
    wrong = torch.where(torch.arange(16) == 7, math.pi, 0.0)
    assert torch.equal(turning(read(wrong), 16, LEAST), torch.zeros(16))


def test_times_without_a_reading_are_bridged_and_one_time_may_have_several() -> None:
    ramp = torch.linspace(0, 1.5, 12)
    kept = [0, 1, 2, 3, 4, 8, 9, 9, 10, 11]
    found = turning(read(ramp[kept], kept), 12, LEAST)
    assert (found - (ramp - ramp.mean())).abs().max() < 12 * DEGREES and (found.diff() >= 0).all()
    assert turning(read(ramp[:1]), 1, LEAST).tolist() == [0.0]


def test_an_animal_may_turn_farther_between_frames_that_are_farther_apart() -> None:
    """Half round within three frames, and on: at a narrow pace the way back, which no reading tells, is cheaper."""
    angles = torch.tensor([0.0] * 6 + [1.0, 2.1, 3.1] + [3.5, 4.5, 5.5] + [6.2] * 6)
    turned, held = (turning(read(angles), 18, LEAST, pace) for pace in (2.5 * PACE, PACE / 4))
    assert float(turned[-1] - turned[0]) == pytest.approx(2 * math.pi, abs=0.3)
    assert float(held[-1] - held[0]) == pytest.approx(0.0, abs=0.3)


def test_nats_of_an_animal_that_turns_count_from_its_likeliest_heading() -> None:
    turn = torch.linspace(-0.7, 0.7, 15)
    found = read(turn + 0.4)

    def at(angles: Tensor) -> float:
        heads = torch.stack((angles.sin(), torch.zeros(15), angles.cos()), dim=-1)
        return float(along(found, turn).distance(heads[None]))

    assert at(turn + 0.4) == pytest.approx(0.0, abs=0.05), "not negative: costs of bodies are compared by their ratio"
    assert at(turn + 0.4 + math.pi) == pytest.approx(at(turn - 1.2), abs=0.05) and at(turn - 1.2) > 2.5
    assert at(torch.full((15,), 0.4)) > 0.5
    assert along(found, torch.zeros(15)) is found


def test_guesses_head_as_far_from_their_facing_as_the_turn_says() -> None:
    guesses = Hypotheses.start(QUADRUPED, facings(4), torch.zeros(6, 3))
    guesses.turn = torch.linspace(-0.6, 0.6, 6)
    heads = guesses.roots()[..., :3, 2]
    angles = torch.atan2(heads[..., 0], heads[..., 2])
    assert np.allclose(np.unwrap(angles - angles[:, :1]), np.tile(guesses.turn + 0.6, (4, 1)), atol=1e-6)
    assert guesses.penalties()[3].tolist() == [0.0] * 4, "what is read costs nothing"
    assert torch.equal(guesses.select(torch.tensor([2])).roots(), guesses.roots()[2:3])


@pytest.mark.parametrize("cameras", ["fixed", "sweep"])
def test_the_fit_starts_from_the_turn_and_its_record_has_it(cameras: str, monkeypatch: pytest.MonkeyPatch) -> None:
    told = torch.linspace(-0.8, 0.8, 6)
    monkeypatch.setattr(fit, "turning", lambda found, count, least: told if least == LEAST else torch.zeros(count))
    network = Trained(headings=HeadingNetwork().eval())
    made = fit.fit_template(walking_clip(6, cameras), config=shortened(1), seed=0, log=silent, trained=network)
    first, last = made.object_to_world[[0, -1], :3, 2]
    between = math.acos(float(first @ last / first.norm() / last.norm()))
    assert between == pytest.approx(1.6, abs=0.2)
    assert made.quality["turn"] == pytest.approx(math.degrees(1.6), abs=0.1)
    assert ("turning as a network reads" in made.provenance) == (cameras == "sweep")


def test_guesses_under_unknown_cameras_turn_too_and_their_reflections_the_other_way() -> None:
    turn = turning(read(1.2 * torch.tanh((torch.arange(24) - 12) / 3.0)), 24, LEAST)
    guesses = Views.start(QUADRUPED, facings(4), torch.zeros(24, 3)).turned(turn)
    for found, wanted in ((guesses, turn), (guesses.with_depth_mirrored().select(torch.arange(4, 8)), -turn)):
        heads = found.roots()[..., :3, 2]
        angles = np.unwrap(torch.atan2(heads[..., 0], heads[..., 2]))
        assert np.allclose(angles - angles[:, :1], np.tile(wanted - wanted[0], (4, 1)), atol=8 * DEGREES)
    assert torch.equal(guesses.turned(torch.zeros(24)).rotation, guesses.rotation)


def test_of_an_animal_that_turns_in_a_film_readings_count_for_more(monkeypatch: pytest.MonkeyPatch) -> None:
    clip = walking_clip(6, "fixed")
    film = tuple(replace(frame, camera=None) for frame in clip.frames)
    costs = []
    for told in (torch.zeros(6), torch.linspace(-0.8, 0.8, 6)):
        monkeypatch.setattr(footage, "turning", lambda *_, told=told: told)
        race = footage._race(
            "film", film, footage.NOTHING, msgspec.structs.replace(FOOTAGE, view_weight=0.0, carriage_weight=0.0), 0,
            footage.Steps(silent, 1), QUADRUPED, Trained(headings=HeadingNetwork().eval()),
        )  # fmt: skip
        assert race.headings is not None
        nats = race.headings.distance(race.guesses.roots()[..., :3, 2])
        costs.append(race.evidence() / nats)
    assert torch.allclose(costs[0], torch.tensor(0.03)) and torch.allclose(costs[1], torch.tensor(0.06))


def test_an_animal_that_turns_in_a_film_is_followed(monkeypatch: pytest.MonkeyPatch) -> None:
    told = torch.linspace(-0.8, 0.8, 6)

    def said(found: Headings, count: int, least: float, pace: float) -> Tensor:
        assert count == 6 and pace == pytest.approx(2 * PACE), "twelve frames a second"
        return told if least == LEAST else torch.zeros(count)

    monkeypatch.setattr(footage, "turning", said)
    clip = walking_clip(6, "fixed")
    film = replace(clip, frames=tuple(replace(frame, camera=None, time=t / 12) for t, frame in enumerate(clip.frames)))
    stages = tuple(msgspec.structs.replace(stage, steps=1, frames=6, size=24) for stage in FOOTAGE.stages[:2])
    config, network = msgspec.structs.replace(FOOTAGE, stages=stages, yaw_starts=4), HeadingNetwork().eval()
    made = footage.fit_footage(film, config=config, seed=0, log=silent, trained=Trained(headings=network))
    first, last = (made.cameras[row].world_to_camera[:3, 2] for row in (0, -1))
    assert math.acos(float(first @ last)) == pytest.approx(1.6, abs=0.25)
    assert made.quality["turn"] == pytest.approx(math.degrees(1.6), abs=0.1)
