"""Every fused kernel against its plain torch twin in double precision: values, and the gradient of every input."""

from collections.abc import Callable

import pytest
import torch
from torch import Tensor

from rewild4d.ours.config import Deform
from rewild4d.ours.deform import DeformNetwork, Posed
from rewild4d.ours.losses import colour_losses, silhouette_loss, union_window
from rewild4d.ours.symmetry import Target
from rewild4d.types import Camera

Make = Callable[[torch.dtype], tuple[list[Tensor], dict[str, Tensor]]]


def normal(*shape: int, seed: int) -> Tensor:
    return torch.randn(shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def unit(*shape: int, seed: int) -> Tensor:
    return torch.nn.functional.normalize(normal(*shape, seed=seed), dim=-1)


def leaves(dtype: torch.dtype, **values: Tensor) -> dict[str, Tensor]:
    return {name: value.to(dtype).detach().clone().requires_grad_() for name, value in values.items()}


def check_twins(make: Make, tolerance: float = 2e-5) -> None:
    """The same function in double (plain torch) and single precision (fused): relative errors of values and gradients.

    ``make`` gives the outputs and the inputs by name for a dtype.
    """
    found = []
    for dtype in (torch.float64, torch.float32):
        outputs, inputs = make(dtype)
        loss = torch.stack([(out * normal(*out.shape, seed=i).to(out)).sum() for i, out in enumerate(outputs)]).sum()
        loss.backward()
        found.append((outputs, {name: tensor.grad for name, tensor in inputs.items()}))
    (wanted, slopes), (got, own) = found
    scale = max(float(slope.norm()) for slope in slopes.values() if slope is not None)
    for i, (a, b) in enumerate(zip(wanted, got, strict=True)):
        assert (a - b).norm() <= tolerance * a.norm(), f"output {i}"
    for name, slope in slopes.items():
        if slope is None:
            assert own[name] is None or own[name].abs().max() == 0, name
        else:
            # A gradient that is zero in exact arithmetic (a key's bias) is held to the size of the others.
            limit = tolerance * max(float(slope.norm()), 1e-2 * scale)
            assert float((slope - own[name]).norm()) <= limit, f"gradient of {name}"


@pytest.mark.parametrize(("count", "width", "heads"), [(1, 16, 2), (100, 32, 4), (48, 48, 4)])
def test_deformation(count: int, width: int, heads: int) -> None:
    def make(dtype: torch.dtype) -> tuple[list[Tensor], dict[str, Tensor]]:
        config = Deform(width=width, heads=heads)
        network = DeformNetwork(8, 24, config, torch.Generator().manual_seed(0))
        for i, layer in enumerate(network.children()):
            generator = torch.Generator().manual_seed(i)
            torch.nn.init.normal_(layer.weight, std=0.3, generator=generator)
            torch.nn.init.normal_(layer.bias, std=0.3, generator=generator)
        network.to(dtype)
        given = leaves(
            dtype,
            features=normal(20, 24, seed=1),
            parts=normal(count, 8, seed=2),
            means=2 * normal(count, 3, seed=3),
            quats=unit(count, 4, seed=4),
            log_scales=normal(count, 3, seed=5) - 3,
        )
        posed = Posed(given["means"], given["quats"], given["log_scales"])
        moved = network(given["features"], given["parts"], posed, 0.7)
        return list(moved), given | dict(network.named_parameters())

    check_twins(make)


def test_deformation_is_the_same_bits_for_any_number_of_threads() -> None:
    before, found = torch.get_num_threads(), []
    network = DeformNetwork(8, 24, Deform(width=16), torch.Generator().manual_seed(0))
    torch.nn.init.normal_(network.out.weight, generator=torch.Generator().manual_seed(1))
    posed = Posed(normal(5000, 3, seed=1).float(), unit(5000, 4, seed=2).float(), normal(5000, 3, seed=3).float())
    try:
        for threads in (1, 2, 3):
            torch.set_num_threads(threads)
            network.zero_grad()
            moved = network(normal(20, 24, seed=4).float(), normal(5000, 8, seed=5).float(), posed, 1.0)
            (moved.means.square().sum() + moved.quats[:, 0].sum()).backward()
            found.append([*moved, network.up.weight.grad, network.query.weight.grad])
    finally:
        torch.set_num_threads(before)
    for other in found[1:]:
        assert all(torch.equal(a, b) for a, b in zip(found[0], other, strict=True))


def matte(height: int, width: int, center: tuple[float, float], radius: float) -> Tensor:
    """A soft disc, exactly 0 far outside and 0.99 inside, [1, h, w]."""
    rows, columns = torch.meshgrid(torch.arange(height).double(), torch.arange(width).double(), indexing="ij")
    distance = ((rows - center[0]).square() + (columns - center[1]).square()).sqrt()
    return (0.5 + (radius - distance) / 6).clamp(0, 0.99)[None]


@pytest.mark.parametrize(
    ("height", "width", "center", "radius"),
    [(70, 90, (33.0, 47.0), 14.0), (40, 35, (3.0, 30.0), 12.0), (30, 17, (15.0, 8.0), 40.0)],
)
def test_image_losses(height: int, width: int, center: tuple[float, float], radius: float) -> None:
    def make(dtype: torch.dtype) -> tuple[list[Tensor], dict[str, Tensor]]:
        mask = matte(height, width, center, radius)
        alpha = matte(height, width, (center[0] + 2, center[1] - 3), 0.9 * radius)
        colours = [torch.rand(3, height, width, generator=torch.Generator().manual_seed(i)).double() for i in (1, 2)]
        camera = Camera(torch.eye(4), torch.eye(3), width, height)
        target = Target((colours[0] * mask).to(dtype), mask.to(dtype), camera, 1.3 * radius)
        given = leaves(dtype, rgb=colours[1] * alpha, alpha=alpha)
        window = union_window([given["alpha"], target.mask], 10)
        background = torch.tensor((0.2, 0.9, 0.5), dtype=dtype)
        losses = [*colour_losses(given["rgb"], given["alpha"], target, background, window)]
        return [*losses, silhouette_loss(given["alpha"], target, window)], given

    check_twins(make)
