"""A Gaussian over the shapes of a template: its proportions and the relief of its cross sections."""

from dataclasses import dataclass

import torch
from torch import Tensor


@dataclass(frozen=True)
class ShapeDensity:
    """Where shapes lie, all in the template's own standard deviations; D = P + 4 S.

    Attributes:
        mean: proportions, then relief, [D].
        whitening: takes deviations from the mean to independent ones of unit spread, [D, D].
    """

    mean: Tensor
    whitening: Tensor

    def start(self, measures: int) -> tuple[Tensor, Tensor]:
        """Return the mean proportions, ``measures`` of them, and the mean relief, [P] and [S, 4]."""
        return self.mean[:measures].clone(), self.mean[measures:].reshape(-1, 4).clone()

    def penalty(self, shape: Tensor, relief: Tensor) -> Tensor:
        """Return the mean square of the whitened deviations.

        Args:
            shape: proportions, [B, P].
            relief: of the cross sections, [B, S, 4].

        Returns:
            About 1 for shapes of the density itself, [B].
        """
        away = torch.cat((shape, relief.flatten(1)), dim=1) - self.mean
        return (away @ self.whitening.T).square().mean(1)
