"""What the fused networks do with numbers that are not finite, and with inputs that change before the gradients."""

import pytest
import torch
from torch import Tensor
from twins import normal, unit

from rewild4d.ours.canonical import Posed
from rewild4d.ours.config import Deform
from rewild4d.ours.config import Pose as PoseConfig
from rewild4d.ours.deform import DeformNetwork
from rewild4d.ours.pose import PoseNetwork

LAYERS = ("query", "skip", "key", "value", "project", "up", "down", "out")


def deform_network(half: bool = False) -> DeformNetwork:
    made = DeformNetwork(8, 24, Deform(width=16, heads=2, half=half), torch.Generator().manual_seed(0))
    torch.nn.init.normal_(made.out.weight, std=0.3, generator=torch.Generator().manual_seed(1))
    return made


def skinned() -> Posed:
    return Posed(normal(40, 3, seed=2).float(), unit(40, 4, seed=3).float(), normal(40, 3, seed=4).float() - 3)


def deformed(network: DeformNetwork, posed: Posed | None = None, **changed: Tensor) -> Posed:
    given = {"features": normal(20, 24, seed=7).float(), "anchors": normal(20, 8, seed=5).float()} | changed
    weights = normal(40, 20, seed=6).float().softmax(-1)
    return network(given["features"], weights, given["anchors"], posed or skinned(), 0.7)


def pose_network() -> PoseNetwork:
    config = PoseConfig(width=32, heads=2, anchor_size=5, frequencies=2)
    made = PoseNetwork(20, config, torch.Generator().manual_seed(0))
    torch.nn.init.normal_(made.head.weight, std=0.3, generator=torch.Generator().manual_seed(1))
    return made


@pytest.mark.parametrize("half", [False, True])
@pytest.mark.parametrize("name", [*(f"{layer}.weight" for layer in LAYERS), "up.bias", "down.bias", "value.bias"])
def test_a_nan_in_the_deformation_reaches_its_output(name: str, half: bool) -> None:
    network = deform_network(half)
    with torch.no_grad():
        network.get_parameter(name).view(-1)[0] = float("nan")
        moved = deformed(network)
    assert any(bool(part.isnan().any()) for part in moved)


@pytest.mark.parametrize("name", ["features", "anchors"])
def test_a_nan_in_what_steers_the_deformation_reaches_its_output(name: str) -> None:
    odd = normal(20, 24 if name == "features" else 8, seed=9).float()
    odd[3, 1] = float("nan")
    with torch.no_grad():
        moved = deformed(deform_network(), **{name: odd})
    assert bool(moved.means.isnan().any())


def test_a_nan_anywhere_in_the_pose_network_reaches_its_output() -> None:
    for name, _ in pose_network().named_parameters():
        network = pose_network()
        with torch.no_grad():
            network.get_parameter(name).view(-1)[0] = float("nan")
            pose = network(normal(2, 6, seed=1).float())
        assert any(bool(part.isnan().any()) for part in pose), name


def test_no_gaussians_are_no_gaussians_in_double_precision_too() -> None:
    for dtype in (torch.float32, torch.float64):
        network = deform_network().to(dtype)
        posed = Posed(*(torch.zeros(0, size, dtype=dtype) for size in (3, 4, 3)))
        features, anchors = normal(20, 24, seed=1).to(dtype), normal(20, 8, seed=2).to(dtype)
        moved = network(features, torch.zeros(0, 20, dtype=dtype), anchors, posed, 1.0)
        assert [tuple(part.shape) for part in moved] == [(0, 3), (0, 4), (0, 3)]


@pytest.mark.parametrize("name", ["query.weight", "project.weight", "key.bias"])
def test_a_layer_of_the_deformation_changed_before_its_gradient_is_an_error(name: str) -> None:
    network = deform_network()
    moved = deformed(network)
    with torch.no_grad():
        network.get_parameter(name).mul_(1.5)
    with pytest.raises(RuntimeError, match="modified by an inplace operation"):
        moved.means.sum().backward()


def test_gaussians_changed_before_their_gradient_are_an_error() -> None:
    posed = skinned()
    moved = deformed(deform_network(), posed)
    posed.means.mul_(2)
    with pytest.raises(RuntimeError, match=r"modified by an inplace operation: .*\[40, 3\]"):
        moved.quats.sum().backward()


def test_poses_changed_before_their_gradient_are_an_error() -> None:
    network = pose_network()
    pose = network(normal(2, 6, seed=1).float())
    with torch.no_grad():
        network.blocks[0].qkv.weight.mul_(1.5)
    with pytest.raises(RuntimeError, match="modified by an inplace operation"):
        pose.quats.sum().backward()


def test_parameters_that_moved_to_other_memory_give_the_same_gradient() -> None:
    found = []
    for moves in (False, True):
        network = pose_network()
        pose = network(normal(2, 6, seed=1).float())
        for parameter in network.parameters() if moves else ():
            parameter.data = parameter.data.clone()
        spoilt = [torch.full_like(parameter, torch.nan) for parameter in network.parameters()]  # where they lay
        pose.quats.square().sum().backward()
        found.append([parameter.grad for parameter in network.parameters()])
        del spoilt
    assert all(torch.equal(a, b) for a, b in zip(*found, strict=True) if a is not None and b is not None)


def test_a_parameter_stored_by_columns_gives_the_same_poses() -> None:
    network = pose_network()
    before = network(normal(2, 6, seed=1).float())
    weight = network.blocks[0].qkv.weight
    weight.data = weight.data.t().contiguous().t()
    after = network(normal(2, 6, seed=1).float())
    assert all(torch.equal(a, b) for a, b in zip(before, after, strict=True))
    after.quats.square().sum().backward()
    assert weight.grad is not None
