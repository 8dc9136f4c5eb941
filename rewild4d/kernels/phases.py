"""Run kernels of several phases in one call: waking a second thread costs as much as a small phase.

Threads take tickets; one that finds none left waits for those that still work. Nobody waits for a thread that has not
begun, so one thread alone also finishes.
"""

import os
from typing import Any

import numpy as np
from llvmlite import ir
from numba.core import cgutils, types
from numba.core.typing import signature

from rewild4d.kernels.compiling import kernel
from rewild4d.kernels.simd import array_data, intrinsic

_LINE = 8
"""Counters (8 bytes) of a cache line."""
_PHASE = 3 * _LINE
PATIENCE = 1000
"""Checks before a waiting thread yields its core."""
_WORD = ir.IntType(64)


def phase_counters(phases: int) -> np.ndarray:
    """Allocate what the threads of one call share, int64."""
    return np.zeros(phases * _PHASE, np.int64)


@intrinsic
def _count_up(typing: Any, counters: Any, index: Any) -> Any:
    """Add one to a counter atomically, with acquire and release, and return its old value."""

    def generate(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        data = array_data(context, builder, sig.args[0], args[0])
        return builder.atomic_rmw("add", builder.gep(data, [args[1]]), ir.Constant(_WORD, 1), "acq_rel")

    return signature(types.int64, counters, types.intp), generate


@intrinsic
def _read(typing: Any, counters: Any, index: Any) -> Any:
    """Read a counter, with acquire."""

    def generate(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        data = array_data(context, builder, sig.args[0], args[0])
        return builder.load_atomic(builder.gep(data, [args[1]]), "acquire", 8)

    return signature(types.int64, counters, types.intp), generate


@intrinsic
def _yield_core(typing: Any) -> Any:
    """Let the system run another thread, where it has such a call."""

    def generate(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        if os.name == "posix":
            kind = ir.FunctionType(ir.IntType(32), [])
            builder.call(cgutils.get_or_insert_function(builder.module, kind, "sched_yield"), [])
        return context.get_dummy_value()

    return signature(types.void), generate


@kernel
def enter_phase(counters: np.ndarray, phase: int) -> None:
    """Announce that this thread may take tickets of a phase."""
    _count_up(counters, phase * _PHASE + _LINE)


@kernel
def phase_ticket(counters: np.ndarray, phase: int) -> int:
    """Take the next ticket of a phase, from 0."""
    return _count_up(counters, phase * _PHASE)


@kernel
def end_phase(counters: np.ndarray, phase: int) -> None:
    """Wait for all that may hold a ticket of a phase; for a thread that found none left."""
    first, looks = phase * _PHASE, 0
    _count_up(counters, first + 2 * _LINE)
    while _read(counters, first + 2 * _LINE) < _read(counters, first + _LINE):
        looks += 1
        if looks > PATIENCE:
            _yield_core()
