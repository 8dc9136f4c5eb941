"""Choose the backend: what each needs, what `auto` picks, and the default of this process."""

import importlib
import logging
import os
import shutil
from collections.abc import Callable
from functools import cache

import torch

from rewild4d.errors import UserError, unknown_name
from rewild4d.rasterizer.conventions import RasterInput, Rendered

logger = logging.getLogger(__name__)

MODULES = {"numba": "cpu", "triton": "cuda", "gsplat": "gsplat_backend", "reference": "reference"}
"""Modules of this folder, imported on first use, since Triton and gsplat are optional."""
BACKENDS = ("auto", *MODULES)
CHECK_VALUES = ("triton",)
"""Backends whose kernels check the values: a separate check would wait for the GPU."""
_default = "auto"


def set_default(name: str) -> None:
    """Set what ``backend="auto"`` means in this process, for tensors that the backend takes.

    For others, such as those of the prior's fit on the CPU, `auto` picks the fastest as before.

    Raises:
        UserError: no backend of that name.
    """
    global _default
    if name not in BACKENDS:
        raise unknown_name("rasterizer", name, BACKENDS)
    _default = name


def pick_rasterizer(name: str, device: torch.device) -> str:
    """Return the backend that renders float32 on a device: the named one, or the one that "auto" picks.

    Raises:
        UserError: unknown, or it cannot be used here.
    """
    if name not in BACKENDS:
        raise unknown_name("rasterizer", name, BACKENDS)
    if name == "auto":
        return _automatic(device.type, torch.float32)
    if reason := _unfit(name, device, torch.float32):
        raise UserError(f"--rasterizer {name}: {reason}.")
    return name


def resolve(backend: str, device: torch.device, dtype: torch.dtype) -> str:
    """Return the name of the backend that renders such tensors.

    Raises:
        ValueError: unknown, or it cannot render them here.
    """
    if backend not in BACKENDS:
        raise ValueError(f"backend: expected one of {', '.join(BACKENDS)}, got '{backend}'.")
    if backend == "auto":
        chosen = _default != "auto" and not _unfit(_default, device, dtype)
        return _default if chosen else _automatic(device.type, dtype)
    if reason := _unfit(backend, device, dtype):
        raise ValueError(f"backend '{backend}': {reason}.")
    return backend


@cache
def load(name: str) -> Callable[[RasterInput], Rendered]:
    """Return the `rasterize` of a backend."""
    return importlib.import_module(f"rewild4d.rasterizer.{MODULES[name]}").rasterize


@cache  # also logs the choice only once
def _automatic(kind: str, dtype: torch.dtype) -> str:
    """Return the fastest backend that takes tensors of a device type; the reference takes all."""
    fast = {"cpu": ("numba",), "cuda": ("triton", "gsplat")}.get(kind, ())
    reasons = {name: _unfit(name, torch.device(kind), dtype) for name in fast}
    name = next((name for name, reason in reasons.items() if not reason), "reference")
    if name == "reference" and kind == "cuda" and dtype == torch.float32:
        logger.warning("rendering with the reference, for small scenes only: %s", "; ".join(reasons.values()))
    else:
        logger.info("%s on %s renders with %s", dtype, kind, name)
    return name


def _unfit(name: str, device: torch.device, dtype: torch.dtype) -> str:
    """Return the reason why a backend cannot render such tensors here; empty where it can."""
    single, got = dtype == torch.float32, f"got {dtype} on {device}"
    if name == "reference" or (name == "numba" and single and device.type == "cpu"):
        return ""
    if name == "numba":
        return f"expected float32 on the CPU, {got}"
    if reason := _missing(name):
        return reason
    interpreted = name == "triton" and os.environ.get("TRITON_INTERPRET") == "1"
    if not (single and (device.type == "cuda" or interpreted)):
        hint = ", or TRITON_INTERPRET=1 in the environment" if name == "triton" else ""
        return f"expected float32 on a CUDA GPU{hint}, {got}"
    if name == "triton" and not (interpreted or _compiler()):
        return "Triton needs a C compiler (gcc or clang) and finds none"
    return ""


def _missing(package: str) -> str:
    """Return the reason why a package cannot be imported; empty where it can."""
    try:
        importlib.import_module(package)
    except (ImportError, OSError, RuntimeError) as error:
        if isinstance(error, ModuleNotFoundError) and error.name == package:
            return f"{package} is not installed here (pip install -e '.[{package}]')"
        return f"{package} cannot be imported: {error}"
    return ""


@cache
def _compiler() -> str | None:
    return os.environ.get("CC") or shutil.which("gcc") or shutil.which("clang")
