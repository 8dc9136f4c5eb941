"""Initial colours of the canonical Gaussians, from the input images that show them."""

import torch
from scipy.spatial import cKDTree
from torch import Tensor
from torch.nn.functional import grid_sample, normalize

from rewild4d.ours.evidence import visible_share
from rewild4d.ours.losses.skin import third_axes
from rewild4d.ours.model import Model, sightings
from rewild4d.ours.symmetry import Supervision, Target
from rewild4d.transforms import mirror_points

SEEN = 0.1
"""Summed weight of the frames from which on a Gaussian counts as seen."""


@torch.no_grad()
def initial_colors(model: Model, supervision: Supervision) -> Tensor:
    """Average the colour over the frames that show a Gaussian, [n, 3]; take the nearest one's that is seen, or whose
    mirror image is, where none does.

    A frame weighs the share of the Gaussian that it draws, times the cosine between its normal and the line of sight.
    """
    own = model.gaussians
    total, count = torch.zeros_like(own.means), torch.zeros_like(own.means[:, :1])
    for sighting in sightings(model, supervision):
        posed, target = sighting.posed, supervision.target(sighting.key)
        colours, weights = project_colors(posed.means, third_axes(posed.quats), target)
        weights = (weights * visible_share(posed, own, target.camera))[:, None]
        total, count = total + colours * weights, count + weights
    known = count[:, 0] > SEEN
    if not known.any():
        return own.rgb().clone()
    colours = total / count.clamp_min(SEEN)
    sources = torch.cat((own.means[known], mirror_points(own.means[known]))).cpu().numpy()
    _, nearest = cKDTree(sources).query(own.means[~known].cpu().numpy())
    colours[~known] = colours[known].repeat(2, 1)[torch.from_numpy(nearest).to(colours.device)]
    return colours


def project_colors(points: Tensor, normals: Tensor, target: Target) -> tuple[Tensor, Tensor]:
    """Read the colour of posed points [n, 3] in one image, and the cosine between outward normals [n, 3] and the line
    of sight, 0 where they face away or their pixel is not well inside the mask, [n]."""
    camera = target.camera
    pixels, depth = camera.project(points)
    grid = (pixels / points.new_tensor((camera.width, camera.height)) * 2 - 1)[None, None]
    values = grid_sample(torch.cat((target.rgb, target.mask))[None], grid, align_corners=False)[0, :, 0].T
    cosine = (normalize(camera.center.to(points) - points, dim=-1) * normals).sum(-1).clamp_min(0)
    return values[:, :3] / values[:, 3:].clamp_min(1e-3), cosine * (depth > 0) * (values[:, 3] > 0.9)
