"""Progress of long work: a bar for the person who waits, a line a step for the file."""

import errno
import json
import os
import sys
from collections.abc import Mapping
from pathlib import Path
from threading import RLock
from types import MappingProxyType

from tqdm import tqdm


class _Bar(tqdm):
    """A bar with a lock of this process: tqdm's own holds a semaphore, and Python warns of it after a sudden end."""


_Bar.set_lock(RLock())


_hidden = False


def hide_bars() -> None:
    """Show no bars in this process from now on: its output is a log that nobody watches."""
    global _hidden
    _hidden = True


def is_shown() -> bool:
    """Tell whether a bar stands on the last line of standard error."""
    return len(getattr(_Bar, "_instances", ())) > 0


class Progress:
    """A contracts.Log that shows a bar on standard error and appends every line to a file."""

    def __init__(self, title: str, path: Path | None = None):
        self.bar: tqdm | None = None
        self.title, self.path = title, path

    def __call__(self, step: int, total: int, values: Mapping[str, float] = MappingProxyType({})) -> None:
        if self.bar is None:
            pause = 0.5 if sys.stderr.isatty() else 10.0
            self.bar = _Bar(desc=self.title, total=total, file=sys.stderr, mininterval=pause, disable=_hidden)
        self.bar.total = total
        self.bar.update(step - self.bar.n)
        if values:
            self.bar.set_postfix({key: f"{value:.4g}" for key, value in values.items()}, refresh=False)
            if self.path is not None:
                _append(self.path, json.dumps({"step": step, **values}) + "\n")

    def close(self) -> None:
        if self.bar is not None:
            self.bar.close()


def _append(path: Path, line: str) -> None:
    """Append a line whole, or not at all where the disk is full."""
    data = line.encode()
    with path.open("ab", buffering=0) as file:
        size = file.seek(0, os.SEEK_END)
        if file.write(data) != len(data):
            file.truncate(size)
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
