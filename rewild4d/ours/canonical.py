"""Canonical Gaussians: their start from a surface, and their activated values."""

import math
from collections.abc import Mapping
from typing import NamedTuple

import torch
from torch import Tensor, nn
from torch.nn.functional import normalize

from rewild4d.harmonics import C0, basis, rotated
from rewild4d.kernels import gpu
from rewild4d.ours.config import Canonical
from rewild4d.ours.fused.harmonics import COLORS, seen_rgb
from rewild4d.priors.motion import SurfaceSample, quats_from_normals, sample_surface, surface_vertices
from rewild4d.transforms import constant, quat_multiply, quat_to_matrix
from rewild4d.types import OBJECT_DIAGONAL, Prior, Splats

NAMES = ("means", "quats", "log_scales", "logit_opacities", "colors")
"""Learnable attributes, in the order of the optimizer's groups."""
REST_GAIN = 20.0
"""Factor on the stored coefficients above degree 0: under Adam it divides their learning rate, as in 3DGS."""


class Posed(NamedTuple):
    """Gaussians after skinning or deformation: means [n, 3], unit quats [n, 4], log scales [n, 3]."""

    means: Tensor
    quats: Tensor
    log_scales: Tensor


class Gaussians(nn.Module):
    """Learnable Gaussians in the object frame at rest.

    Attributes:
        means: [n, 3].
        quats: wxyz, not normalised, [n, 4].
        log_scales: [n, 3].
        logit_opacities: [n].
        colors: RGB, then `REST_GAIN` times the canonical coefficients above degree 0, [n, (degree + 1)^2, 3].
        blur: standard deviation added to every Gaussian: 0 in training, then `Supervision.missing_blur`, scalar.
    """

    means: nn.Parameter
    quats: nn.Parameter
    log_scales: nn.Parameter
    logit_opacities: nn.Parameter
    colors: nn.Parameter
    blur: Tensor

    def __init__(self, values: dict[str, Tensor], max_scale: float) -> None:
        super().__init__()
        for name in NAMES:
            self.register_parameter(name, nn.Parameter(values[name].detach().clone().float().contiguous()))
        self.max_log_scale = math.log(max_scale * OBJECT_DIAGONAL) if max_scale else math.inf
        self.register_buffer("blur", torch.zeros(()))

    @classmethod
    def from_state(cls, state: Mapping[str, Tensor], max_scale: float) -> "Gaussians":
        """Restore the attributes from the state of a model whose attribute ``gaussians`` they were; not the blur."""
        return cls({name: state[f"gaussians.{name}"] for name in NAMES}, max_scale)

    def __len__(self) -> int:
        return self.means.shape[0]

    def scales_log(self) -> Tensor:
        """Return the log scales under the cap, without the blur, [n, 3]."""
        return self.log_scales.clamp(max=self.max_log_scale)

    def scales(self, log_scales: Tensor) -> Tensor:
        """Return standard deviations with the blur, [n, 3] -> [n, 3]."""
        return ((2 * log_scales).exp() + self.blur.square()).sqrt()

    def opacities(self) -> Tensor:
        """Return opacities in (0, 1), [n]."""
        return self.logit_opacities.sigmoid()

    def rgb(self) -> Tensor:
        """Return the colour without harmonics, in [0, 1], [n, 3]."""
        return self.colors[:, 0].clamp(0.0, 1.0)

    def seen_rgb(self, means: Tensor, quats: Tensor, eye: Tensor, degree: int) -> Tensor:
        """Compute the colour from a viewpoint, whose direction is rotated into the canonical frame.

        Args:
            means: posed, no gradient, [n, 3].
            quats: posed, unit, no gradient, [n, 4].
            eye: camera centre in the same frame, [3].
            degree: of the harmonics in use.

        Returns:
            Not below 0, [n, 3].
        """
        if degree == 0:
            return self.rgb()
        if COLORS.takes(means, owner=self):
            return seen_rgb(self.colors, means, quats, self.quats, eye, degree, REST_GAIN)
        if gpu.on_gpu(means):
            return gpu.seen_rgb(self.colors, means, quats, self.quats, eye, degree, REST_GAIN)
        directions = normalize(means.detach() - eye.to(means), dim=-1)
        canonical = torch.einsum("na,nab->nb", directions, self.rotations_to(quats.detach()))
        values = basis(canonical, degree)[:, 1:] / REST_GAIN
        rest = torch.einsum("nk,nkc->nc", values, self.colors[:, 1 : (degree + 1) ** 2])
        return (self.colors[:, 0] + rest).clamp_min(0)

    def rotations_to(self, quats: Tensor) -> Tensor:
        """Return each Gaussian's rotation from rest to an orientation, [n, 4] -> [n, 3, 3]."""
        rest = normalize(self.quats.detach(), dim=-1)
        return quat_to_matrix(quat_multiply(quats, rest * constant((1.0, -1.0, -1.0, -1.0), rest)))

    def splat_colors(self, quats: Tensor) -> Tensor:
        """Return RGB or coefficients in the frame of unit ``quats`` [n, 4] for `Splats`, [n, (degree + 1)^2, 3]."""
        if self.colors.shape[1] == 1:
            return self.rgb()[:, None]
        constant = (self.colors[:, :1] - 0.5) / C0
        return rotated(torch.cat((constant, self.colors[:, 1:] / REST_GAIN), dim=1), self.rotations_to(quats))

    def splats(self) -> Splats:
        """Return the canonical Gaussians, activated, detached."""
        with torch.no_grad():
            return self.splats_at(self.means, self.quats, self.scales(self.scales_log()))

    def splats_at(self, means: Tensor, quats: Tensor, scales: Tensor) -> Splats:
        """Return posed Gaussians with the canonical opacities and colours; ``quats`` are normalised."""
        quats = normalize(quats, dim=-1)
        return Splats(means, quats, scales, self.opacities(), self.splat_colors(quats))


def start_surface(prior: Prior, config: Canonical, generator: torch.Generator) -> SurfaceSample:
    """Return the points of the rest surface that the settings start from."""
    return surface_vertices(prior) if config.start == "vertices" else sample_surface(prior, config.samples, generator)


def initial_gaussians(
    prior: Prior, config: Canonical, generator: torch.Generator, shape: bool = True
) -> dict[str, Tensor]:
    """Place flat Gaussians on the rest surface (METHOD section 3): radius sqrt(area / pi n), normal along the third
    axis.

    Without the shape: round ones anywhere in its bounding box, whose size is half the side of each one's share of it.

    Args:
        prior: its rest surface is sampled.
        config: number, thickness and opacity at the start.
        generator: the only source of randomness.
        shape: False uses only the prior's bounding box.

    Returns:
        The five attributes by name; colours are mid-grey.
    """
    if shape:
        surface = start_surface(prior, config, generator)
        means, quats = surface.points, quats_from_normals(surface.normals)
        scales = surface.radius * torch.tensor((1.0, 1.0, config.thickness))
    else:
        low, high = prior.vertices.float().aminmax(dim=0)
        means = low + (high - low) * torch.rand(config.samples, 3, generator=generator)
        quats = normalize(torch.randn(config.samples, 4, generator=generator), dim=-1)
        scales = 0.5 * ((high - low).prod() / config.samples) ** (1 / 3) * torch.ones(3)
    return attributes(means, quats, scales.log().expand(len(means), 3), 0.5, config)


def attributes(
    means: Tensor, quats: Tensor, log_scales: Tensor, rgb: Tensor | float, config: Canonical
) -> dict[str, Tensor]:
    """Return the five attributes of `Gaussians` by name, for centres [n, 3] of equal opacity and colours [n, 3]."""
    colors = torch.zeros(len(means), (config.sh_degree + 1) ** 2, 3)
    colors[:, 0] = rgb
    return {
        "means": means,
        "quats": quats,
        "log_scales": log_scales,
        "logit_opacities": torch.full((len(means),), math.log(config.opacity / (1 - config.opacity))),
        "colors": colors,
    }
