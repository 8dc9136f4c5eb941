"""A piece of work whose process may be killed under it; a module of its own, so that new processes find it."""

import os
import signal


def square(number: int, deadly: int) -> int:
    """The square of a number; the deadly one kills the process."""
    if number == deadly:
        os.kill(os.getpid(), signal.SIGKILL)
    return number**2
