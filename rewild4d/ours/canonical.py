"""The canonical Gaussians: how they start from a surface, and their activated values."""

import math

import torch
from torch import Tensor, nn

from rewild4d.ours.config import Canonical
from rewild4d.priors.motion import quats_from_normals, sample_surface
from rewild4d.types import OBJECT_DIAGONAL, Prior, Splats

NAMES = ("means", "quats", "log_scales", "logit_opacities", "colors")
"""The learnable attributes, in the order of the optimizer's groups."""


class Gaussians(nn.Module):
    """Learnable Gaussians in the object frame at rest.

    Attributes:
        means: [n, 3].
        quats: wxyz, not normalised, [n, 4].
        log_scales: [n, 3].
        logit_opacities: [n].
        colors: RGB, kept in [0, 1] by clamping where it is used, [n, 3].
    """

    means: nn.Parameter
    quats: nn.Parameter
    log_scales: nn.Parameter
    logit_opacities: nn.Parameter
    colors: nn.Parameter

    def __init__(self, values: dict[str, Tensor], max_scale: float) -> None:
        super().__init__()
        for name in NAMES:
            self.register_parameter(name, nn.Parameter(values[name].detach().clone().float().contiguous()))
        self.max_log_scale = math.log(max_scale * OBJECT_DIAGONAL)

    def __len__(self) -> int:
        return self.means.shape[0]

    def scales_log(self) -> Tensor:
        """Log scales under the cap, [n, 3]."""
        return self.log_scales.clamp(max=self.max_log_scale)

    def opacities(self) -> Tensor:
        """In (0, 1), [n]."""
        return self.logit_opacities.sigmoid()

    def rgb(self) -> Tensor:
        """In [0, 1], [n, 3]."""
        return self.colors.clamp(0.0, 1.0)

    def splats(self) -> Splats:
        """The canonical Gaussians, activated, detached."""
        with torch.no_grad():
            quats = nn.functional.normalize(self.quats, dim=-1)
            return Splats(self.means, quats, self.scales_log().exp(), self.opacities(), self.rgb()[:, None])


def initial_gaussians(prior: Prior, count: int, config: Canonical, generator: torch.Generator) -> dict[str, Tensor]:
    """Flat Gaussians on the rest surface (METHOD section 3): radius sqrt(area / pi n), normal along the third axis.

    Args:
        prior: its rest surface is sampled.
        count: number of Gaussians.
        config: thickness and opacity at the start.
        generator: the only source of chance.

    Returns:
        The five attributes by name; colours are mid-grey.
    """
    surface = sample_surface(prior, count, generator)
    scales = surface.radius * torch.tensor((1.0, 1.0, config.thickness))
    return {
        "means": surface.points,
        "quats": quats_from_normals(surface.normals),
        "log_scales": scales.log().expand(count, 3),
        "logit_opacities": torch.full((count,), math.log(config.opacity / (1 - config.opacity))),
        "colors": torch.full((count, 3), 0.5),
    }
