"""Handle Ctrl-C: raise KeyboardInterrupt where it unwinds cleanly, else end the process at once."""

from __future__ import annotations

import os
import signal
import sys
from contextlib import contextmanager
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Iterator
    from types import CodeType, FrameType

STATUS = 130
"""Exit status after Ctrl-C, as in shells: 128 and the number of the signal."""
COMPILERS = ("numba", "llvmlite")
"""Packages that convert a KeyboardInterrupt to other errors, or print it and continue."""


def answer_interrupts(owner: CodeType, line: str = "") -> bool:
    """Install the handler of Ctrl-C in this process, where Python's own is in use.

    Args:
        owner: code of the function that catches the KeyboardInterrupt. While it does not run, modules are imported or
            numba compiles, the process ends at once instead.
        line: printed on standard error before such an end.

    Returns:
        Whether the handler is installed: not under nohup, which ignores Ctrl-C, and not outside the main thread.
    """

    def answer(number: int, frame: FrameType | None) -> None:
        while frame is not None and frame.f_code is not owner and not _swallows(frame):
            frame = frame.f_back
        if frame is not None and frame.f_code is owner:
            raise KeyboardInterrupt
        bar_is_shown = getattr(sys.modules.get("rewild4d.progress"), "is_shown", bool)  # it may not be imported yet
        os.write(2, ("\n" * bar_is_shown() + line).encode())
        os._exit(STATUS)

    if signal.getsignal(signal.SIGINT) is not signal.default_int_handler:
        return False
    try:
        signal.signal(signal.SIGINT, answer)
    except ValueError:  # another thread
        return False
    return True


def _swallows(frame: FrameType) -> bool:
    package = frame.f_globals.get("__name__", "").partition(".")[0]
    return frame.f_code.co_filename.startswith("<frozen importlib") or package in COMPILERS


@contextmanager
def kept_interrupts() -> Iterator[None]:
    """Keep the handler of Ctrl-C while something is imported that sets another one."""
    before = signal.getsignal(signal.SIGINT)
    try:
        yield
    finally:
        if signal.getsignal(signal.SIGINT) is not before:  # only the main thread can have changed it
            signal.signal(signal.SIGINT, before)


def block_interrupts(blocked: bool) -> None:
    """Block Ctrl-C for this thread and the processes that it starts, or unblock it."""
    if hasattr(signal, "pthread_sigmask"):  # Windows has none
        signal.pthread_sigmask(signal.SIG_BLOCK if blocked else signal.SIG_UNBLOCK, {signal.SIGINT})
