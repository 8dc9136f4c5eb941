"""The fused silhouettes of round Gaussians against their torch twin in double precision."""

import pytest
import torch
from torch import Tensor
from twins import check_twins, leaves, normal, same_on_any_threads

from rewild4d.kernels.switch import VARIABLE, without_kernels
from rewild4d.priors import silhouettes
from rewild4d.priors.fused.splats import SPLATS
from rewild4d.priors.silhouettes import splat


def scene(dtype: torch.dtype, size: int) -> tuple[dict[str, Tensor], Tensor]:
    """Two guesses in three crops; some Gaussians lie outside, before and behind the camera, some reach everywhere."""
    points = normal(2, 3, 50, 3, seed=1) * torch.tensor((2.0, 2.0, 0.5)) + torch.tensor((0.0, 0.0, 4.0))
    points[0, :, 0] = torch.tensor((0.1, 0.0, -3.0))
    points[0, :, 1] = torch.tensor((900.0, 0.0, 4.0))
    sizes = 0.3 * normal(2, 1, 50, seed=2).exp()
    sizes[1, :, 2] = 40.0
    intrinsics = torch.tensor(((1.2 * size, 0.0, 0.5 * size), (0.0, 1.4 * size, 0.4 * size), (0.0, 0.0, 1.0)))
    return leaves(dtype, points=points, sizes=sizes), intrinsics.to(dtype).expand(3, 3, 3)


@pytest.mark.parametrize("size", [16, 40, 96])
def test_values_and_gradients_are_those_of_the_twin(size: int) -> None:
    def make(dtype: torch.dtype) -> tuple[list[Tensor], dict[str, Tensor]]:
        given, intrinsics = scene(dtype, size)
        return [splat(given["points"], given["sizes"], intrinsics, size)], given

    check_twins(make)


def test_each_silhouette_is_the_same_on_any_number_of_threads() -> None:
    def make() -> list[Tensor]:
        given, intrinsics = scene(torch.float32, 48)
        drawn = splat(given["points"], given["sizes"], intrinsics, 48)
        drawn.square().sum().backward()
        return [drawn, *(each.grad for each in given.values() if each.grad is not None)]

    assert len(same_on_any_threads(make)) == 3


def test_a_position_that_is_not_a_number_shows_in_its_silhouette_alone() -> None:
    given, intrinsics = scene(torch.float32, 32)
    with torch.no_grad():
        given["points"][1, 2, 7, 0] = torch.nan
        drawn = splat(given["points"], given["sizes"], intrinsics, 32)
        with without_kernels(SPLATS.name):
            twin = splat(given["points"], given["sizes"], intrinsics, 32)
    bad = drawn.isnan().flatten(2).any(-1)
    assert bad.tolist() == twin.isnan().flatten(2).any(-1).tolist() == [[False] * 3, [False, False, True]]


def test_the_kernel_is_used_unless_torch_is_chosen(monkeypatch: pytest.MonkeyPatch) -> None:
    given, intrinsics = scene(torch.float32, 32)
    fused = splat(given["points"], given["sizes"], intrinsics, 32)

    def broken(*_: object) -> None:
        raise ZeroDivisionError

    monkeypatch.setattr(silhouettes, "densities", broken)
    with pytest.raises(ZeroDivisionError):
        splat(given["points"], given["sizes"], intrinsics, 32)
    monkeypatch.setenv(VARIABLE, "torch")
    twin = splat(given["points"], given["sizes"], intrinsics, 32)
    assert not torch.equal(fused, twin) and torch.allclose(fused, twin, atol=1e-5)
