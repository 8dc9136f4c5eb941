"""The reference backend in dense torch: every Gaussian at every pixel, any float type, gradients by autograd.

It defines what the fast backends compute. Time and memory grow with N x width x height: small scenes only.
"""

import torch
from torch import Tensor

from rewild4d.rasterizer import ewa
from rewild4d.rasterizer.conventions import MAX_ALPHA, MIN_ALPHA, MIN_TRANSMITTANCE, RasterInfo, RasterInput, Rendered
from rewild4d.transforms import quat_to_matrix


def rasterize(given: RasterInput) -> Rendered:
    """Render like `rewild4d.rasterizer.rasterize`."""
    means, quats, scales, opacities, features, world_to_camera, intrinsics, width, height, background, *_ = given
    identity = quats.new_tensor((1.0, 0.0, 0.0, 0.0))
    quats = torch.where((quats == 0).all(-1, keepdim=True), identity, quats)
    half = quat_to_matrix(quats) * scales[:, None, :]
    covariances = half @ half.mT
    projected = [
        ewa.project(means, covariances, matrix, pinhole, width, height, given.eps2d)
        for matrix, pinhole in zip(world_to_camera, intrinsics, strict=True)
    ]
    means2d = torch.stack([one[0] for one in projected])
    if means2d.requires_grad:
        means2d.retain_grad()
    images, alphas, radii = [], [], []
    for view, (_, cov2d, depths, compensation) in enumerate(projected):
        visible_opacities = opacities * compensation if given.antialias else opacities
        radii.append(ewa.radii(means2d[view], cov2d, depths, visible_opacities, width, height, given.near))
        image, alpha = _blend(means2d[view], cov2d, depths, visible_opacities, features, radii[view] > 0, width, height)
        if background is not None:
            image = image + (1 - alpha) * background[view][:, None, None]
        images.append(image)
        alphas.append(alpha)
    return torch.stack(images), torch.stack(alphas), RasterInfo(torch.stack(radii), means2d)


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
    """Composite the visible Gaussians front to back: premultiplied features [C, h, w] and alpha [1, h, w]."""
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
    # transmittance only falls, so a closed pixel is a threshold on its running product
    open_ = (1 - alphas.detach()).cumprod(dim=0) > MIN_TRANSMITTANCE
    alphas = torch.where(open_, alphas, 0.0)
    transmittance = torch.cat((means2d.new_ones(1, height, width), (1 - alphas).cumprod(dim=0)))
    image = torch.einsum("nc,nhw->chw", features[chosen], alphas * transmittance[:-1])
    return image, 1 - transmittance[-1:]
