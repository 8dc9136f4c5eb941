"""Change pictures at random, so that a network does not learn how the animals that it is shown are made."""

import torch
from torch import Tensor

STRETCH, BEND, SHIFT = 0.2, 0.1, 0.05
"""Spreads: of the logarithm of each axis's scale, of a smooth displacement and of a shift, in halves of the side."""
LIGHT, CONTRAST = 0.5, 0.3
"""Spreads: of a smooth change of brightness (which has one of a half itself) and of the logarithm of its scale."""
KNOTS = 4
"""Of smooth changes along each axis."""


def augmented(pictures: Tensor, rows: torch.Generator) -> Tensor:
    """Return pictures stretched, bent and lit anew, also those whose brightness was not shown (all 0).

    Args:
        pictures: mask and brightness (`heading.pictures`), [n, 2, s, s].
        rows: source of randomness.

    Returns:
        [n, 2, s, s].
    """
    n, _, _, size = pictures.shape
    steps = (torch.arange(size) + 0.5) * (2 / size) - 1
    grid = torch.stack(torch.meshgrid(steps, steps, indexing="xy"), dim=-1)
    scales = (STRETCH * torch.randn(n, 1, 1, 2, generator=rows)).exp()
    grid = grid * scales + SHIFT * torch.randn(n, 1, 1, 2, generator=rows)
    grid = grid + BEND * _smooth(n, 2, size, rows).movedim(1, -1)
    mask, bright = torch.nn.functional.grid_sample(pictures, grid, align_corners=False).unbind(1)
    contrast = (CONTRAST * torch.randn(n, 1, 1, generator=rows)).exp()
    lit = contrast * bright + LIGHT * _smooth(n, 1, size, rows)[:, 0] * mask
    return torch.stack((mask, lit), dim=1)


def _smooth(n: int, channels: int, size: int, rows: torch.Generator) -> Tensor:
    """Return smooth noise, about of unit spread, [n, channels, size, size]."""
    knots = torch.randn(n, channels, KNOTS, KNOTS, generator=rows)
    return torch.nn.functional.interpolate(knots, size=(size, size), mode="bicubic", align_corners=True)
