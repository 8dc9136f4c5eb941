"""Thread pool for kernels that release the GIL: survives fork, nests in any thread, follows torch's setting."""

import atexit
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from queue import SimpleQueue
from typing import Any

import numpy as np
import torch

from rewild4d.kernels.openmp import after_fork, let_idle_threads_go

_Job = tuple[Callable[..., Any], tuple[Any, ...], "_Outcome"] | None
"""None ends the worker that takes it."""


class _Outcome:
    def __init__(self) -> None:
        self.claim = threading.Lock()  # taken for good by whoever does the job
        self.done = threading.Lock()
        self.done.acquire()
        self.error: BaseException | None = None


_jobs: SimpleQueue[_Job] = SimpleQueue()
_workers: list[threading.Thread] = []
_growing = threading.Lock()


def _forget_workers() -> None:
    # A forked child inherits the queue but none of the threads.
    global _jobs, _workers, _growing
    _jobs, _workers, _growing = SimpleQueue(), [], threading.Lock()


def _end_workers() -> None:
    # A worker that wakes while the interpreter is torn down takes the process with it.
    for _ in _workers:
        _jobs.put(None)
    for worker in _workers:
        worker.join(timeout=5)
    _workers.clear()


after_fork(_forget_workers)
atexit.register(_end_workers)


def _work(jobs: "SimpleQueue[_Job]") -> None:
    while True:
        job = jobs.get()
        if job is None:
            return
        function, args, outcome = job
        if not outcome.claim.acquire(blocking=False):
            continue
        try:
            function(*args)
        except BaseException as error:  # handed to the caller, who raises it
            outcome.error = error
        outcome.done.release()


_own_count: int | None = None


def thread_count() -> int:
    """Return the number of threads to use: torch's own, or that of `set_kernel_threads`."""
    return _own_count or torch.get_num_threads()


def set_kernel_threads(count: int | None) -> int | None:
    """Set the kernels' number of threads apart from torch's (None: torch's); return the former.

    Kernels give the same bits on any number, torch does not.
    """
    global _own_count
    before, _own_count = _own_count, count
    return before


@contextmanager
def torch_on_one() -> Iterator[None]:
    """Let torch compute on one thread, and leave the others to the kernels.

    After a parallel operation torch's OpenMP threads spin for milliseconds and take cores from the next kernel.
    """
    threads = torch.get_num_threads()
    before = set_kernel_threads(thread_count())
    torch.set_num_threads(1)
    try:
        yield
    finally:
        set_kernel_threads(before)
        torch.set_num_threads(threads)


def run(function: Callable[..., Any], calls: Sequence[tuple[Any, ...]]) -> None:
    """Call a function once per argument tuple, all at the same time; raise the first error.

    The caller's thread takes the first call, then those that no worker has begun. Pass at most `thread_count` calls:
    each further one takes a thread.
    """
    if len(calls) > 1 and len(_workers) < len(calls) - 1:
        with _growing:
            while len(_workers) < len(calls) - 1:
                _workers.append(threading.Thread(target=_work, args=(_jobs,), daemon=True, name="rewild4d-raster"))
                _workers[-1].start()
    if len(calls) > 1:
        let_idle_threads_go()
    outcomes = [_Outcome() for _ in calls[1:]]
    for args, outcome in zip(calls[1:], outcomes, strict=True):
        _jobs.put((function, args, outcome))
    begun = outcomes
    try:
        if calls:
            function(*calls[0])
        begun = []
        for args, outcome in zip(calls[1:], outcomes, strict=True):
            if outcome.claim.acquire(blocking=False):
                function(*args)
            else:
                begun.append(outcome)
    finally:
        _wait(begun)


def run_tickets(kernel: Callable[..., Any], *args: Any, threads: int | None = None) -> None:
    """Run a kernel on all threads at once; its first argument, a shared counter, hands out the units of work."""
    run(kernel, [(np.zeros(1, np.int64), *args)] * (threads or thread_count()))


def _wait(outcomes: list[_Outcome]) -> None:
    for outcome in outcomes:
        outcome.done.acquire()
    for outcome in outcomes:
        if outcome.error is not None:
            raise outcome.error


def spans(total: int, parts: int) -> list[tuple[int, int]]:
    """Cut range(total) into at most ``parts`` non-empty pieces of nearly equal length."""
    parts = min(parts, total)
    return [(total * i // parts, total * (i + 1) // parts) for i in range(parts)]
