"""Compile and cache the CPU kernels."""

import hashlib
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

import numba
from numba.core.codegen import get_host_cpu_features

from rewild4d.files import cache_folder


@cache
def _sources_digest(folder: Path) -> str:
    # numba looks at the time stamp of one function's own file; helpers and constants live in others.
    sha = hashlib.sha256()
    for path in (*sorted(Path(__file__).parent.glob("*.py")), *sorted(folder.glob("*.py"))):
        sha.update(path.read_bytes())
    return sha.hexdigest()[:16]


_config: Any = numba.config
_CACHE = Path(_config.CACHE_DIR or cache_folder() / "kernels")


@cache
def compiled_for(feature: str) -> bool:
    """Whether kernels may use a feature of the processor, by LLVM's name ("avx512f").

    By default those of this machine; NUMBA_CPU_NAME, NUMBA_CPU_FEATURES and NUMBA_ENABLE_AVX choose others.
    """
    chosen = _config.CPU_FEATURES
    return f"+{feature}" in (get_host_cpu_features() if chosen is None else chosen).split(",")


def inlined(function: Callable[..., Any]) -> Callable[..., Any]:
    """Compile a function that is copied into each caller: a call that passes arrays costs a hundred cycles."""
    return _compiled(function, {"inline": "always"})


def kernel(function: Callable[..., Any]) -> Callable[..., Any]:
    """Compile a function on its first call, without the GIL, and keep the machine code in the cache folder.

    It may call kernels of its own folder and of this one, whose sources decide the cache; constants from elsewhere must
    never change. Without a writable cache folder it is compiled in every process.
    """
    return _compiled(function, {})


def _compiled(function: Callable[..., Any], more: dict[str, Any]) -> Callable[..., Any]:
    options: dict[str, Any] = {"nogil": True, "error_model": "numpy", **more}
    before = _config.CACHE_DIR
    _config.CACHE_DIR = str(_CACHE / _sources_digest(Path(function.__code__.co_filename).parent))
    try:
        return numba.njit(cache=True, **options)(function)
    except (RuntimeError, OSError):
        return numba.njit(**options)(function)
    finally:
        _config.CACHE_DIR = before
