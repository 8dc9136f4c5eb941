"""rewild4d: a benchmark for reconstructing 4D animals from one monocular video with 3D Gaussians."""

import os
import sys

# OpenMP threads that spin after their work take the cores from our own kernels. The runtime hears this only before
# torch is loaded; afterwards `kernels.openmp` lets the threads go instead.
if "torch" not in sys.modules:
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")

__version__ = "0.1.0"
