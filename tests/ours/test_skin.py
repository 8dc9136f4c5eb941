"""Gaussians held to the starting skin: both losses against plain loops, what is free, and that a step has them."""

import math
from dataclasses import replace
from typing import Any

import msgspec
import pytest
import torch
from toys import TINY

from rewild4d.ours.canonical import NAMES, Gaussians, attributes
from rewild4d.ours.config import Canonical, Density, Rates
from rewild4d.ours.fit import Training
from rewild4d.ours.losses.config import Skin
from rewild4d.ours.losses.skin import Bond, StartingSkin, bind_loss, disc_loss, third_axes
from rewild4d.ours.model import build_model
from rewild4d.ours.symmetry import Supervision
from rewild4d.types import Clip, Prior

BOUNDS = Skin(flat=3.0, growth=1.3, reach=3.0)
UPRIGHT = torch.tensor((1.0, 0.0, 0.0, 0.0))
"""Orientation whose third axis is +z."""


def skin_of(points: torch.Tensor, radius: float) -> StartingSkin:
    count = len(points)
    scales = torch.full((count, 3), math.log(radius))
    return StartingSkin.of(Gaussians(attributes(points, UPRIGHT.expand(count, 4), scales, 0.5, Canonical()), 0.0))


def whole(count: int) -> Bond:
    """Held to the rows of the skin in order, in full."""
    return Bond(torch.arange(count), torch.ones(count), torch.ones(count))


def test_an_opaque_disc_on_the_skin_costs_nothing() -> None:
    points = torch.rand(5, 3, generator=torch.Generator().manual_seed(0))
    skin = skin_of(points, 0.1)
    discs = torch.tensor((0.1, 0.1, 0.1 / 3)).log().expand(5, 3)
    assert float(disc_loss(discs, torch.ones(5), torch.ones(5), skin.log_radius, BOUNDS)) == pytest.approx(
        0.0, abs=1e-9
    )
    # Along the skin a Gaussian may go anywhere.
    moved = points + torch.tensor((0.02, -0.01, 0.0))
    held = bind_loss(moved, UPRIGHT.expand(5, 4), skin, whole(5), BOUNDS)
    assert float(held) == pytest.approx(0.0, abs=1e-6)


def test_each_fault_has_its_price() -> None:
    log_radius = math.log(0.1)

    def price(scales: tuple[float, float, float], opacity: float = 1.0) -> float:
        one = torch.ones(1)
        return float(disc_loss(torch.tensor([scales]).log(), opacity * one, one, log_radius, BOUNDS))

    assert price((0.1, 0.05, 0.01)) == pytest.approx(math.log(2) ** 2, rel=1e-5)
    assert price((0.1, 0.1, 0.1)) == pytest.approx(math.log(3) ** 2, rel=1e-5)
    assert price((0.26, 0.26, 0.02)) == pytest.approx(2 * math.log(2) ** 2, rel=1e-5)  # 0.26 is twice 1.3 * 0.1
    assert price((0.1, 0.1, 0.02), 0.5) == pytest.approx(0.25)


def test_distance_counts_in_radii_along_the_normal_and_no_further_than_the_reach() -> None:
    skin = skin_of(torch.zeros(1, 3), 0.1)

    def price(z: float, quat: torch.Tensor = UPRIGHT) -> float:
        return float(bind_loss(torch.tensor([[0.3, 0.0, z]]), quat[None], skin, whole(1), BOUNDS))

    assert price(0.2) == pytest.approx((0.2 / 0.1) ** 2, rel=1e-5)
    assert price(5.0) == pytest.approx(9.0)
    assert price(0.0, torch.tensor((0.0, 1.0, 0.0, 0.0))) == pytest.approx(1 - -1)  # upside down
    far = torch.tensor([[0.0, 0.0, 5.0]], requires_grad=True)
    bind_loss(far, UPRIGHT[None], skin, whole(1), BOUNDS).backward()
    assert far.grad is not None and not far.grad.any(), "an antler is free"


def test_each_hold_counts_by_its_own_weight() -> None:
    skin = skin_of(torch.zeros(2, 3), 0.1)
    bond = Bond(torch.tensor((0, 1)), torch.tensor((0.5, 0.0)), torch.tensor((0.25, 1.0)))
    turned = torch.tensor([[0.0, 1.0, 0.0, 0.0]]).expand(2, 4)  # upside down: 1 - -1 = 2
    moved = torch.tensor([[0.0, 0.0, 0.1], [0.0, 0.0, 0.2]])
    held = float(bind_loss(moved, turned, skin, bond, BOUNDS))
    assert held == pytest.approx((0.25 * 1 + 0.5 * 2 + 1.0 * 4 + 0.0 * 2) / 2, rel=1e-5)
    half_seen = torch.full((2,), 0.5)
    discs = torch.tensor((0.1, 0.1, 0.02)).log().expand(2, 3)
    missing = float(disc_loss(discs, half_seen, bond.firmness, skin.log_radius, BOUNDS))
    assert missing == pytest.approx((0.5 * 0.25 + 0.0 * 0.25) / 2)


def test_evidence_weakens_a_hold() -> None:
    points = torch.tensor([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0]])
    skin = skin_of(points, 0.1)  # normals are +z
    rows = torch.tensor((1, 0, 1))
    alike = Bond.at(rows, skin.holds(0.02))
    assert torch.equal(alike.firmness, torch.ones(3)) and torch.equal(alike.depth, torch.ones(3))
    # The first is seen by all frames, from the side alone; the second by a few, from many sides.
    seen = replace(skin, information=torch.stack((torch.diag(torch.tensor((1.0, 0.0, 0.98))), 0.06 * torch.eye(3))))
    bond = Bond.at(rows, seen.holds(0.02))
    assert torch.equal(bond.nearest, rows)
    torch.testing.assert_close(bond.firmness, torch.tensor((4 / (4 + 36), 1.0, 4 / (4 + 36))))
    torch.testing.assert_close(bond.depth, torch.tensor((4 / (4 + 36), 4 / (4 + 98**2), 4 / (4 + 36))))


def test_nearest_is_the_nearest() -> None:
    generator = torch.Generator().manual_seed(1)
    points, queries = torch.rand(30, 3, generator=generator), torch.rand(20, 3, generator=generator)
    assert torch.equal(skin_of(points, 0.1).nearest(queries), torch.cdist(queries, points).argmin(dim=1))


def test_third_axes_are_unit() -> None:
    quats = torch.tensor([[2.0, 0.0, 0.0, 0.0], [1.0, 1.0, 0.0, 0.0]])
    wanted = torch.tensor([[0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])  # the second: a quarter turn about x
    torch.testing.assert_close(third_axes(quats), wanted, atol=1e-6, rtol=0)


def training(toy: tuple[Clip, Prior], **changed: Any) -> Training:
    config, generator = msgspec.structs.replace(TINY, **changed), torch.Generator().manual_seed(0)
    supervision = Supervision(*toy, config.image_size, torch.device("cpu"))
    return Training(build_model(config, toy[1], generator), supervision, config, generator)


def test_a_step_has_both_losses_and_a_new_set_finds_new_points(toy: tuple[Clip, Prior]) -> None:
    density = Density(start=0.0, end=1.0, every=0.125, gradient=0.0, cap=260)
    made = training(toy, skin=Skin(disc=0.05, bind=0.02), density=density)
    first = made.step(0)
    held = made.held
    assert first["disc"] > 0 and "bind" in first
    assert held is not None and held.bond is not None and len(held.bond.nearest) == len(made.gaussians)
    made.step(1)
    assert len(made.gaussians) == 260 and held.bond is None
    assert made.step(2)["bind"] >= 0 and held.bond is not None and len(held.bond.nearest) == 260
    assert {"disc", "bind"}.isdisjoint(training(toy).step(0)), "off by default"


def test_a_resumed_fit_keeps_the_evidence_of_the_start(toy: tuple[Clip, Prior]) -> None:
    config = Skin(disc=0.05, bind=0.02, evidence=0.02)
    made, resumed = training(toy, skin=config), training(toy, skin=config)
    made.step(0)
    held, again = made.held, resumed.held
    assert held is not None and again is not None and held.skin.information is not None and held.bond is not None
    assert 0.0 < float(held.bond.firmness.min()) < float(held.bond.firmness.max()) <= 1.0
    first = held.skin.information.clone()
    made.step(1)
    resumed.restore(made.state())
    assert again.skin.information is not None and torch.equal(again.skin.information, first)
    assert again.bond is not None and torch.equal(again.bond.firmness, held.bond.firmness)


def test_epsilon_of_the_colours_is_set(toy: tuple[Clip, Prior]) -> None:
    made = training(toy, rates=Rates(colors_epsilon=1e-4))
    wanted = {name: 1e-4 if name == "colors" else 1e-15 for name in NAMES}
    assert {name: group["eps"] for name, group in zip(NAMES, made.optimizer.param_groups, strict=True)} == wanted
