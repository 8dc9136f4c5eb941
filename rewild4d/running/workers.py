"""Run parts of a plan in processes of their own: one that is killed loses only its part."""

import multiprocessing
import os
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, ThreadPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from queue import SimpleQueue
from threading import Event, Thread
from typing import Any, NamedTuple, TypeVar

import torch

from rewild4d.kernels.threads import set_kernel_threads
from rewild4d.rasterizer import set_default
from rewild4d.running.interrupts import answer_interrupts, block_interrupts

T = TypeVar("T")
MOST_THREADS = 4
"""Most threads of the kernels of one fit, unless asked for."""


class Threads(NamedTuple):
    """Threads of one process: torch's, which change last digits, and our kernels', which change nothing."""

    torch: int
    kernels: int


def usable_cores(device: torch.device) -> int:
    """Return how many processes a device can keep busy: one for each usable core, one for each GPU."""
    if device.type == "cuda":
        return 1 if device.index is not None else max(1, torch.cuda.device_count())
    if hasattr(os, "sched_getaffinity"):  # Linux alone can tell which cores a process may use
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def share_cores(threads: int, fits: int, device: torch.device) -> Threads:
    """Choose the threads of each process where so many fits run at a time: kernels use the cores that no fit needs."""
    cores = 1 if device.type == "cuda" else usable_cores(device)
    return Threads(threads, max(threads, min(cores // max(fits, 1), MOST_THREADS)))


@contextmanager
def this_process(threads: Threads, rasterizer: str) -> Iterator[None]:
    """Work in this process with a worker's settings."""
    before = _settle(threads, rasterizer)
    try:
        yield
    finally:
        set_kernel_threads(before)


def _settle(threads: Threads, rasterizer: str) -> int | None:
    """Set up this process, and return the previous number of its kernels' threads."""
    torch.set_num_threads(threads.torch)
    set_default(rasterizer)
    return set_kernel_threads(threads.kernels)


class Workers:
    """Processes side by side, each with threads of its own and one of ``gpus``; they end with the `with` block.

    Each is a pool of one: a pool of several is lost as a whole when one of its processes dies.
    """

    def __init__(self, jobs: int, threads: Threads, rasterizer: str, gpus: int = 0) -> None:
        self._jobs, self._setup, self._gpus = jobs, (threads, rasterizer), gpus
        self._free: SimpleQueue[tuple[int, ProcessPoolExecutor]] = SimpleQueue()
        for number in range(jobs):
            self._free.put((number, self._pool(number)))

    def __enter__(self) -> "Workers":
        return self

    def __exit__(self, *error: object) -> None:
        for _ in range(self._jobs):
            self._free.get()[1].shutdown()

    def map(self, function: Callable[..., T], pieces: Sequence[tuple[Any, ...]], lost: Callable[..., T]) -> list[T]:
        """Return function(*piece) in the order of the pieces; an exception of a call ends the map.

        Args:
            function: called in a worker.
            pieces: arguments of each call.
            lost: called here with a piece whose process died; its result is used instead.
        """

        stopped = Event()

        def work(piece: tuple[Any, ...]) -> T:
            number, pool = self._free.get()
            try:
                return pool.submit(_piece, function, piece).result()
            except BrokenProcessPool:
                pool.shutdown()
                pool = self._pool(number)
                if stopped.wait(0.5):  # Ctrl-C reaches all processes of a terminal, and a worker may end first
                    raise KeyboardInterrupt from None
                return lost(*piece)
            finally:
                self._free.put((number, pool))

        with ThreadPoolExecutor(self._jobs, initializer=block_interrupts, initargs=(True,)) as threads:
            try:
                return list(threads.map(work, pieces))
            except KeyboardInterrupt:
                stopped.set()
                raise

    def _pool(self, number: int) -> ProcessPoolExecutor:
        """Return a process that starts with its first piece; processes take the GPUs in turn."""
        gpu = number % self._gpus if self._gpus > 1 else None
        return ProcessPoolExecutor(1, multiprocessing.get_context("spawn"), start_worker, (*self._setup, gpu))


def _piece(function: Callable[..., T], piece: tuple[Any, ...]) -> T:
    return function(*piece)


def start_worker(threads: Threads, rasterizer: str, gpu: int | None = None) -> None:
    """Set up a worker that ends with its parent: an orphan would write into the folder of the next start.

    On a machine with several GPUs "cuda" is ``gpu`` in this process.
    """
    answer_interrupts(_piece.__code__)
    block_interrupts(False)  # an interpreter that starts prints pages about it
    _settle(threads, rasterizer)
    if gpu is not None:
        torch.cuda.set_device(gpu)

    def watch() -> None:
        parent = multiprocessing.parent_process()  # not os.getppid: on Windows the number stays when the parent ends
        assert parent is not None
        parent.join()
        os._exit(1)

    Thread(target=watch, daemon=True).start()
