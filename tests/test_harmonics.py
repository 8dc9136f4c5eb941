"""The basis is orthonormal, and degree 0 is plain colour."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from rewild4d.harmonics import C0, basis, rotated, seen_colors
from rewild4d.transforms import axis_angle_to_matrix
from rewild4d.types import Splats


def test_basis_is_orthonormal() -> None:
    """Integrals over the sphere by a product rule that is exact for these polynomials."""
    z, weight = (torch.from_numpy(a) for a in np.polynomial.legendre.leggauss(8))
    phi = torch.arange(16, dtype=torch.float64) * (2 * math.pi / 16)
    ring = (1 - z**2).sqrt()
    directions = torch.stack(
        ((ring[:, None] * phi.cos()).flatten(), (ring[:, None] * phi.sin()).flatten(), z.repeat_interleave(16)), dim=-1
    )
    values = basis(directions, 3)
    gram = (values * (weight.repeat_interleave(16) * 2 * math.pi / 16)[:, None]).T @ values
    torch.testing.assert_close(gram, torch.eye(16, dtype=torch.float64), atol=1e-12, rtol=0)


def splats(colors: torch.Tensor) -> Splats:
    n = len(colors)
    return Splats(torch.randn(n, 3), torch.ones(n, 4), torch.ones(n, 3), torch.ones(n), colors)


def test_constant_coefficient_is_a_colour_from_everywhere() -> None:
    colors = torch.zeros(5, 9, 3)
    colors[:, 0] = 0.3 / C0
    torch.testing.assert_close(seen_colors(splats(colors), torch.tensor((0.0, 0, 9))), torch.full((5, 3), 0.3 + 0.5))


def test_rgb_passes_through() -> None:
    colors = torch.rand(5, 1, 3)
    torch.testing.assert_close(seen_colors(splats(colors), torch.zeros(3)), colors[:, 0])


@pytest.mark.parametrize("degree", [1, 2, 3])
def test_the_kernel_sees_what_plain_torch_sees(degree: int) -> None:
    generator = torch.Generator().manual_seed(degree)
    made = Splats(
        torch.randn(2500, 3, generator=generator, dtype=torch.float64), torch.ones(2500, 4), torch.ones(2500, 3),
        torch.ones(2500), torch.randn(2500, (degree + 1) ** 2, 3, generator=generator, dtype=torch.float64),
    )  # fmt: skip
    eye = torch.tensor((0.3, -0.2, 4.0), dtype=torch.float64)
    wanted = seen_colors(made, eye)
    single = replace(made, means=made.means.float(), colors=made.colors.float())
    torch.testing.assert_close(seen_colors(single, eye), wanted.float(), atol=1e-5, rtol=0)
    assert (wanted == 0).any(), "some colours are cut off at black"
    single.colors.requires_grad_()
    seen_colors(single, eye).sum().backward()
    assert single.colors.grad is not None and single.colors.grad.abs().max() > 0
    single.colors.detach_()[7, 1, 2] = math.nan
    assert seen_colors(single, eye).isnan().nonzero().tolist() == [[7, 2]], "what is not a number stays visible"


def test_a_turned_animal_keeps_its_colours() -> None:
    generator = torch.Generator().manual_seed(0)
    turns = axis_angle_to_matrix(torch.randn(6, 3, generator=generator, dtype=torch.float64))
    directions = torch.nn.functional.normalize(torch.randn(6, 3, generator=generator, dtype=torch.float64), dim=-1)
    moved = (turns @ directions[..., None])[..., 0]
    for degree in (1, 2, 3):
        colours = torch.randn(6, (degree + 1) ** 2, 3, generator=generator, dtype=torch.float64)
        before = torch.einsum("nk,nkc->nc", basis(directions, degree), colours)
        after = torch.einsum("nk,nkc->nc", basis(moved, degree), rotated(colours, turns))
        torch.testing.assert_close(after, before)


@pytest.mark.parametrize("degree", [1, 2, 3])
@pytest.mark.parametrize("count", [1, 1100])
def test_the_kernel_turns_as_plain_torch_does(degree: int, count: int) -> None:
    generator = torch.Generator().manual_seed(degree)
    turns = axis_angle_to_matrix(3 * torch.randn(count, 3, generator=generator, dtype=torch.float64))
    colours = torch.randn(count, (degree + 1) ** 2, 3, generator=generator, dtype=torch.float64)
    wanted = rotated(colours, turns)
    torch.testing.assert_close(rotated(colours.float(), turns.float()), wanted.float(), atol=1e-5, rtol=0)
    assert (wanted - colours)[:, 1:].abs().max() > 0.5, "something turned"
    assert torch.equal(wanted[:, 0], colours[:, 0])
    single = colours.float().requires_grad_()
    rotated(single, turns.float()).square().sum().backward()
    assert single.grad is not None
    torch.testing.assert_close(single.grad, 2 * single.detach(), atol=1e-4, rtol=0)  # turning keeps lengths


def test_other_shapes_are_errors_before_a_kernel_reads_them() -> None:
    made = splats(torch.rand(5, 4, 3))
    with pytest.raises(ValueError, match=r"of as many Gaussians, got \[5, 3\] and \[4, 4, 3\]"):
        seen_colors(replace(made, colors=made.colors[:4]), torch.zeros(3))
    with pytest.raises(ValueError, match="expected 1, 4, 9 or 16 colour coefficients per Gaussian, got 6"):
        seen_colors(replace(made, colors=torch.rand(5, 6, 3)), torch.zeros(3))
    for coefficients, rotations in (((5, 6, 3), (5, 3, 3)), ((5, 4, 3), (4, 3, 3)), ((5, 4, 4), (5, 3, 3))):
        with pytest.raises(ValueError, match=r"and rotations \[n, 3, 3\], got"):
            rotated(torch.rand(coefficients), torch.rand(rotations))


def test_no_gaussians_turn() -> None:
    for dtype in (torch.float32, torch.float64):
        assert rotated(torch.zeros(0, 4, 3, dtype=dtype), torch.zeros(0, 3, 3, dtype=dtype)).shape == (0, 4, 3)
