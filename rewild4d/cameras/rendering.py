"""Render Gaussians from a camera, for every score and picture."""

import torch
from torch import Tensor

from rewild4d.harmonics import seen_colors
from rewild4d.rasterizer import rasterize
from rewild4d.types import Camera, Splats


@torch.no_grad()
def render(splats: Splats, camera: Camera, device: torch.device | None = None) -> tuple[Tensor, Tensor]:
    """Render one view.

    Returns:
        Colour premultiplied by alpha [3, h, w] and alpha [1, h, w], float32 on the CPU.
    """
    device = device or splats.means.device
    colors, alpha, _ = rasterize(
        splats.means.to(device),
        splats.quats.to(device),
        splats.scales.to(device),
        splats.opacities.to(device),
        seen_colors(splats, camera.center).to(device),
        camera.world_to_camera[None].to(device, torch.float32),
        camera.intrinsics[None].to(device, torch.float32),
        camera.width,
        camera.height,
    )
    return colors[0].cpu(), alpha[0].cpu()
