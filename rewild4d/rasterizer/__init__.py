"""The one differentiable rasterizer every method renders with."""
