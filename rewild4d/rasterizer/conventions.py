"""Constants of blending, shared by all backends (gsplat's values), and a backend's input and output.

See CONVENTIONS.md.
"""

from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

MIN_ALPHA = 1.0 / 255.0
"""A Gaussian weaker than this at a pixel is skipped there."""
MAX_ALPHA = 0.99
"""Largest alpha of one Gaussian; above it opacity, position and shape get no gradient."""
MIN_TRANSMITTANCE = 1e-4
"""A pixel is closed before the Gaussian that would reduce its transmittance to this value or below."""

EPS2D = 0.3
"""Variance in square pixels that is added to every projected Gaussian (3DGS)."""
FRUSTUM_MARGIN = 0.3
"""The projection's Jacobian is taken at most this share of half the image outside the frame."""
MIN_COMPENSATION = 1e-8
"""Least det(Σ) / det(Σ + eps2d I) under ``antialias``, so that the square root's derivative is finite."""


@dataclass(frozen=True)
class RasterInfo:
    """Info that densification needs.

    Attributes:
        radii: largest distance in pixels from its centre at which a Gaussian is drawn (where its alpha falls to 1/255);
            0 where it is not visible. float, no gradient, [V, N].
        means2d: projected centres in pixels (pixel centres at +0.5); after ``backward`` its ``.grad`` holds the loss's
            gradient per pixel moved. [V, N, 2].
    """

    radii: Tensor
    means2d: Tensor


Rendered = tuple[Tensor, Tensor, RasterInfo]
"""Features [V, C, height, width], alpha [V, 1, height, width], and info for densification."""

Options = tuple[int, int, float, bool, float]
"""Width, height, eps2d, antialias, near."""


def camera_gradients(totals: Tensor, world_to_camera: Tensor, intrinsics: Tensor) -> tuple[Tensor, Tensor]:
    """Return gradients of both from [V, 16]: the upper three rows of world_to_camera, then fx, fy, cx, cy."""
    v_world_to_camera, v_intrinsics = torch.zeros_like(world_to_camera), torch.zeros_like(intrinsics)
    v_world_to_camera[:, :3] = totals[:, :12].view(-1, 3, 4).to(world_to_camera)
    v_intrinsics[:, (0, 1, 0, 1), (0, 1, 2, 2)] = totals[:, 12:].to(intrinsics)
    return v_world_to_camera, v_intrinsics


class RasterInput(NamedTuple):
    """Checked arguments of `rewild4d.rasterizer.rasterize`, as every backend takes them; ``background`` is [V, C]."""

    means: Tensor
    quats: Tensor
    scales: Tensor
    opacities: Tensor
    features: Tensor
    world_to_camera: Tensor
    intrinsics: Tensor
    width: int
    height: int
    background: Tensor | None
    eps2d: float
    antialias: bool
    near: float

    @property
    def options(self) -> Options:
        """All that is no tensor."""
        return self.width, self.height, self.eps2d, self.antialias, self.near
