"""The gsplat backend (Apache-2.0, an optional package): for parity, and for very many Gaussians.

CONVENTIONS.md lists what differs in gsplat 1.5.3: the cap of alpha, the radii, no gradient for the intrinsics, and
atomic sums, whose last bits vary between runs.
"""

import gsplat

from rewild4d.rasterizer import reference
from rewild4d.rasterizer.conventions import RasterInfo, RasterInput, Rendered


def rasterize(given: RasterInput) -> Rendered:
    """Render like `rewild4d.rasterizer.rasterize`, on float32 CUDA input.

    Raises:
        ValueError: the intrinsics want a gradient.
    """
    if given.intrinsics.requires_grad:
        raise ValueError("backend 'gsplat': expected intrinsics without requires_grad, as it has no gradient for them.")
    if not len(given.means):
        return reference.rasterize(given)
    image, alpha, meta = gsplat.rasterization(
        *given[:9],  # Gaussians, cameras, width and height
        near_plane=given.near,
        eps2d=given.eps2d,
        sh_degree=None,
        packed=False,
        backgrounds=given.background,
        rasterize_mode="antialiased" if given.antialias else "classic",
    )
    means2d = meta["means2d"]
    if means2d.requires_grad:
        means2d.retain_grad()
    radii = meta["radii"].amax(dim=-1).to(given.means.dtype)
    return image.movedim(-1, 1), alpha.movedim(-1, 1), RasterInfo(radii, means2d)
