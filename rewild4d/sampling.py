"""From meshes and Gaussians to points of their surface: what geometry is compared by. Drawn by a seed, on the CPU."""

import numpy as np
import torch
from torch import Tensor

from rewild4d.transforms import quat_to_matrix
from rewild4d.types import Splats

OPACITY = 0.1
"""A Gaussian fainter than this is not part of the surface."""


def sample_mesh(vertices: Tensor, faces: Tensor, count: int, seed: int) -> Tensor:
    """Points uniform by area on a triangle mesh.

    Args:
        vertices: [v, 3].
        faces: vertex indices, at least one triangle with an area, [f, 3].
        count: points to draw.
        seed: the same seed draws the same points.

    Returns:
        float64, [count, 3].

    Raises:
        ValueError: no triangle has an area.
    """
    rng = np.random.default_rng(seed)
    corners = vertices.detach().cpu().double().numpy()[faces.cpu().numpy()]
    cross = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    ends = np.cumsum(np.linalg.norm(cross, axis=1))
    if not len(ends) or not 0 < ends[-1] < np.inf:
        raise ValueError(f"expected triangles with an area, got {len(ends)} triangles without")
    chosen = corners[_draw(ends, count, rng)]
    root, along = np.sqrt(rng.random(count)), rng.random(count)
    shares = np.stack((1 - root, root * (1 - along), root * along), axis=1)
    return torch.from_numpy(np.einsum("nk,nkd->nd", shares, chosen))


def sample_gaussians(splats: Splats, count: int, seed: int, opacity: float = OPACITY) -> Tensor:
    """Points that stand for the surface that Gaussians draw.

    The rule: Gaussians of at least the given opacity count. A point falls on one with a chance proportional to its
    opacity times its area (product of its two largest scales), and there uniformly into the ellipse of one standard
    deviation that its two largest axes span. Nothing is left out for being far from the rest: an image shows a floater
    too. The alignment's trimming deals with them.

    Args:
        splats: the Gaussians of one moment, activated values.
        count: points to draw.
        seed: the same seed draws the same points.
        opacity: the threshold, in [0, 1].

    Returns:
        float64, [count, 3]; [0, 3] where no Gaussian counts.
    """
    kept = splats.opacities >= opacity
    means, quats, scales, opacities = (
        value[kept].detach().cpu().double() for value in (splats.means, splats.quats, splats.scales, splats.opacities)
    )
    order = scales.argsort(dim=1, descending=True, stable=True)[:, :2]
    spans = scales.gather(1, order)
    ends = np.cumsum((spans.prod(dim=1) * opacities).numpy())
    if not len(ends) or not 0 < ends[-1] < np.inf:
        return torch.empty(0, 3, dtype=torch.float64)
    rng = np.random.default_rng(seed)
    rows = torch.from_numpy(_draw(ends, count, rng))
    radius, angle = np.sqrt(rng.random(count)), 2 * np.pi * rng.random(count)
    flat = torch.from_numpy(np.stack((radius * np.cos(angle), radius * np.sin(angle)), axis=1)) * spans[rows]
    axes = quat_to_matrix(quats[rows]).gather(2, order[rows][:, None, :].expand(-1, 3, -1))
    return means[rows] + torch.einsum("nak,nk->na", axes, flat)


def _draw(ends: np.ndarray, count: int, rng: np.random.Generator) -> np.ndarray:
    """Rows drawn with chances proportional to the steps of a rising sum, [count]."""
    return np.searchsorted(ends, rng.random(count) * ends[-1], side="right").clip(max=len(ends) - 1)
