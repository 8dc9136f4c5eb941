"""Initial colours of the canonical Gaussians, from the input images where they project."""

import torch
from scipy.spatial import cKDTree
from torch import Tensor
from torch.nn.functional import grid_sample

from rewild4d.ours.model import Model
from rewild4d.ours.symmetry import Key, Supervision, Target
from rewild4d.transforms import mirror_points, quat_to_matrix


@torch.no_grad()
def initial_colors(model: Model, supervision: Supervision) -> Tensor:
    """Average the colour over the frames that see a Gaussian, [n, 3]; take the nearest mirrored one's where none does.

    A Gaussian counts as seen where its normal faces the camera and its pixel lies well inside the mask; occlusion is
    ignored.
    """
    own = model.gaussians
    weights = model.field.sample(model.field.probabilities(), own.means)
    total, count = torch.zeros_like(own.means), torch.zeros_like(own.means[:, :1])
    for frame in supervision.frames_of(1):  # of the others the pose under this key is not trained
        key = Key(1, 1, frame)
        pose = model.pose(supervision.code_times([key]), [key])
        posed = model.skin(weights, pose.quats[0], model.transforms(pose)[0])[1]
        colours, seen = project_colors(posed.means, quat_to_matrix(posed.quats)[..., 2], supervision.target(key))
        total, count = total + colours * seen[:, None], count + seen[:, None]
    known = count[:, 0] > 0
    if not known.any():
        return own.rgb().clone()
    colours = total / count.clamp_min(1)
    sources = torch.cat((own.means[known], mirror_points(own.means[known]))).cpu().numpy()
    _, nearest = cKDTree(sources).query(own.means[~known].cpu().numpy())
    colours[~known] = colours[known].repeat(2, 1)[torch.from_numpy(nearest).to(colours.device)]
    return colours


def project_colors(points: Tensor, normals: Tensor, target: Target) -> tuple[Tensor, Tensor]:
    """Read the colour of posed points [n, 3] in one image, and whether they are seen, by outward normals [n, 3]."""
    camera = target.camera
    pixels, depth = camera.project(points)
    grid = (pixels / points.new_tensor((camera.width, camera.height)) * 2 - 1)[None, None]
    values = grid_sample(torch.cat((target.rgb, target.mask))[None], grid, align_corners=False)[0, :, 0].T
    facing = ((camera.center.to(points) - points) * normals).sum(-1) > 0
    return values[:, :3] / values[:, 3:].clamp_min(1e-3), facing & (depth > 0) & (values[:, 3] > 0.9)
