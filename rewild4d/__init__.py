"""rewild4d: a benchmark for reconstructing 4D animals from one monocular video with 3D Gaussians."""

__version__ = "0.1.0"
