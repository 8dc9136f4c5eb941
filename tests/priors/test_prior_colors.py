"""Colours in the fit of a prior: what a picture shows, how far two are apart, and what they tell that outlines hide."""

import math
from dataclasses import replace
from typing import Any

import msgspec
import pytest
import torch
from torch import Tensor
from walking import shortened, silent, walking_clip

from rewild4d.priors.bodies.quadruped import QUADRUPED
from rewild4d.priors.choose import PriorChoice
from rewild4d.priors.config import COLORS, STANDARD, Stage
from rewild4d.priors.fit import KnownCameras, fit_template
from rewild4d.priors.hypotheses import ROTATION_SPREAD, Hypotheses
from rewild4d.priors.race import Steps
from rewild4d.priors.silhouettes import NOISE, PARTS, Targets, color_mismatch, mean_color, rasterized
from rewild4d.types import Clip

pytestmark = pytest.mark.usefixtures("one_thread")

PAINT = Stage(size=64, steps=40, blur=(0.04, 0.01), keep=1, rasterized=True, colors=True, pace=0.5, frames=6)


def guess(count: int) -> Hypotheses:
    """An average quadruped that looks along +z at rest."""
    return Hypotheses.start(QUADRUPED, torch.eye(3)[None], torch.zeros(count, 3))


def seen_from(yaw: float, size: int = 64) -> tuple[Tensor, Tensor]:
    """Camera of a square picture of the origin from a side, world_to_camera and intrinsics."""
    from rewild4d.transforms import look_at

    eye = 9 * torch.tensor((torch.tensor(yaw).sin(), 0.2, torch.tensor(yaw).cos()), dtype=torch.float64)
    up, middle = torch.tensor((0.0, 1.0, 0.0)).double(), torch.zeros(3).double()
    focal = 1.6 * size
    intrinsics = torch.tensor(((focal, 0, size / 2), (0, focal, size / 2), (0, 0, 1)), dtype=torch.float32)
    return look_at(eye, middle, up).float(), intrinsics


def targets(count: int, guesses: Hypotheses, size: int = 64) -> Targets:
    """What a painted animal shows from as many sides as there are times."""
    cameras = [seen_from(6.2 * t / count) for t in range(count)]
    matrices, intrinsics = (torch.stack(part) for part in zip(*cameras, strict=True))
    empty = torch.zeros(count, size, size)
    blank = Targets(empty, empty[:, None].expand(-1, 3, -1, -1), empty + 1, matrices, intrinsics, torch.arange(count))
    images, mattes = guesses.pictures(blank)
    return replace(blank, masks=mattes[0], colors=images[0])


def striped(guesses: Hypotheses) -> Hypotheses:
    """Paint parts of the surface at random, each patch of eight alike."""
    painted = guesses.painted(torch.zeros(3))
    patches = torch.rand(painted.colors.shape[1] // 8, 3, generator=torch.Generator().manual_seed(0))
    return replace(painted, colors=patches.repeat_interleave(8, 0)[None])


def test_one_colour_is_the_matte_times_that_colour() -> None:
    color = torch.tensor((0.2, 0.5, 0.9))
    made = guess(2).painted(color)
    assert made.colors.shape == (1, PARTS**2 * len(QUADRUPED.build().quads), 3)
    images, mattes = made.pictures(targets(2, made))
    assert torch.allclose(images, color[:, None, None] * mattes[:, :, None], atol=1e-5)
    plain = made.silhouettes(targets(2, made), PAINT)
    both, either = ((plain > 0.5) & (mattes > 0.5)).sum(), ((plain > 0.5) | (mattes > 0.5)).sum()
    assert both / either > 0.95, "cut into parts it has the same outline"


def test_a_painted_quadrilateral_is_seen_in_its_place() -> None:
    """Two squares side by side, three metres away; the parts of the right one are red, its upper left part green.

    Parts overlap, so colours mix near their rims.
    """
    corners = torch.tensor([[-1.0, -0.5], [0, -0.5], [1, -0.5], [-1, 0.5], [0, 0.5], [1, 0.5]])
    vertices = torch.cat((corners, torch.full((6, 1), 3.0)), dim=1)[None, None]
    quads = torch.tensor([[0, 1, 4, 3], [1, 2, 5, 4]])  # sides: the first along x, the second along y
    colors = torch.zeros(1, 2 * PARTS**2, 3)
    colors[0, PARTS**2 :, 0] = 1.0
    colors[0, PARTS**2] = torch.tensor((0.0, 1.0, 0.0))
    intrinsics = torch.tensor([[[90.0, 0, 32], [0, 90.0, 32], [0, 0, 1]]])
    image = rasterized(vertices, quads, intrinsics, 64, colors)[0][0, 0]
    red, green = image[0], image[1]
    assert float(red[40, 50]) > 0.5 and float(red[40, 4]) < 0.02
    row, column = divmod(int(green.argmax()), 64)
    assert abs(row - (17 + 30 / 2 / PARTS)) <= 3 and abs(column - (32 + 30 / 2 / PARTS)) <= 3
    assert float(green[row, column]) > 0.2 and float(green[row, 55]) < 0.02 and float(green[43, column]) < 0.02


def test_distance_of_colours_by_hand() -> None:
    """Off by (0.3, 0, 0.4) where the animal is, on a quarter of the picture, without blur."""
    masks = torch.zeros(1, 8, 8)
    masks[:, :4, :4] = 1
    wanted = 0.5 * masks[:, None].expand(-1, 3, -1, -1)
    given = Targets(masks, wanted, torch.ones(1, 8, 8), torch.eye(4)[None], torch.eye(3)[None], torch.zeros(1).long())
    off = wanted + torch.tensor((0.3, 0.0, 0.4))[:, None, None] * masks[:, None]
    inside, outside = 16 * (0.5**2 + NOISE**2) ** 0.5, 48 * NOISE
    assert float(color_mismatch(off, given, 0.01)) == pytest.approx((inside + outside) / 16, rel=1e-5)
    assert torch.allclose(mean_color(given), torch.full((3,), 0.5))


@pytest.fixture
def colors_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    """Outlines say nothing."""
    monkeypatch.setattr("rewild4d.priors.race.mismatch", lambda rendered, *_: torch.zeros(len(rendered)))


def test_colours_turn_the_animal_back(colors_alone: None, monkeypatch: pytest.MonkeyPatch) -> None:
    count, off = 6, 0.12
    seen = targets(count, striped(guess(count)))
    config = msgspec.structs.replace(STANDARD, stages=(PAINT,), root_weight=0.0)
    generator, working = torch.Generator().manual_seed(0), torch.eye(4, dtype=torch.float64)
    race = KnownCameras((), (), "made", working, config, generator, Steps(silent, PAINT.steps))
    monkeypatch.setattr(race, "_targets", lambda _: seen)
    race.guesses = guess(count)
    race.guesses.rotation[:, 0, 1] = off / ROTATION_SPREAD[1]
    before = float(race.guesses.heading()[0, 0])
    race.run(PAINT)
    after = float(race.guesses.heading()[0, 0])
    assert before == pytest.approx(math.sin(off), rel=1e-4) and abs(after) < 0.4 * before


def colored(clip: Clip) -> Clip:
    """The clip of a template in a wash of colours over the picture."""
    frames = []
    for frame in clip.frames:
        wash = torch.linspace(0, 1, frame.mask.shape[2]).expand(3, *frame.mask.shape[1:])
        frames.append(replace(frame, rgb=wash * frame.mask))
    return replace(clip, frames=tuple(frames))


def test_the_template_is_fitted_to_colours_too_unless_masks_are_asked_for() -> None:
    names = ("template", "template:biped", "masks", "masks:biped", "rig", "coarse:1", "learned:w")
    choices: dict[str, Any] = {name: PriorChoice(name, STANDARD) for name in names}
    stages = {name: choice.settings_under(known_cameras=True).stages for name, choice in choices.items()}
    assert STANDARD.stages[-1] == COLORS
    for name in names:
        assert stages[name] == (STANDARD.stages if name.startswith("template") else STANDARD.stages[:-1]), name
    assert not any(stage.colors for stage in choices["template"].settings_under(known_cameras=False).stages)
    assert [body.name for body in choices["masks:biped"].bodies()] == ["biped"]


def test_only_a_round_on_colours_looks_at_them() -> None:
    clip, other, short = walking_clip(3, "sweep"), colored(walking_clip(3, "sweep")), shortened(2)
    same = [fit_template(each, config=short, seed=0, log=silent) for each in (clip, other)]
    brief = msgspec.structs.replace(COLORS, steps=2)
    config = msgspec.structs.replace(short, stages=(*short.stages, brief))
    apart = [fit_template(each, config=config, seed=0, log=silent) for each in (clip, other)]
    assert torch.equal(*(made.transforms for made in same))
    assert not torch.equal(*(made.transforms for made in apart))
    assert "fitted to masks of the clip's 3 frames" in same[0].provenance
    assert "fitted to masks and colours of the clip's 3 frames" in apart[0].provenance


def test_under_one_direction_of_view_colours_are_left_out() -> None:
    clip = walking_clip(3, "fixed")
    brief = msgspec.structs.replace(COLORS, steps=1)
    config = msgspec.structs.replace(shortened(1), stages=(*shortened(1).stages, brief))
    fitted = [fit_template(each, config=config, seed=0, log=silent) for each in (clip, colored(clip))]
    assert torch.equal(fitted[0].transforms, fitted[1].transforms)
