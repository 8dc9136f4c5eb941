"""Damages valid files at random and looks at what a reader makes of them.

A zip (npz, pth) and a glb are also opened and put together again, so that damage gets past checksums and lengths.
"""

import contextlib
import io
import random
import re
import signal
import struct
import time
import zipfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

from rewild4d.errors import UserError

LONGEST_MESSAGE = 400
"""Characters of an error beside the path, which the person chose."""
LONGEST_SECONDS = 5.0
MOST_MEMORY = 2 << 30
NUMBERS = (
    b"-1", b"0", b"1", b"2", b"1e300", b"-1e39", b"nan", b"inf", b"0.5", b"255", b"65536", b"4294967295", b"99999999",
    b"9223372036854775808", b"1" + b"0" * 30, b"9" * 5000, b"",
)  # fmt: skip
WORDS = (b"null", b"true", b"{}", b"[]", b'""', b"[[[[]]]]", b"../x", b"/dev/zero", b"\xff\xfe", b"\0", b"\n", b" ")
INTEGERS = (0, 1, 0x7F, 0xFF, 0x7FFF, 0xFFFF, 0x7FFFFFFF, 0x80000000, 0xFFFFFFFF, 100_000_000)
HEADER = 600
GLB = struct.Struct("<4sII")


@dataclass(frozen=True)
class Reader:
    """A reader and the file that it is tried on.

    Attributes:
        make: writes a tiny valid file, with what belongs beside it, into an empty folder and returns its path.
        read: reads the file; what it returns does not matter.
    """

    make: Callable[[Path], Path]
    read: Callable[[Path], object]


@dataclass
class Findings:
    """What a reader made of the damaged files.

    Attributes:
        values: files that it read.
        refused: files that it refused as it should.
        faults: what went wrong, a line each, with the number of the damage.
        slowest: seconds.
        memory: bytes that the process grew by at most; 0 where the system does not tell.
    """

    values: int = 0
    refused: int = 0
    faults: list[str] = field(default_factory=list)
    slowest: float = 0.0
    memory: int = 0


class _TooSlow(BaseException):
    """Passes every handler of a reader."""


def drive(name: str, reader: Reader, folder: Path, count: int) -> Findings:
    """Read ``count`` damaged files; damage ``i`` of the reader ``name`` is always the same one."""
    path = reader.make(folder)
    whole = path.read_bytes()
    reader.read(path)
    found = Findings()
    with measured() as grown:
        _read_all(name, reader, path, whole, range(count), found)
    path.write_bytes(whole)
    found.memory = grown()
    if found.memory > MOST_MEMORY:
        found.faults.append(f"{found.memory / 2**30:.1f} GiB of memory")
    return found


def _read_all(name: str, reader: Reader, path: Path, whole: bytes, numbers: range, found: Findings) -> None:
    for number in numbers:
        path.write_bytes(mutate(whole, random.Random(f"{name} {number}")))
        begin = time.perf_counter()
        try:
            with _limited(4 * LONGEST_SECONDS):
                reader.read(path)
            found.values += 1
        except UserError as error:
            found.refused += 1
            if len(said := str(error).replace(str(path), "")) > LONGEST_MESSAGE or "\n" in said:
                found.faults.append(f"{number}: a message of {len(said)} characters: {said[:200]!r}")
        except _TooSlow:
            found.faults.append(f"{number}: no answer")
        except Exception as error:
            found.faults.append(f"{number}: {type(error).__name__}: {str(error)[:200]!r}")
        seconds = time.perf_counter() - begin
        found.slowest = max(found.slowest, seconds)
        if seconds > LONGEST_SECONDS:
            found.faults.append(f"{number}: {seconds:.1f} s")


@contextmanager
def measured() -> Iterator[Callable[[], int]]:
    """Give a function that returns by how many bytes the process grew at most since the block began."""
    with contextlib.suppress(OSError):  # another system, or one that does not let us
        Path("/proc/self/clear_refs").write_text("5")
    before = _peak()
    yield lambda: max(0, _peak() - before)


def mutate(data: bytes, rng: random.Random) -> bytes:
    """Return a damaged copy."""
    opened = rng.random() < 0.7
    if opened and data[:2] == b"PK":
        return _in_zip(data, rng)
    if opened and data[:4] == b"glTF":
        return _in_glb(data, rng)
    for _ in range(rng.choice((1, 1, 1, 2, 4))):
        data = rng.choice(DAMAGES)(data, rng)
    return data


def _span(data: bytes, rng: random.Random) -> tuple[int, int]:
    start = rng.randrange(len(data) + 1)
    return start, min(len(data), start + rng.choice((1, 2, 4, 16, 64, 400)))


def _flip(data: bytes, rng: random.Random) -> bytes:
    made = bytearray(data)
    for _ in range(rng.choice((1, 1, 3, 8)) if made else 0):
        made[rng.randrange(len(made))] ^= 1 << rng.randrange(8)
    return bytes(made)


def _truncate(data: bytes, rng: random.Random) -> bytes:
    return data[: rng.randrange(len(data) + 1)]


def _duplicate(data: bytes, rng: random.Random) -> bytes:
    start, end = _span(data, rng)
    return data[:end] + data[start:end] * rng.choice((1, 1, 3, 50)) + data[end:]


def _remove(data: bytes, rng: random.Random) -> bytes:
    start, end = _span(data, rng)
    return data[:start] + data[end:]


def _overwrite(data: bytes, rng: random.Random) -> bytes:
    start, end = _span(data, rng)
    fill = rng.choice((b"\0", b"\xff", b"9", b"{", b"("))
    return data[:start] + fill * (end - start) + data[end:]


def _exchange(data: bytes, rng: random.Random) -> bytes:
    (a, b), (c, d) = sorted((_span(data, rng), _span(data, rng)))
    return data if b > c else data[:a] + data[c:d] + data[b:c] + data[a:b] + data[d:]


def _digit(data: bytes, rng: random.Random) -> bytes:
    return _replaced(data, rb"[0-9]", b"%d" % rng.randrange(10), rng)


def _number(data: bytes, rng: random.Random) -> bytes:
    return _replaced(data, rb"-?[0-9]+(?:\.[0-9]+)?(?:e-?[0-9]+)?", rng.choice(NUMBERS), rng)


def _word(data: bytes, rng: random.Random) -> bytes:
    others = re.findall(rb"[A-Za-z_]{2,20}", data[: 8 * HEADER]) or [b""]
    return _replaced(data, rb'"?[A-Za-z_]{2,20}"?', rng.choice((rng.choice(WORDS), rng.choice(others))), rng)


def _value(data: bytes, rng: random.Random) -> bytes:
    """Put something else after a colon: what JSON and headers of arrays say."""
    pattern = rb"(?<=:) ?(?:\"[^\"]{0,40}\"|-?[0-9.]+|true|false|\[[^\[\]]{0,200}\]|\([^()]{0,80}\)|\{[^{}]{0,200}\})"
    return _replaced(data, pattern, rng.choice((*WORDS, *NUMBERS)), rng)


def _integer(data: bytes, rng: random.Random) -> bytes:
    """Put an integer of 1, 2, 4 or 8 bytes in, as lengths and counts of binary files are."""
    width = rng.choice((1, 2, 4, 4, 8))
    start = rng.randrange(max(1, (len(data) - width) // width)) * width
    value = rng.choice(INTEGERS) & ((1 << 8 * width) - 1)
    return data[:start] + value.to_bytes(width, rng.choice(("little", "little", "big"))) + data[start + width :]


def _line(data: bytes, rng: random.Random) -> bytes:
    lines = data.split(b"\n")
    place = rng.randrange(min(len(lines), 200))
    other = lines[rng.randrange(min(len(lines), 200))]
    lines[place : place + 1] = rng.choice(([], [lines[place]] * 2, [other], [other, lines[place]], [b""]))
    return b"\n".join(lines)


def _replaced(data: bytes, pattern: bytes, new: bytes, rng: random.Random) -> bytes:
    """Replace one match: of the header as often as of anything that follows."""
    head = data[:HEADER] if rng.random() < 0.5 else data[:200_000]
    places = [found.span() for found in re.finditer(pattern, head)]
    if not places:
        return _flip(data, rng)
    start, end = rng.choice(places)
    return data[:start] + new + data[end:]


DAMAGES = (
    _flip, _truncate, _duplicate, _remove, _overwrite, _exchange, _digit, _number, _number, _word, _value, _integer,
    _line,
)  # fmt: skip


def _in_zip(data: bytes, rng: random.Random) -> bytes:
    """Damage one entry of an archive, its name, or leave it out."""
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        parts = {name: archive.read(name) for name in archive.namelist()}
    name = rng.choice(list(parts))
    what = rng.random()
    if what < 0.05:
        del parts[name]
    elif what < 0.1:
        other = rng.choice(list(parts))
        parts[name], parts[other] = parts[other], parts[name]
    else:
        parts[name] = rng.choice(DAMAGES)(parts[name], rng)
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w", rng.choice((zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED))) as archive:
        for key, part in parts.items():
            archive.writestr(key, part)
    return stream.getvalue()


def _in_glb(data: bytes, rng: random.Random) -> bytes:
    """Damage the text or the numbers of a glb and correct its lengths."""
    length = struct.unpack_from("<I", data, 12)[0]
    text, blob = data[20 : 20 + length], data[28 + length :]
    if rng.random() < 0.8:
        text = rng.choice((*DAMAGES, _value, _value, _number))(text, rng)
    else:
        blob = rng.choice(DAMAGES)(blob, rng)
    text += b" " * (-len(text) % 4)
    chunks = struct.pack("<II", len(text), 0x4E4F534A) + text + struct.pack("<II", len(blob), 0x004E4942) + blob
    return GLB.pack(b"glTF", 2, 12 + len(chunks)) + chunks


@contextmanager
def _limited(seconds: float) -> Iterator[None]:
    """End a block that runs in Python after a while, where the system has such alarms."""
    if not hasattr(signal, "setitimer"):
        yield
        return

    def stop(*_: object) -> None:
        raise _TooSlow

    before = signal.signal(signal.SIGALRM, stop)
    signal.setitimer(signal.ITIMER_REAL, seconds)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
        signal.signal(signal.SIGALRM, before)


def _peak() -> int:
    """Return the most memory that the process has had since `measured` began, in bytes; 0 where nobody tells."""
    try:
        found = re.search(r"VmHWM:\s+(\d+) kB", Path("/proc/self/status").read_text())
    except OSError:
        return 0
    return int(found[1]) << 10 if found else 0
