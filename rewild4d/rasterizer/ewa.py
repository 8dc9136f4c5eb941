"""EWA projection in differentiable torch, for one camera or a batch of them, for the reference backend."""

import torch
from torch import Tensor

from rewild4d.rasterizer.conventions import FRUSTUM_MARGIN, MIN_ALPHA, MIN_COMPENSATION


def project(
    means: Tensor,
    covariances: Tensor,
    world_to_camera: Tensor,
    intrinsics: Tensor,
    width: int,
    height: int,
    eps2d: float,
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Project means [N, 3] and covariances [N, 3, 3] by cameras [..., 4, 4] and [..., 3, 3].

    Returns:
        Centres [..., N, 2] and covariances [..., N, 2, 2] in pixels, with ``eps2d`` added to both variances; depths and
        antialiasing factors [..., N].
    """
    rotation = world_to_camera[..., :3, :3]
    local = means @ rotation.mT + world_to_camera[..., None, :3, 3]
    depths = local[..., 2]
    safe = torch.where(depths.abs() < 1e-12, torch.full_like(depths, 1e-12), depths)
    focal = torch.stack((intrinsics[..., 0, 0], intrinsics[..., 1, 1]), dim=-1)[..., None, :]
    centre = intrinsics[..., None, :2, 2]
    ratio = local[..., :2] / safe[..., None]
    # the linearisation diverges far outside the frame; the limits are constants, as in gsplat
    size = focal.new_tensor((width, height))
    margin = FRUSTUM_MARGIN * 0.5 * size / focal.detach()
    low, high = -(centre / focal).detach() - margin, ((size - centre) / focal).detach() + margin
    tangent = torch.minimum(torch.maximum(ratio, low), high)
    zero = torch.zeros_like(safe)
    jacobian = torch.stack(
        (
            torch.stack((focal[..., 0] / safe, zero, -focal[..., 0] * tangent[..., 0] / safe), dim=-1),
            torch.stack((zero, focal[..., 1] / safe, -focal[..., 1] * tangent[..., 1] / safe), dim=-1),
        ),
        dim=-2,
    )
    linear = (jacobian.flatten(-3, -2) @ rotation).unflatten(-2, (len(means), 2))
    raw = linear @ covariances @ linear.mT
    blurred = raw + eps2d * torch.eye(2, dtype=raw.dtype, device=raw.device)
    compensation = (determinant(raw) / determinant(blurred)).clamp_min(MIN_COMPENSATION).sqrt()
    return ratio * focal + centre, blurred, depths, compensation


def determinant(matrix: Tensor) -> Tensor:
    """Return the determinants of 2 x 2 matrices, [..., 2, 2] -> [...]."""
    return matrix[..., 0, 0] * matrix[..., 1, 1] - matrix[..., 0, 1] * matrix[..., 1, 0]


@torch.no_grad()
def radii(
    centres: Tensor, cov2d: Tensor, depths: Tensor, opacities: Tensor, width: int, height: int, near: float
) -> Tensor:
    """Return the distance in pixels along the longest axis at which a Gaussian's alpha falls to 1/255, [..., N].

    It is 0 where nothing is drawn. Centres, covariances and depths are those of `project`; opacities include the
    antialiasing factor.
    """
    squared = 2 * (opacities / MIN_ALPHA).clamp_min(1).log()
    variance_x, variance_y = cov2d[..., 0, 0], cov2d[..., 1, 1]
    mean, spread = (variance_x + variance_y) / 2, (variance_x - variance_y) / 2
    longest = mean + (spread.square() + cov2d[..., 0, 1].square()).sqrt()
    extents = (squared[..., None] * torch.stack((variance_x, variance_y), dim=-1)).sqrt()
    size = centres.new_tensor((width, height))
    inside = ((centres + extents > 0) & (centres - extents < size)).all(dim=-1)
    drawn = inside & (depths > near) & (squared > 0) & (determinant(cov2d) > 0)
    return torch.where(drawn, (squared * longest).sqrt(), 0.0)
