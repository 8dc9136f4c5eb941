"""rewild4d: a benchmark for reconstructing 4D animals from one monocular video with 3D Gaussians."""

import os

# OpenMP threads that spin after their work take the cores from our own kernels; only heard before torch is loaded.
os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")

__version__ = "0.1.0"
