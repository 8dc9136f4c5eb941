"""gsplat (Apache-2.0, an optional package) behind the same function: for parity, and for very many Gaussians.

What differs in gsplat 1.5.3 stands in CONVENTIONS.md: the cap of alpha, the radii, no gradient for the intrinsics, and
sums that are added atomically, so that the last bits vary between runs.
"""

import gsplat
from torch import Tensor

from rewild4d.rasterizer import reference
from rewild4d.rasterizer.conventions import RasterInfo


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
    """Same as `rewild4d.rasterizer.rasterize`, on checked float32 CUDA input; ``background`` is [V, C].

    Raises:
        ValueError: the intrinsics want a gradient.
    """
    if intrinsics.requires_grad:
        raise ValueError("backend 'gsplat': expected intrinsics without requires_grad, as it has no gradient for them.")
    cameras = (world_to_camera, intrinsics, width, height)
    if not len(means):
        return reference.rasterize(
            means, quats, scales, opacities, features, *cameras, background, eps2d, antialias, near
        )
    image, alpha, meta = gsplat.rasterization(
        means,
        quats,
        scales,
        opacities,
        features,
        *cameras,
        near_plane=near,
        eps2d=eps2d,
        sh_degree=None,
        packed=False,
        backgrounds=background,
        rasterize_mode="antialiased" if antialias else "classic",
    )
    means2d = meta["means2d"]
    if means2d.requires_grad:
        means2d.retain_grad()
    radii = meta["radii"].amax(dim=-1).to(means.dtype)
    return image.movedim(-1, 1), alpha.movedim(-1, 1), RasterInfo(radii, means2d)
