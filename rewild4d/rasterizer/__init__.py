"""The one rasterizer: 3D Gaussians to images, differentiable, see CONVENTIONS.md beside this file."""

from rewild4d.rasterizer.api import rasterize
from rewild4d.rasterizer.backends import BACKENDS, pick_rasterizer, set_default
from rewild4d.rasterizer.conventions import RasterInfo

__all__ = ["BACKENDS", "RasterInfo", "pick_rasterizer", "rasterize", "set_default"]
