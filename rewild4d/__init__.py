"""rewild4d: a benchmark for reconstructing 4D animals from one monocular video with 3D Gaussians.

`import rewild4d as rw` offers the functions of `rewild4d.api`, each imported when it is first used.
"""

import os
import sys
from typing import Any

# OpenMP threads that spin after their work take the cores from our own kernels. The runtime hears this only before
# torch is loaded; afterwards `kernels.openmp` lets the threads go instead.
if "torch" not in sys.modules:
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")

__version__ = "0.1.0"

API = (
    "LoadedCase",
    "case_from_frames",
    "evaluate",
    "fit",
    "items",
    "load_case",
    "plot",
    "records",
    "render",
    "with_settings",
)


def __getattr__(name: str) -> Any:
    if name not in API:
        raise AttributeError(f"module 'rewild4d' has no attribute '{name}'")
    from rewild4d import api

    return getattr(api, name)


def __dir__() -> list[str]:
    return sorted([*globals(), *API])
