"""The oracle: dense torch, every Gaussian against every pixel, any float type, gradients by autograd.

It defines what the fast backends must compute. Time and memory grow with N x width x height: small scenes only.
"""

import torch
from torch import Tensor

from rewild4d.rasterizer.conventions import (
    FRUSTUM_MARGIN,
    MAX_ALPHA,
    MIN_ALPHA,
    MIN_COMPENSATION,
    MIN_TRANSMITTANCE,
    RasterInfo,
)
from rewild4d.transforms import quat_to_matrix


def rasterize(
    means: Tensor,
    quats: Tensor,
    scales: Tensor,
    opacities: Tensor,
    features: Tensor,
    world_to_camera: Tensor,
    intrinsics: Tensor,
    width: int,
    height: int,
    background: Tensor | None,
    eps2d: float,
    antialias: bool,
    near: float,
) -> tuple[Tensor, Tensor, RasterInfo]:
    """Same as `rewild4d.rasterizer.rasterize`, on checked input; ``background`` is [V, C]."""
    half = quat_to_matrix(quats) * scales[:, None, :]
    covariances = half @ half.mT
    projected = [
        _project(means, covariances, matrix, pinhole, width, height, eps2d)
        for matrix, pinhole in zip(world_to_camera, intrinsics, strict=True)
    ]
    means2d = torch.stack([one[0] for one in projected])
    if means2d.requires_grad:
        means2d.retain_grad()
    images, alphas, radii = [], [], []
    for view, (_, cov2d, depths, compensation) in enumerate(projected):
        visible_opacities = opacities * compensation if antialias else opacities
        radii.append(_radii(means2d[view], cov2d, depths, visible_opacities, width, height, near))
        image, alpha = _blend(means2d[view], cov2d, depths, visible_opacities, features, radii[view] > 0, width, height)
        if background is not None:
            image = image + (1 - alpha) * background[view][:, None, None]
        images.append(image)
        alphas.append(alpha)
    return torch.stack(images), torch.stack(alphas), RasterInfo(torch.stack(radii), means2d)


def _project(
    means: Tensor, covariances: Tensor, matrix: Tensor, pinhole: Tensor, width: int, height: int, eps2d: float
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Centres [N, 2], covariances [N, 2, 2] in pixels, depths [N] and the antialiasing factor [N] (EWA splatting)."""
    rotation = matrix[:3, :3]
    local = means @ rotation.T + matrix[:3, 3]
    depths = local[:, 2]
    safe = torch.where(depths.abs() < 1e-12, torch.full_like(depths, 1e-12), depths)
    focal, centre = torch.stack((pinhole[0, 0], pinhole[1, 1])), pinhole[:2, 2]
    ratio = local[:, :2] / safe[:, None]
    # Far outside the frame the linearisation is meaningless and huge; the limits are constants, as in gsplat.
    size = focal.new_tensor((width, height))
    margin = FRUSTUM_MARGIN * 0.5 * size / focal.detach()
    low, high = -(centre / focal).detach() - margin, ((size - centre) / focal).detach() + margin
    tangent = torch.minimum(torch.maximum(ratio, low), high)
    zero = torch.zeros_like(safe)
    jacobian = torch.stack(
        (
            torch.stack((focal[0] / safe, zero, -focal[0] * tangent[:, 0] / safe), dim=-1),
            torch.stack((zero, focal[1] / safe, -focal[1] * tangent[:, 1] / safe), dim=-1),
        ),
        dim=-2,
    )
    linear = jacobian @ rotation
    raw = linear @ covariances @ linear.mT
    blurred = raw + eps2d * torch.eye(2, dtype=raw.dtype, device=raw.device)
    compensation = (_det(raw) / _det(blurred)).clamp_min(MIN_COMPENSATION).sqrt()
    return ratio * focal + centre, blurred, depths, compensation


def _det(matrix: Tensor) -> Tensor:
    return matrix[:, 0, 0] * matrix[:, 1, 1] - matrix[:, 0, 1] * matrix[:, 1, 0]


@torch.no_grad()
def _radii(
    means2d: Tensor, cov2d: Tensor, depths: Tensor, opacities: Tensor, width: int, height: int, near: float
) -> Tensor:
    """Distance at which alpha falls to 1/255 along the longest axis, 0 where nothing can be drawn, [N]."""
    reach = 2 * (opacities / MIN_ALPHA).clamp_min(1).log()
    variance_x, variance_y = cov2d[:, 0, 0], cov2d[:, 1, 1]
    mean, spread = (variance_x + variance_y) / 2, (variance_x - variance_y) / 2
    longest = mean + (spread.square() + cov2d[:, 0, 1].square()).sqrt()
    extent = (reach[:, None] * torch.stack((variance_x, variance_y), dim=-1)).sqrt()
    size = means2d.new_tensor((width, height))
    inside = ((means2d + extent > 0) & (means2d - extent < size)).all(dim=-1)
    drawn = inside & (depths > near) & (reach > 0) & (_det(cov2d) > 0)
    return torch.where(drawn, (reach * longest).sqrt(), 0.0)


def _blend(
    means2d: Tensor,
    cov2d: Tensor,
    depths: Tensor,
    opacities: Tensor,
    features: Tensor,
    visible: Tensor,
    width: int,
    height: int,
) -> tuple[Tensor, Tensor]:
    """Front-to-back compositing of the visible Gaussians: premultiplied features [C, h, w] and alpha [1, h, w]."""
    chosen = visible.nonzero()[:, 0]
    chosen = chosen[depths.detach()[chosen].argsort(stable=True)]
    xx, xy, yy = cov2d[chosen, 0, 0], cov2d[chosen, 0, 1], cov2d[chosen, 1, 1]
    det = xx * yy - xy * xy
    columns = torch.arange(width, dtype=means2d.dtype, device=means2d.device) + 0.5
    rows = torch.arange(height, dtype=means2d.dtype, device=means2d.device) + 0.5
    dx = (columns - means2d[chosen, 0, None])[:, None, :]
    dy = (rows - means2d[chosen, 1, None])[:, :, None]
    quadratic = (yy / det)[:, None, None] * dx * dx + (xx / det)[:, None, None] * dy * dy
    power = -0.5 * quadratic + (xy / det)[:, None, None] * dx * dy
    alphas = (opacities[chosen, None, None] * power.exp()).clamp_max(MAX_ALPHA)
    alphas = torch.where(alphas >= MIN_ALPHA, alphas, 0.0)
    # Transmittance only falls, so "stopped before" is a threshold on its running product.
    open_ = (1 - alphas.detach()).cumprod(dim=0) > MIN_TRANSMITTANCE
    alphas = torch.where(open_, alphas, 0.0)
    transmittance = (
        torch.cat((torch.ones_like(dx[:1]).expand(1, height, width), (1 - alphas).cumprod(dim=0)))
        if len(chosen)
        else means2d.new_ones(1, height, width)
    )
    image = torch.einsum("nc,nhw->chw", features[chosen], alphas * transmittance[:-1])
    return image, 1 - transmittance[-1:]
