"""End torch's idle OpenMP threads: they wait by spinning, and so take cores from our kernels."""

import ctypes
import os
from collections.abc import Callable
from functools import cache

import torch

_SOFT = 1
"""omp_pause_soft: end the threads, keep the settings, start threads anew when needed."""
_FORK_WITHOUT_EXEC = 0x40
"""Linux's PF_FORKNOEXEC."""


def after_fork(call: Callable[[], None]) -> None:
    """Call a function in every child that is forked from this process; Windows has no forks."""
    if hasattr(os, "register_at_fork"):
        os.register_at_fork(after_in_child=call)


def _was_forked() -> bool:
    """Tell whether this process began as a fork, possibly before this module was imported."""
    try:
        with open("/proc/self/stat", encoding="utf-8", errors="replace") as stat:
            flags = int(stat.read().rpartition(")")[2].split()[6])
    except OSError:
        return False
    return bool(flags & _FORK_WITHOUT_EXEC)


_forked = _was_forked()


def _mark_fork() -> None:
    # A forked child has the parent's list of threads and none of them: the runtime would wait for them for ever.
    global _forked
    _forked = True


after_fork(_mark_fork)


@cache
def _pause() -> Callable[[int], int] | None:
    """Return `omp_pause_resource_all` (OpenMP 5.0) of torch's runtime, if it has one."""
    try:
        return ctypes.CDLL(torch._C.__file__).omp_pause_resource_all
    except (AttributeError, OSError):
        return None


def let_idle_threads_go() -> None:
    """End the threads that torch keeps for the caller's parallel operations; the next operation starts new ones.

    GNU's runtime spins for milliseconds after an operation. Nothing is done where threads do not spin
    (OMP_WAIT_POLICY=PASSIVE, see `rewild4d/__init__.py`), where torch uses one thread, or in a forked process.
    """
    passive = os.environ.get("OMP_WAIT_POLICY", "").upper() == "PASSIVE"
    if passive or _forked or torch.get_num_threads() == 1:
        return
    pause = _pause()
    if pause is not None:
        pause(_SOFT)
