"""Gaussians that stand for all in the deformation network's gradients: the expected sum is the whole one."""

import numpy as np
import pytest
import torch
from twins import normal, unit

from rewild4d.ours.canonical import Posed
from rewild4d.ours.config import Deform
from rewild4d.ours.deform import DeformNetwork
from rewild4d.ours.fused.sampled_rows import sample_rows


def gradients_of(worth: list[float]) -> tuple[np.ndarray, ...]:
    """Gradients of the means alone, of these lengths; orientations and gradients as `sample_rows` takes them."""
    means = np.zeros((len(worth), 3), np.float32)
    means[:, 1] = worth
    quats = np.tile(np.float32((1, 0, 0, 0)), (len(worth), 1))
    return quats, means, np.zeros_like(quats), np.zeros_like(means)


def draw(worth: list[float], wanted: int, offset: float) -> tuple[list[int], list[float]]:
    rows, factors = sample_rows(1.0, 1.0, *gradients_of(worth), wanted, offset)
    return rows.tolist(), factors.tolist()


def test_equal_gradients_are_drawn_at_equal_distances() -> None:
    assert draw([2.0] * 6, 3, 0.0) == ([1, 3, 5], [6 / 3] * 3)
    assert draw([2.0] * 6, 3, 0.5) == ([0, 2, 4], [6 / 3] * 3)


def test_a_large_gradient_always_counts_and_counts_once() -> None:
    # One is certain; the four small ones share the other draw.
    for offset in (0.0, 0.3, 0.9):
        rows, factors = draw([1.0, 1.0, 100.0, 1.0, 1.0], 2, offset)
        assert len(rows) == 2
        assert 2 in rows
        assert sorted(factors) == [1.0, 4.0]


def test_what_has_no_gradient_is_never_drawn() -> None:
    assert draw([0.0, 3.0, 0.0, 5.0], 3, 0.7) == ([1, 3], [1.0, 1.0])
    assert draw([0.0, 0.0], 1, 0.7) == ([], [])


def test_a_gradient_that_is_not_finite_is_not_left_out() -> None:
    assert draw([1.0, float("nan"), 1.0, 1.0], 2, 0.1) == ([0, 1, 2, 3], [1.0] * 4)
    assert draw([1.0, float("inf"), 1.0, 1.0], 2, 0.1) == ([0, 1, 2, 3], [1.0] * 4)


def test_every_gaussian_counts_one_in_the_mean_of_all_offsets() -> None:
    generator = np.random.default_rng(0)
    quats = unit(200, 4, seed=1).numpy().astype(np.float32)
    grads = [generator.standard_normal((200, size)).astype(np.float32) for size in (3, 4, 3)]
    grads = [each * (generator.random((200, 1)) ** 3).astype(np.float32) for each in grads]
    counted, worth, drawn = np.zeros(200), np.ones(200), []
    for offset in (np.arange(4000) + 0.5) / 4000:
        rows, factors = sample_rows(0.1, 1.0, quats, *grads, 40, offset)
        counted[rows] += factors / 4000
        worth[rows] = factors
        drawn.append(len(rows))
    assert (min(drawn), max(drawn)) == (40, 40)
    # The offsets that draw a Gaussian are an interval of length 1 / its factor, which this grid sees to 1 / 4,000.
    assert (np.abs(counted - 1) < 1.01 * worth / 4000).all()
    assert worth.max() > 50, "some are drawn seldom"


@pytest.fixture
def network() -> DeformNetwork:
    made = DeformNetwork(8, 24, Deform(width=16, heads=2, half=False, sampled=60), torch.Generator().manual_seed(0))
    torch.nn.init.normal_(made.out.weight, std=0.3, generator=torch.Generator().manual_seed(1))
    return made


def grads_of(network: DeformNetwork, count: int, offset: float) -> tuple[list[torch.Tensor], torch.Tensor]:
    """Gradients of the Gaussians and of anchors, and of all parameters in one row."""
    places = [normal(count, 3, seed=2), unit(count, 4, seed=3), normal(count, 3, seed=4) - 3, normal(20, 8, seed=5)]
    leaves = [place.float().requires_grad_() for place in places]
    weights = normal(count, 20, seed=6).float().softmax(-1)
    moved = network(normal(20, 24, seed=7).float(), weights, leaves[3], Posed(*leaves[:3]), 0.7, offset)
    weight = (normal(count, 1, seed=8).abs() ** 4).float()
    network.zero_grad()
    sum((out * weight * normal(*out.shape, seed=i).float()).sum() for i, out in enumerate(moved)).backward()  # type: ignore[union-attr]
    own = torch.cat([each.grad.flatten() for each in network.parameters() if each.grad is not None])
    return [leaf.grad for leaf in leaves if leaf.grad is not None], own


def test_the_networks_gradient_is_right_in_the_mean_and_that_of_the_gaussians_exact(network: DeformNetwork) -> None:
    offsets = [(i + 0.5) / 200 for i in range(200)]
    drawn = [grads_of(network, 300, offset) for offset in offsets]
    network.config = Deform(width=16, heads=2, half=False)
    whole, own = grads_of(network, 300, 0.0)
    for given, _ in drawn:
        assert all(torch.equal(a, b) for a, b in zip(given[:3], whole[:3], strict=True))
    assert (torch.stack([given[3] for given, _ in drawn]).mean(0) - whole[3]).norm() < 0.02 * whole[3].norm()
    mean = torch.stack([each for _, each in drawn]).mean(0)
    assert (mean - own).norm() < 0.02 * own.norm()
    single = (drawn[0][1] - own).norm() / own.norm()
    assert 0.02 < single < 0.5, "a single draw differs from the whole sum, not by much"


def test_as_many_as_there_are_is_the_whole_sum(network: DeformNetwork) -> None:
    _, drawn = grads_of(network, 60, 0.3)
    network.config = Deform(width=16, heads=2, half=False)
    assert torch.equal(drawn, grads_of(network, 60, 0.3)[1])
