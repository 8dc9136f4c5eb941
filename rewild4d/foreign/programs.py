"""Run programs of others: bounded in time and in what they print, and nothing of them outlives the call."""

import contextlib
import os
import signal
import subprocess
import tempfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from threading import Thread
from typing import IO

from rewild4d.errors import UserError

TIMEOUT = 6 * 3600.0
"""Seconds that a program may take where nobody says how many."""
HEAD = 1 << 20
"""Bytes of a log's beginning that are always kept."""
TAIL = 4 << 20
"""Bytes of its end that are kept at least; a log never takes more than HEAD + 2 TAIL on the disk."""
WORDS = 8192
"""Bytes at the end of a log in which a program's last words are looked for."""
WATCH = 'read number && { read _; kill -s KILL -- "-$number"; }'
"""A shell at the other end of a pipe of ours: when this process is gone, however it went, so is the program."""


@dataclass(frozen=True)
class Ended:
    """A program that ended by itself.

    Attributes:
        status: exit status; negative: the signal that killed it.
        said: its last line that is not blank, at most 200 characters, or "".
    """

    status: int
    said: str


def run_foreign(
    words: Sequence[str],
    *,
    timeout: float,
    log: Path | None = None,
    stdout: IO[str] | None = None,
    flag: str = "--command",
    environment: Mapping[str, str] | None = None,
) -> Ended:
    """Run a program until it ends; after that, after Ctrl-C or after the time given, none of its processes is left.

    Args:
        words: the program and its arguments.
        timeout: seconds.
        log: file for what it prints, bounded (`BoundedLog`); nowhere where it is left out.
        stdout: takes its standard output instead of the log.
        flag: where the program was named, for the error.
        environment: its variables; this process's where it is left out.

    Raises:
        UserError: it cannot be started, does not end in time, or its log cannot be written.
    """
    with _opened(log) as file, _watchdog() as watch:
        kept = BoundedLog(file)
        process = _start(words, stdout, flag, environment)
        watch(process.pid)  # before all else: a signal may come at any time
        with _pumped(process.stderr if stdout else process.stdout, kept), _ended(process):
            try:
                status = process.wait(timeout)
            except subprocess.TimeoutExpired as error:
                said = f" (log: {log})" if log else ""
                raise UserError(
                    f"{words[0]}: expected an end within {timeout:g} s, but it was still running{said}; --timeout "
                    "gives it longer."
                ) from error
        if kept.fault is not None:
            raise UserError(f"{log or 'log'}: could not be written: {kept.fault.strerror}.") from kept.fault
        return Ended(status, last_words(file))


def _start(
    words: Sequence[str], stdout: IO[str] | None, flag: str, environment: Mapping[str, str] | None
) -> subprocess.Popen[bytes]:
    try:
        return subprocess.Popen(
            words, stdin=subprocess.DEVNULL, stdout=stdout or subprocess.PIPE,
            stderr=subprocess.PIPE if stdout else subprocess.STDOUT, start_new_session=True, env=environment,
        )  # fmt: skip
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or error
        raise UserError(f"{flag}: expected a program that can be started, but '{words[0]}': {reason}.") from error


class BoundedLog:
    """A file that keeps the beginning and the end of what is written to it, and says how much it left out between."""

    def __init__(self, file: IO[bytes], head: int = HEAD, tail: int = TAIL) -> None:
        self.fault: OSError | None = None
        self._file, self._head, self._tail = file, head, tail
        self._size = self._cut = 0

    def write(self, data: bytes) -> None:
        """Append; after a fault of the disk nothing more is written, and ``fault`` tells it."""
        if self.fault is not None:
            return
        try:
            for start in range(0, len(data), self._tail):
                self._append(data[start : start + self._tail])
            self._file.flush()
        except OSError as error:
            self.fault = error

    def _append(self, data: bytes) -> None:
        self._file.write(data)
        self._size += len(data)
        if self._size > self._head + 2 * self._tail:
            self._drop_middle()

    def _drop_middle(self) -> None:
        """Move the end forward, to where the beginning ends."""
        self._file.seek(self._size - self._tail)
        end = self._file.read(self._tail)
        self._cut += self._size - self._head - self._tail
        note = f"\n[rewild4d: {self._cut} bytes left out here]\n".encode()
        self._file.seek(self._head)
        self._file.write(note + end)
        self._file.truncate()
        self._size = self._head + len(note) + len(end)
        self._cut -= len(note)  # the note is cut with the next middle, and is nothing that the program said


def last_words(file: IO[bytes]) -> str:
    """Return the last line of a log that is not blank, at most 200 characters; only its end is read."""
    size = file.seek(0, os.SEEK_END)
    file.seek(max(0, size - WORDS))
    lines = [line.strip() for line in file.read(WORDS).decode("utf-8", "replace").splitlines() if line.strip()]
    return lines[-1][:200] if lines else ""


@contextmanager
def _opened(log: Path | None) -> Iterator[IO[bytes]]:
    if log is None:
        with tempfile.TemporaryFile() as file:
            yield file
        return
    try:
        file = log.open("w+b")
    except OSError as error:
        raise UserError(f"{log}: expected a file that can be written, but: {error.strerror}.") from error
    try:
        yield file
    finally:
        with contextlib.suppress(OSError):  # of a full disk, which `BoundedLog` has told
            file.close()


@contextmanager
def _pumped(pipe: IO[bytes] | None, kept: BoundedLog) -> Iterator[None]:
    """Move what comes through the pipe into the log, until the block ends and the pipe is empty."""
    assert pipe is not None

    def pump() -> None:
        with contextlib.suppress(OSError, ValueError):  # it was closed under us
            while data := os.read(pipe.fileno(), 1 << 16):
                kept.write(data)

    thread = Thread(target=pump, daemon=True)
    thread.start()
    try:
        yield
    finally:
        thread.join(5.0)  # on Windows a grandchild may hold the pipe for ever
        pipe.close()


@contextmanager
def _watchdog() -> Iterator[Callable[[int], None]]:
    """Give a function that takes the number of a program, and have it killed at the block's end or when this process is
    killed, which no `finally` outlives. Windows has no groups of processes."""
    if not hasattr(os, "killpg"):
        yield lambda _: None
        return
    shell = subprocess.Popen(
        ["/bin/sh", "-c", WATCH], stdin=subprocess.PIPE, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
        start_new_session=True, bufsize=0,
    )  # fmt: skip
    pipe = shell.stdin
    assert pipe is not None

    def watch(number: int) -> None:
        pipe.write(f"{number}\n".encode())

    try:
        yield watch
    finally:
        pipe.close()  # at its end the shell kills what is left of a program that it was told
        shell.wait()


@contextmanager
def _ended(process: subprocess.Popen[bytes]) -> Iterator[None]:
    """Kill what is left, at the end of the block, of a program that was started in a session of its own."""
    try:
        yield
    finally:
        if hasattr(os, "killpg"):
            with contextlib.suppress(ProcessLookupError, PermissionError):  # macOS: of a group of zombies
                os.killpg(process.pid, signal.SIGKILL)
        else:
            process.kill()
        process.wait()
