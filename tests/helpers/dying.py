"""Work that is killed on the way; a module of its own, so that new processes find it."""

import os
import signal


def square(number: int, deadly: int) -> int:
    """The square of a number; the deadly one kills the process."""
    if number == deadly:
        os.kill(os.getpid(), signal.SIGKILL)
    return number**2


class Killed(Exception):
    """What `kill_late` raises."""


def kill_late(step: int, total: int, values: object) -> None:
    """A fit's log that ends the fit at its last step."""
    if step == total:
        raise Killed
