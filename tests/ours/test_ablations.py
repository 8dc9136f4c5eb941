"""The switches that the paper's ablations turn: each really changes what it says, and nothing else."""

import pytest
import torch

from rewild4d.ours.canonical import initial_gaussians
from rewild4d.ours.config import Canonical, Config, Deform, Pose, PriorUse, Skinning
from rewild4d.ours.fit import Training
from rewild4d.ours.losses.config import Geometry, Loss
from rewild4d.ours.model import Model, build_model
from rewild4d.ours.symmetry import Key, Supervision
from rewild4d.running.conformance import tiny_case
from rewild4d.types import Case

SMALL = {"canonical": Canonical(samples=200), "skinning": Skinning(resolution=10), "image_size": 48, "iterations": 20}


@pytest.fixture(scope="module")
def case() -> Case:
    return tiny_case()


def generator() -> torch.Generator:
    return torch.Generator().manual_seed(0)


def model(case: Case, **changes: object) -> Model:
    """A model whose networks are not at zero."""
    made = build_model(Config(**{**SMALL, **changes}), case.prior, generator())  # type: ignore[arg-type]
    for layer in (made.network.head, made.deform.out):
        torch.nn.init.normal_(layer.weight, std=0.1, generator=generator())
    return made


def training(case: Case, **changes: object) -> Training:
    made = model(case, **changes)
    supervision = Supervision(case.clip, case.prior, made.config.image_size, torch.device("cpu"))
    return Training(made, supervision, made.config, generator())


def test_without_a_shape_prior_gaussians_fill_the_box(case: Case) -> None:
    start = initial_gaussians(case.prior, Canonical(samples=4000, opacity=0.1), generator(), shape=False)
    low, high = case.prior.vertices.aminmax(dim=0)
    assert ((start["means"] >= low) & (start["means"] <= high)).all()
    # Uniform: the mean is the middle and the deviation the side over the root of twelve.
    torch.testing.assert_close(start["means"].mean(0), (low + high) / 2, atol=0.05, rtol=0)
    torch.testing.assert_close(start["means"].std(0), (high - low) / 12**0.5, atol=0.03, rtol=0.03)
    assert float(start["logit_opacities"].sigmoid().mean()) == pytest.approx(0.1)
    side = ((high - low).prod() / 4000) ** (1 / 3)
    torch.testing.assert_close(start["log_scales"].exp(), (0.5 * side).expand(4000, 3))
    on = initial_gaussians(case.prior, Canonical(samples=4000), generator())
    assert torch.equal(model(case, prior=PriorUse(shape=False)).gaussians.means, drawn_in_box(case))
    inside = ((start["means"][:, None, :] - on["means"][None, :400]).norm(dim=-1).amin(1) > 0.3).float().mean()
    assert inside > 0.2, "a good part lies far from the surface"
    assert {name: tensor.shape for name, tensor in start.items()} == {name: on[name].shape for name in start}


def drawn_in_box(case: Case) -> torch.Tensor:
    """The first draw of a model's generator."""
    low, high = case.prior.vertices.aminmax(dim=0)
    return low + (high - low) * torch.rand(200, 3, generator=generator())


def test_without_part_anchors_there_are_none_anywhere(case: Case) -> None:
    whole, without = model(case), model(case, pose=Pose(anchors=False))
    assert without.deform.inputs - whole.deform.inputs == 20 - 8
    weights = without.field.sample(without.field.probabilities(), without.gaussians.means)
    seen: list[tuple[torch.Tensor, torch.Tensor | None]] = []
    without.deform.register_forward_pre_hook(lambda _, given: seen.append(given[1:3]))
    pose = without.pose(torch.tensor([0.5]), [Key(1, 1, 0)])
    _, moved = without.moved(pose, weights, 1.0)
    assert torch.equal(seen[0][0], weights)
    assert seen[0][1] is None
    moved.means.sum().backward()
    assert not any("anchors" in name for name, _ in without.named_parameters())
    assert without.network.embed.weight.shape == (20 * without.config.pose.width, whole.network.embed.in_features - 8)
    features = pose.features[0].detach()
    assert (features[0] - features[1]).abs().max() > 1e-3, "parts differ by the layer that makes their tokens"
    assert without.network.embed.weight.grad is not None, "the time code reaches the deformation"
    weights = whole.field.sample(whole.field.probabilities(), whole.gaussians.means)
    whole.deform.register_forward_pre_hook(lambda _, given: seen.append(given[1:3]))
    whole.moved(whole.pose(torch.tensor([0.5]), [Key(1, 1, 0)]), weights, 1.0)
    assert torch.equal(seen[1][0], weights)
    assert seen[1][1] is whole.network.anchors


def test_without_the_symmetric_code_both_groups_share_one(case: Case) -> None:
    keys = [Key(m, v, 1) for m in (1, -1) for v in (1, -1)]
    times = torch.full((4,), 0.5)
    symmetric = model(case).pose(times, keys).quats
    viewed = model(case, pose=Pose(encoding="view")).pose(times, keys).quats
    assert len({tuple(row.flatten().tolist()) for row in symmetric.detach()}) == 4
    torch.testing.assert_close(viewed[0], viewed[2])
    torch.testing.assert_close(viewed[1], viewed[3])
    assert (viewed[0] - viewed[1]).abs().max() > 1e-3
    # At m = v both codes are one: emb(t m) + v = emb(t v) + v.
    torch.testing.assert_close(symmetric[0], viewed[0])
    torch.testing.assert_close(symmetric[3], viewed[3])


def test_without_deformation_the_branches_agree(case: Case) -> None:
    without = model(case, deform=Deform(enabled=False))
    weights = without.field.sample(without.field.probabilities(), without.gaussians.means)
    posed, moved = without.moved(without.pose(torch.tensor([0.5]), [Key(1, 1, 0)]), weights, 1.0)
    assert torch.equal(posed.means, moved.means) and torch.equal(posed.quats, moved.quats)
    whole = model(case)
    posed, moved = whole.moved(whole.pose(torch.tensor([0.5]), [Key(1, 1, 0)]), weights, 1.0)
    assert (posed.means - moved.means).abs().max() > 1e-3


def test_without_isolation_colours_move_the_joints(case: Case) -> None:
    key, values, grads = Key(1, 1, 0), [], []
    for each in (training(case), training(case, loss=Loss(isolated=False))):
        losses, _ = each.losses(key, each.supervision.target(key), index=19)
        values.append({name: value.item() for name, value in losses.items()})
        (losses["l1"] + losses["ssim"]).backward()
        grads.append(each.model.network.head.weight.grad)
    assert values[0] == values[1]
    assert grads[0] is None or grads[0].abs().max() == 0
    assert grads[1] is not None and grads[1].abs().max() > 0


def test_fixed_skinning_stays_as_the_prior_has_it(case: Case) -> None:
    fixed, learnt = training(case, skinning=Skinning(resolution=10, learn=False)), training(case)
    for each, moves in ((fixed, False), (learnt, True)):
        before = each.model.field.logits.detach().clone()
        for index in range(3):
            each.step(index)
        assert torch.equal(before, each.model.field.logits) is not moves


@pytest.mark.parametrize("name", ["compact", "smooth"])
def test_a_regulariser_at_zero_is_no_loss(case: Case, name: str) -> None:
    key = Key(1, 1, 0)
    whole, without = training(case), training(case, geometry=Geometry(**{name: 0.0}))
    losses = [set(each.losses(key, each.supervision.target(key), 0)[0]) for each in (whole, without)]
    assert losses[0] - losses[1] == {name} and not losses[1] - losses[0]
