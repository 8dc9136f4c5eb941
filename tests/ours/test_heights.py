"""The skin moved as a whole, poses held where no image tells them, and first colours, against cases in the head."""

from pathlib import Path
from typing import Any

import msgspec
import pytest
import torch
from toys import TINY

from rewild4d.ours.canonical import Gaussians, attributes
from rewild4d.ours.coloring import initial_colors
from rewild4d.ours.config import Canonical, PriorUse
from rewild4d.ours.fit import Training, train
from rewild4d.ours.heights import Heights, smoothed
from rewild4d.ours.losses.config import Skin
from rewild4d.ours.losses.skin import StartingSkin
from rewild4d.ours.losses.untold import DOUBT, Marks, pose_firmness, untold_loss
from rewild4d.ours.model import build_model
from rewild4d.ours.symmetry import Supervision
from rewild4d.types import Clip, Prior

CPU = torch.device("cpu")
UPRIGHT = torch.tensor((1.0, 0.0, 0.0, 0.0))
"""Orientation whose third axis is +z."""


def quiet(*_: Any) -> None:
    """Log nothing."""


def sheet(points: torch.Tensor) -> Gaussians:
    count = len(points)
    return Gaussians(attributes(points, UPRIGHT.expand(count, 4), torch.zeros(count, 3), 0.5, Canonical()), 0.0)


def test_a_voxel_spreads_over_its_neighbours_and_their_mirror_images() -> None:
    grid = torch.zeros(6, 5, 5)
    grid[1, 2, 2] = 1.0
    spread = smoothed(grid)
    assert float(spread[1, 2, 2]) == float(spread[4, 2, 2]) == 0.5 * 0.5**3
    assert float(spread[0, 1, 2]) == float(spread[5, 1, 2]) == 0.5 * 0.25 * 0.25 * 0.5
    assert float(spread[2, 2, 2]) == 0.5 * 0.25 * 0.5**2
    assert float(spread.sum()) == pytest.approx(1.0)


def test_what_no_image_speaks_of_moves_with_its_surroundings() -> None:
    # Only the first is pulled: up, along its normal. Beside it, on the other side of the animal, and far away.
    points = torch.tensor([[1.0, 0.0, 0.0], [1.0, 0.05, 0.0], [-1.0, 0.0, 0.0], [1.0, 2.0, 0.0]])
    gaussians = sheet(points)
    skin, heights = StartingSkin.of(gaussians), Heights(StartingSkin.of(gaussians), 33)
    gaussians.means.grad = torch.tensor([[0.3, 0.0, -0.1]] + 3 * [[0.0, 0.0, 0.0]])
    heights.group["lr"] = 0.01
    heights.step(gaussians, skin, torch.arange(4), torch.ones(4))
    moved = gaussians.means.detach() - points
    assert not moved[:, :2].any(), "along the normals alone"
    first, beside, other, far = moved[:, 2].tolist()
    assert 0.002 < first <= 0.01 and beside == pytest.approx(first, rel=0.2) and far == 0.0
    assert other == pytest.approx(first, rel=1e-5)
    torch.testing.assert_close(skin.points, gaussians.means.detach())


def test_the_largest_height_of_a_first_step_is_the_rate() -> None:
    points = torch.tensor([[1.0, 0.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, -1.0, 0.0]])
    gaussians = sheet(points)
    skin = StartingSkin.of(gaussians)
    # Pitch 2 * 1.2 / 12 = 0.2: every point lies on a voxel.
    heights = Heights(skin, 13)
    gaussians.means.grad = torch.tensor([[0.0, 0.0, 5.0], [0.0, 0.0, 5.0], [0.0, 0.0, 1.0], [0.0, 0.0, -2.5]])
    heights.group["lr"] = 0.01
    heights.step(gaussians, skin, torch.arange(4), torch.tensor((1.0, 0.5, 1.0, 1.0)))
    torch.testing.assert_close(gaussians.means.detach()[:, 2], torch.tensor((-0.01, -0.005, -0.002, 0.005)))


def price(shift: tuple[float, float, float], shown: tuple[float, float]) -> float:
    """The loss of two marks of firmness 1 and 1/2 that a far camera sees along +z, moved away from the prior."""
    points = torch.tensor([[0.0, 0.0, 0.0], [0.5, 0.0, 0.0]])
    marks = Marks(points, torch.ones(2, 1), torch.zeros(2, 1, 2, 2))
    moved, eye = torch.eye(4), torch.tensor((0.0, 0.0, -1e4))
    moved[:3, 3] = torch.tensor(shift)
    return float(untold_loss(marks, moved[None], torch.eye(4)[None], eye, torch.tensor((shown, (1.0, 0.5)))))


def test_what_an_image_does_not_tell_is_held() -> None:
    # The diagonal is 5.
    along = (1 + 0.5**2) / 2 / 5**2
    assert price((0.0, 0.0, 1.0), (1.0, 1.0)) == pytest.approx(along / DOUBT**2, rel=1e-3)
    assert price((1.0, -2.0, 0.0), (1.0, 1.0)) == pytest.approx(0.0, abs=1e-6)


def test_a_prior_that_images_contradict_holds_less() -> None:
    along, across = (1 + 0.5**2) / 2 / 5**2, (3**2 + 4**2) / 2 / 5**2
    assert price((3.0, 4.0, 1.0), (1.0, 1.0)) == pytest.approx(along / (across + DOUBT**2), rel=1e-3)
    # The first is hidden, the second not quite: it alone tells how far off the prior is.
    hidden = (1 + 0.5**2 * 0.4) / 2 * (3**2 + 4**2) / 5**2
    assert price((3.0, 4.0, 0.0), (0.0, 0.6)) == pytest.approx(hidden / (across + DOUBT**2), rel=1e-3)


def test_frames_close_in_time_tell_the_pose_of_a_bone_from_several_sides() -> None:
    # Two bones of two marks each, in five frames of six: the second mark of each is hidden.
    along_x, along_z = torch.diag(torch.tensor((0.0, 1.0, 1.0))), torch.diag(torch.tensor((1.0, 1.0, 0.0)))
    weights = torch.tensor(((1.0, 0.0), (1.0, 0.0), (0.0, 1.0), (0.0, 1.0)))
    information = torch.zeros(2, 6, 4, 3, 3)
    information[0, :5, 0] = along_z
    information[0, :5, 2] = torch.stack((along_x, along_z, along_x, along_z, along_x))
    firmness = pose_firmness(information, weights, 0.1)
    # Of five frames two see bone 2 along z, half of its marks are hidden: 2 / 5 / 2.
    told = 0.1**2 / (0.1**2 + 0.2**2)
    torch.testing.assert_close(firmness[0, 2], torch.tensor((1.0, 1.0, told, told)))
    # The last frame has frames 3 to 5 alone, and nothing is seen in the last: 1 / 3 / 2.
    told = 0.1**2 / (0.1**2 + (1 / 6) ** 2)
    torch.testing.assert_close(firmness[0, 5], torch.tensor((1.0, 1.0, told, told)))
    assert torch.equal(firmness[1], torch.ones(6, 4)), "mirror images are frames of their own"


def test_marks_know_where_they_are_shown(toy: tuple[Clip, Prior]) -> None:
    made = training(toy, prior=PriorUse(untold=100.0))
    assert made.step(0)["untold"] >= 0
    marks = made.marks
    assert marks is not None and marks.views.shape == (2, len(toy[0].frames), 2, len(marks.points))
    shown, firmness = marks.views.unbind(2)
    assert 0.2 < float(shown.mean()) < 0.8 and float(shown.max()) == 1.0
    assert torch.equal(firmness, torch.ones_like(firmness)), "without evidence all are held alike"
    made = training(toy, prior=PriorUse(untold=100.0), skin=Skin(evidence=0.03))
    made.step(0)
    assert made.marks is not None and 0 < float(made.marks.views[:, :, 1].min()) < 0.9


def training(toy: tuple[Clip, Prior], **changed: Any) -> Training:
    config, generator = msgspec.structs.replace(TINY, **changed), torch.Generator().manual_seed(0)
    supervision = Supervision(*toy, config.image_size, CPU)
    return Training(build_model(config, toy[1], generator), supervision, config, generator)


def test_a_centre_follows_the_skin_where_its_place_is_not_told(toy: tuple[Clip, Prior]) -> None:
    held = training(toy, skin=Skin(follow=True))  # evidence 0: no place is told
    before = held.gaussians.means.detach().clone()
    held.step(0)
    assert torch.equal(held.gaussians.means, before)
    some = training(toy, skin=Skin(follow=True, evidence=0.02))
    free = training(toy)
    some.step(0), free.step(0)
    assert some.held is not None and some.held.bond is not None
    share = (some.gaussians.means - before).norm(dim=-1) / (free.gaussians.means - before).norm(dim=-1)
    seen = share.isfinite()
    torch.testing.assert_close(share[seen].detach(), (1 - some.held.bond.firmness)[seen], atol=2e-3, rtol=1e-3)


def test_heights_move_the_skin_at_a_falling_rate(toy: tuple[Clip, Prior]) -> None:
    made = training(toy, skin=Skin(follow=True, heights=1e-2))
    before = made.gaussians.means.detach().clone()
    made.step(0)
    moved = (made.gaussians.means.detach() - before).norm(dim=-1)
    assert 0 < float(moved.max()) <= 1e-2 * (1 + 1e-4)
    assert made.step_rates(TINY.iterations)[-1] == pytest.approx(1e-4)
    assert len(made.rated()) == len(made.step_rates(0)) == len(training(toy).rated()) + 1


def test_a_fit_with_all_of_it_resumes_to_the_same_bits(toy: tuple[Clip, Prior], tmp_path: Path) -> None:
    skin = Skin(disc=0.05, bind=0.02, evidence=0.02, heights=1e-3, follow=True)
    config = msgspec.structs.replace(TINY, skin=skin, prior=PriorUse(untold=100.0))

    def killed(done: int, *_: Any) -> None:
        if done == config.iterations + config.warmup.regress + config.warmup.iterations:
            raise KeyboardInterrupt

    whole = train(*toy, config, 0, CPU, quiet, None)
    with pytest.raises(KeyboardInterrupt):
        train(*toy, config, 0, CPU, killed, tmp_path)
    assert (tmp_path / "checkpoint.pt").is_file()
    resumed = train(*toy, config, 0, CPU, quiet, tmp_path)
    for (name, a), b in zip(whole.state_dict().items(), resumed.state_dict().values(), strict=True):
        assert torch.equal(a, b), name


def test_first_colours_are_those_of_the_place(toy: tuple[Clip, Prior]) -> None:
    generator = torch.Generator().manual_seed(0)
    model, supervision = build_model(TINY, toy[1], generator), Supervision(*toy, TINY.image_size, CPU)
    colours, along = initial_colors(model, supervision), model.gaussians.means.detach()[:, 2]
    # The animal is orange in front and blue behind.
    front, behind = colours[along > 0.3], colours[along < -0.3]
    for part, wanted in ((front, (0.8, 0.3, 0.1)), (behind, (0.1, 0.4, 0.7))):
        wrong = (part - torch.tensor(wanted)).abs().amax(-1) > 0.15
        assert len(part) > 50 and float(wrong.float().mean()) < 0.05
