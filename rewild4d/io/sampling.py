"""Sample points of the surface of meshes and Gaussians, by a seed, on the CPU."""

import numpy as np
import torch
from torch import Tensor

from rewild4d.datasets.triangles import draw
from rewild4d.types import Splats

OPACITY = 0.1
"""A Gaussian fainter than this is not part of the surface."""


def sample_mesh(vertices: Tensor, faces: Tensor, count: int, seed: int) -> Tensor:
    """Return points uniform by area on a triangle mesh.

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
    points, rows = vertices.detach().cpu().double().numpy(), faces.cpu().numpy()
    chosen, shares = draw(points, rows, count, np.random.default_rng(seed))
    return torch.from_numpy(np.einsum("nk,nkd->nd", shares, points[rows[chosen]]))


def sample_gaussians(splats: Splats, count: int, seed: int, opacity: float = OPACITY) -> Tensor:
    """Return points that stand for the surface that Gaussians draw: their centres (METHOD section 8).

    The rule: Gaussians of at least the given opacity count, each with its centre; of more than ``count`` so many are
    drawn. Points spread over the ellipses instead would stand one deviation outside wherever Gaussians are round.
    Nothing is left out for being far from the rest: an image shows a floater too. The alignment's trimming deals with
    them.

    Args:
        splats: the Gaussians of one moment, activated values.
        count: most points.
        seed: the same seed draws the same points.
        opacity: the threshold, in [0, 1].

    Returns:
        float64, [m, 3], m <= count; [0, 3] where no Gaussian counts.
    """
    centers = splats.means[splats.opacities >= opacity].detach().cpu().double()
    if len(centers) <= count:
        return centers
    return centers[torch.from_numpy(np.sort(np.random.default_rng(seed).permutation(len(centers))[:count]))]
