"""The template is fitted to masks and to what a network reads in them, under known and unknown cameras."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import msgspec
import pytest
import torch
from prior_files import ring

from rewild4d.priors import fit, footage
from rewild4d.priors.bodies.quadruped import QUADRUPED
from rewild4d.priors.config import FOOTAGE, PRESETS, PriorConfig, with_points
from rewild4d.priors.kinematics import moved
from rewild4d.priors.learned.evidence import indices
from rewild4d.priors.learned.network import PointNetwork
from rewild4d.priors.learned.points import NAMES, ROOT
from rewild4d.priors.learned.reading import Reading
from rewild4d.priors.silhouettes import outline
from rewild4d.priors.trained import Trained
from rewild4d.types import Clip, Frame, Prior

pytestmark = pytest.mark.usefixtures("one_thread")


def silent(*_: object) -> None:
    return None


def shortened(config: PriorConfig, steps: int) -> PriorConfig:
    stages = tuple(msgspec.structs.replace(stage, steps=steps, frames=4) for stage in config.stages)
    return msgspec.structs.replace(config, stages=stages, yaw_starts=4)


def standing_clip() -> Clip:
    """The average template at rest, seen by three cameras of a ring."""
    template, frames = QUADRUPED.build(), []
    for t, camera in enumerate(ring([0.3, 1.2, 2.3])):
        mask = torch.from_numpy(outline(template.vertices, template.faces, camera)).float()[None] / 255
        frames.append(Frame(t / 24, camera, mask.expand(3, -1, -1), mask))
    return Clip("made/stand", "none", tuple(frames), 24.0, "CC0", "")


def reversed_reading(clip: Clip, prior: Prior) -> Reading:
    """What a network would read if the animal of a prior stood the other way round, seen along each camera's axis."""
    bones, along = indices()
    start, end = prior.bones[bones].unbind(1)
    rest = (start + along[:, None] * (end - start)) * torch.tensor((-1.0, 1.0, -1.0))
    rows = []
    for t, frame in enumerate(clip.frames):
        assert frame.camera is not None
        matrix = (frame.camera.world_to_camera @ prior.object_to_world[t]).float()
        seen = moved(rest, matrix.expand(len(NAMES), 4, 4))
        depth, opening = seen[list(ROOT), 2].mean(), 0.4
        scaled = (seen - torch.stack((depth * 0, depth * 0, depth))) / (opening * depth)
        rows.append((frame.camera.world_to_camera[:3, :3].float(), frame.camera.center.float(), opening, scaled))
    rotations, centers, openings, points = zip(*rows, strict=True)
    return Reading(
        torch.arange(len(rows)), torch.stack(rotations), torch.stack(centers), torch.tensor(openings),
        torch.stack(points), torch.full((len(rows), len(NAMES), 2), 0.03),
    )  # fmt: skip


def test_points_that_say_so_turn_the_animal_round(monkeypatch: pytest.MonkeyPatch) -> None:
    clip, config = standing_clip(), shortened(PRESETS["quick"], 12)
    alone = fit.fit_template(clip, config=config, seed=0, log=silent)
    said = reversed_reading(clip, alone)
    asked: list[Any] = []

    def read(frames: Sequence[Frame], timesteps: Sequence[int], up: torch.Tensor, *_: object) -> Reading:
        asked.append((len(frames), list(timesteps), up))
        return said

    monkeypatch.setattr(fit, "read", read)
    strong = msgspec.structs.replace(with_points(config), points_weight=1.0)
    both = fit.fit_template(clip, config=strong, seed=0, log=silent, trained=Trained(points=PointNetwork()))
    ahead, behind = (prior.object_to_world[:, :3, 2].mean(0) for prior in (alone, both))
    assert torch.nn.functional.cosine_similarity(ahead, behind, dim=0) < -0.9
    assert both.name == "learned" and alone.name == "template" and "that a network finds" in both.provenance
    assert asked[0][:2] == (3, [0, 1, 2])


def test_under_unknown_cameras_the_network_is_told_nothing_of_them(monkeypatch: pytest.MonkeyPatch) -> None:
    torch.manual_seed(0)
    clip, network, known = standing_clip(), PointNetwork().eval(), []
    clip = replace(clip, frames=tuple(replace(frame, camera=None) for frame in clip.frames))
    network.register_forward_pre_hook(lambda _, inputs: known.append(inputs[3].tolist()))
    config = shortened(with_points(FOOTAGE), 1)
    prior = footage.fit_footage(clip, config=config, seed=0, log=silent, trained=Trained(points=network))
    assert prior.name == "learned" and torch.isfinite(prior.transforms).all()
    assert known == [[False]] * 4  # the clip and its mirror image, each plain and in a mirror
    alone = footage.fit_footage(clip, config=config, seed=0, log=silent)
    assert not torch.equal(alone.transforms, prior.transforms)


def test_a_longer_neck_carries_the_nose_further() -> None:
    """Points move with the proportions."""
    bones, along = indices()
    nose = NAMES.index("nose")
    shapes = (QUADRUPED.proportions(neck_length=length) for length in (0.6, 1.2))
    short, long = (QUADRUPED.build(shape, unit=False).bones[bones] for shape in shapes)
    places = [
        start[nose] + along[nose] * (end[nose] - start[nose]) for start, end in (b.unbind(1) for b in (short, long))
    ]
    assert (places[1] - places[0]).norm() == pytest.approx(0.6, abs=0.01)
