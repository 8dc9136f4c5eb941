"""The one rasterizer: 3D Gaussians to images, differentiable, see CONVENTIONS.md beside this file."""

from rewild4d.rasterizer.api import RasterInfo, rasterize

__all__ = ["RasterInfo", "rasterize"]
