"""Ctrl-C: a KeyboardInterrupt where it unwinds cleanly, an end at once where libraries would swallow or print it."""

from __future__ import annotations

import os
import signal
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from types import CodeType, FrameType

STATUS = 130
"""Exit status after Ctrl-C, as shells have it: 128 and the number of the signal."""
COMPILERS = ("numba", "llvmlite")
"""Packages that turn a KeyboardInterrupt into other errors, or print it and go on."""


def answer_interrupts(owner: CodeType, line: str = "") -> bool:
    """Answer Ctrl-C in this process from now on, where Python itself would.

    Args:
        owner: code of the function that catches the KeyboardInterrupt. While it does not run, modules are imported or
            numba compiles, the process ends at once instead.
        line: said on standard error at such an end.

    Returns:
        Whether Ctrl-C is answered: not under nohup, which ignores it, and not in another thread than the main one.
    """

    def answer(number: int, frame: FrameType | None) -> None:
        while frame is not None and frame.f_code is not owner and not _swallows(frame):
            frame = frame.f_back
        if frame is not None and frame.f_code is owner:
            raise KeyboardInterrupt
        os.write(2, line.encode())
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


def block_interrupts(blocked: bool) -> None:
    """Keep Ctrl-C from this thread, and from the processes that it starts, until they let it through."""
    if hasattr(signal, "pthread_sigmask"):  # Windows has none
        signal.pthread_sigmask(signal.SIG_BLOCK if blocked else signal.SIG_UNBLOCK, {signal.SIGINT})
