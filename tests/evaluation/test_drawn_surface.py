"""Points of the surface that Gaussians draw, against shapes that are known."""

import math

import pytest
import torch
from torch import Tensor

from rewild4d.evaluation.drawn_surface import sample_drawn
from rewild4d.io.sampling import sample_gaussians
from rewild4d.types import Splats


def ball(count: int, radius: float) -> Tensor:
    """Points on a sphere, evenly."""
    index = torch.arange(count) + 0.5
    height, turn = 1 - 2 * index / count, math.pi * (1 + math.sqrt(5)) * index
    level = (1 - height.square()).sqrt()
    return radius * torch.stack((level * turn.cos(), level * turn.sin(), height), dim=-1)


def splats(means: Tensor, scale: float, opacity: float = 0.98) -> Splats:
    count = len(means)
    quats = torch.tensor([1.0, 0, 0, 0]).repeat(count, 1)
    return Splats(
        means, quats, torch.full((count, 3), scale), torch.full((count,), opacity), torch.full((count, 1, 3), 0.5)
    )


def together(*parts: Splats) -> Splats:
    names = ("means", "quats", "scales", "opacities", "colors")
    return Splats(*(torch.cat([getattr(part, name) for part in parts]) for name in names))


def test_points_of_a_sphere_lie_on_it_and_all_around() -> None:
    points = sample_drawn(splats(ball(4000, 1.0), 0.03), 10_000, seed=0)
    assert points.dtype == torch.float64 and len(points) == 10_000
    assert points.norm(dim=-1) == pytest.approx(torch.ones(10_000), abs=0.07)
    # One standard deviation outside, since the Gaussians are round.
    assert float(points.norm(dim=-1).mean()) == pytest.approx(1 + 0.03, abs=0.01)
    assert points.mean(0) == pytest.approx(torch.zeros(3), abs=0.02)
    assert points.square().mean(0) == pytest.approx(torch.full((3,), 1.03**2 / 3), abs=0.02)


def test_what_lies_inside_is_not_part_of_it() -> None:
    both = together(splats(ball(4000, 1.0), 0.03), splats(ball(4000, 0.5), 0.03))
    centres, drawn = sample_gaussians(both, 10_000, seed=0), sample_drawn(both, 10_000, seed=0)
    assert int((centres.norm(dim=-1) < 0.7).sum()) == 4000
    assert float(drawn.norm(dim=-1).amin()) > 0.9


def test_an_outline_before_a_part_behind_has_no_points_between() -> None:
    front, behind = ball(4000, 1.0) + torch.tensor([3.0, 0, 0]), ball(4000, 1.0) - torch.tensor([3.0, 0, 0])
    points = sample_drawn(splats(torch.cat((front, behind)), 0.03), 20_000, seed=0)
    assert not bool(((points[:, 0] > -1.7) & (points[:, 0] < 1.7)).any())


def test_points_move_with_the_gaussians() -> None:
    shift = torch.tensor([5.0, -2.0, 1.0])
    small, large = splats(ball(2000, 1.0), 0.04), splats(3 * ball(2000, 1.0) + shift, 0.12)
    one, other = (sample_drawn(given, 100_000, seed=0) for given in (small, large))
    assert len(one) == pytest.approx(len(other), rel=0.01)
    assert float(((other - shift) / 3).norm(dim=-1).mean()) == pytest.approx(float(one.norm(dim=-1).mean()), abs=1e-3)


def test_the_seed_draws_and_what_is_faint_has_no_surface() -> None:
    given = splats(ball(2000, 1.0), 0.04)
    assert torch.equal(sample_drawn(given, 500, seed=1), sample_drawn(given, 500, seed=1))
    assert not torch.equal(sample_drawn(given, 500, seed=1), sample_drawn(given, 500, seed=2))
    assert sample_drawn(splats(ball(2000, 1.0), 0.04, opacity=0.05), 500, seed=0).shape == (0, 3)
    assert sample_drawn(splats(torch.zeros(0, 3), 0.04), 500, seed=0).shape == (0, 3)
    one = sample_drawn(splats(torch.tensor([[1.0, 2.0, 3.0]]), 0.1), 500, seed=0)
    assert len(one) and float((one - torch.tensor([1.0, 2.0, 3.0])).norm(dim=-1).amax()) < 0.2
