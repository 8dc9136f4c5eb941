"""Programs of others: what they print is bounded, and none of their processes outlives a call, however it ends."""

import io
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from processes import all_gone, is_alive, numbers_in

from rewild4d.errors import UserError
from rewild4d.foreign import programs
from rewild4d.foreign.programs import BoundedLog, last_words, run_foreign

posix = pytest.mark.skipif(not Path("/proc/self/stat").exists(), reason="no /proc here: processes cannot be looked up")
PARENT = """
import signal
from rewild4d.foreign.programs import run_foreign
signal.signal(signal.SIGINT, signal.default_int_handler)  # a test run in the background ignores it
run_foreign(["sh", "-c", "sleep 60 & echo $! $$ > {0}.part; mv {0}.part {0}; wait"], timeout=60)
"""


def test_a_log_keeps_its_beginning_and_its_end() -> None:
    file = io.BytesIO()
    log = BoundedLog(file, head=10, tail=20)
    said = bytes(range(48, 123)) * 40
    for start in range(0, len(said), 7):
        log.write(said[start : start + 7])
        assert len(file.getvalue()) <= 10 + 2 * 20 + 50, "head, twice the tail, and the note"
    kept = file.getvalue()
    before, _, rest = kept.partition(b"\n[rewild4d: ")
    number, _, after = rest.partition(b" bytes left out here]\n")
    assert (before, after) == (said[:10], said[len(said) - len(after) :]) and len(after) >= 20
    assert int(number) == len(said) - 10 - len(after)


def test_a_short_log_is_whole_and_one_write_may_be_long() -> None:
    file = io.BytesIO()
    BoundedLog(file, head=10, tail=20).write(b"a" * 50)
    assert file.getvalue() == b"a" * 50
    BoundedLog(long := io.BytesIO(), head=10, tail=20).write(b"a" * 10 + b"b" * 1000 + b"c" * 20)
    assert long.getvalue().startswith(b"a" * 10 + b"\n[rewild4d: ") and long.getvalue().endswith(b"c" * 20)


@posix
def test_a_flood_of_words_stays_small_on_the_disk(tmp_path: Path) -> None:
    path = tmp_path / "log"
    flood = "yes 'all is well' | head -c 200000000; echo; echo 'the end'; exit 3"
    ended = run_foreign(["sh", "-c", flood], timeout=60, log=path)
    assert (ended.status, ended.said) == (3, "the end")
    assert path.stat().st_size <= programs.HEAD + 2 * programs.TAIL + 100 < 200_000_000
    assert b" bytes left out here]\n" in path.read_bytes()


def test_last_words_are_read_from_the_end(tmp_path: Path) -> None:
    path = tmp_path / "log"
    with path.open("w+b") as file:
        file.truncate(1 << 40)  # a sparse terabyte: whoever reads it whole dies of it
        file.seek(0, os.SEEK_END)
        file.write(b"\nout of memory \n\n")
        assert last_words(file) == "out of memory"
    with path.open("w+b") as file:
        file.write(b"x" * 5000)
        assert last_words(file) == "x" * 200
        file.truncate(0)
        assert last_words(file) == ""


@posix
def test_a_timeout_ends_the_whole_family(tmp_path: Path) -> None:
    path = tmp_path / "numbers"
    words = ["sh", "-c", f"sleep 60 & echo $! $$ > {path}; wait"]
    with pytest.raises(UserError) as error:
        run_foreign(words, timeout=0.5, log=tmp_path / "log")
    said = f"sh: expected an end within 0.5 s, but it was still running (log: {tmp_path / 'log'}); --timeout gives it"
    assert str(error.value) == f"{said} longer."
    assert all_gone(numbers_in(path))


@posix
def test_what_a_program_leaves_running_ends_with_it(tmp_path: Path) -> None:
    path = tmp_path / "numbers"
    begin = time.monotonic()
    assert run_foreign(["sh", "-c", f"sleep 60 & echo $! > {path}"], timeout=50).status == 0
    assert time.monotonic() - begin < 20, "nobody waits for the pipe that a child holds"
    assert all_gone(numbers_in(path))


@posix
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGKILL])
def test_a_program_ends_with_us(tmp_path: Path, number: int) -> None:
    path = tmp_path / "numbers"
    parent = subprocess.Popen([sys.executable, "-c", PARENT.format(path)], stderr=subprocess.DEVNULL)
    found = numbers_in(path)
    assert all(map(is_alive, found))
    parent.send_signal(number)
    parent.wait(20)
    assert all_gone(found)


def test_what_cannot_be_started_or_written_is_a_sentence(tmp_path: Path) -> None:
    with pytest.raises(UserError, match="^--tool: expected a program that can be started, but '/no/such': No"):
        run_foreign(["/no/such"], timeout=5, flag="--tool")
    with pytest.raises(
        UserError, match=r"^--command: expected a program that can be started, but 'a\\x00b': embedded null"
    ):
        run_foreign(["a\0b"], timeout=5)
    with pytest.raises(UserError, match="log: expected a file that can be written, but: No such file or directory"):
        run_foreign(["true"], timeout=5, log=tmp_path / "none" / "log")


@pytest.mark.skipif(not os.path.exists("/dev/full"), reason="no /dev/full here: a full disk is not tried")
def test_a_log_on_a_full_disk_is_a_sentence() -> None:
    with pytest.raises(UserError, match="^/dev/full: could not be written: No space left on device"):
        run_foreign([sys.executable, "-c", "print('x' * 10**6)"], timeout=30, log=Path("/dev/full"))
