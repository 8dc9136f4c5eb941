"""Files that others made: what they take in memory is known from their headers before any of it is read.

One limit holds for every file: `LARGEST_GIB` of memory, or what the environment variable `REWILD4D_LARGEST_GIB` says.
It is there for files that are damaged or built to fill a machine (three megabytes of zeros unpack to six gigabytes);
who has larger data raises it.
"""

from __future__ import annotations

import contextlib
import math
import os
import stat
import zipfile
import zlib
from collections.abc import Iterator
from io import BytesIO
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any

from rewild4d.errors import UserError

if TYPE_CHECKING:
    import numpy as np

VARIABLE = "REWILD4D_LARGEST_GIB"
LARGEST_GIB = 1.0
"""Memory that one file may take, GiB."""
FILM = 8
"""A film whose frames are held together may take this many times as much."""
PIXEL = 16
"""Bytes that one pixel of a picture takes while it is read: four channels in single precision."""
TEXT = 8
"""Numbers written as text take this many times their size while they are parsed."""
LONGEST_NAME = 255
"""Bytes of a file's name that file systems take."""
MOST_AXES = 32
ZIP_FAULTS = (
    zipfile.BadZipFile, zlib.error, EOFError, OSError, ValueError, OverflowError, LookupError,
    NotImplementedError, RuntimeError,  # another compression, a password
)  # fmt: skip
READABLE = "bifucSU"
"""Kinds of NumPy types that are plain values; others are objects and records."""


def largest() -> int:
    """Return the bytes of memory that one file may take.

    Raises:
        UserError: the environment variable is no number above zero.
    """
    said = os.environ.get(VARIABLE) or str(LARGEST_GIB)
    try:
        size = float(said)
    except ValueError:
        size = math.nan
    if not 0 < size < 1e6:
        raise UserError(f"{VARIABLE}: expected a number of GiB above zero, got '{said[:40]}'.")
    return int(size * 2**30)


def require_room(path: Path, size: int, what: str = "data", times: int = 1) -> None:
    """Refuse a file that takes more memory than `largest` says.

    Args:
        path: the file.
        size: bytes that it takes once it is read.
        what: what takes them, for the sentence.
        times: the limit is as many times as large.

    Raises:
        UserError: it takes more.
    """
    if size > (most := times * largest()):
        raise UserError(
            f"{path}: expected {what} of at most {most / 2**30:.3g} GiB once read (the environment variable {VARIABLE} "
            f"sets the limit), got {min(size, 1 << 99) / 2**30:.3g} GiB."
        )


def require_file(path: Path, kind: str) -> None:
    """Refuse what is not a file of a size that can be read.

    Args:
        path: the file.
        kind: what it should be, for the error ("a PLY file").

    Raises:
        UserError: it is missing, a folder, a device or a pipe, or is larger than `largest` says.
    """
    try:
        state = path.stat()
    except (OSError, ValueError) as error:
        raise _unreadable(path, kind, error) from error
    if not stat.S_ISREG(state.st_mode):
        came = "Is a directory" if stat.S_ISDIR(state.st_mode) else "it is a device or a pipe"
        raise UserError(f"{path}: expected {kind}, but: {came}.")
    require_room(path, state.st_size, kind)


def read_numbers(path: Path, kind: str) -> bytes:
    """Return the content of a file of numbers written as text; errors as of `read_bytes`, after they are parsed."""
    data = read_bytes(path, kind)
    require_room(path, TEXT * len(data), kind)
    return data


def require_there(path: Path, kind: str) -> None:
    """Refuse a missing file, in words that do not sound like an accident; then as `require_file`."""
    if not os.path.lexists(str(path).replace("\0", "")):
        raise UserError(f"{path}: expected {kind}, but there is no such file.")
    require_file(path, kind)


def read_bytes(path: Path, kind: str) -> bytes:
    """Return the content of a file.

    Raises:
        UserError: as `require_file`, or it cannot be read.
    """
    require_file(path, kind)
    try:
        return path.read_bytes()
    except OSError as error:
        raise _unreadable(path, kind, error) from error


def _unreadable(path: Path, kind: str, error: OSError | ValueError) -> UserError:
    reason = error.strerror if isinstance(error, OSError) else "its name holds a zero"
    return UserError(f"{path}: expected {kind}, but: {reason}.")


def beside(path: Path, name: str) -> Path:
    """Return the file that another one names, which has to lie in that one's folder or below it.

    Args:
        path: the file that names it.
        name: as it stands there.

    Raises:
        UserError: it lies elsewhere, by its name or through a link.
    """
    folder = path.parent
    longest = max((len(os.fsencode(part)) for part in name.split("/")), default=0)
    if name and "\0" not in name and "://" not in name and longest <= LONGEST_NAME:
        with contextlib.suppress(OSError, RuntimeError):  # a name that is too long, a link that leads to itself
            if (folder / name).resolve().is_relative_to(folder.resolve()):
                return folder / name
    raise UserError(f"{path}: expected names of files in its own folder, got '{name[:80]}', which is none.")


def read_array(path: Path, kind: str = "a NumPy file") -> np.ndarray:
    """Return the array of an .npy file.

    Args:
        path: the file.
        kind: what it should be, for the error.

    Raises:
        UserError: as `read_bytes`, it is no .npy file or a damaged one, or it holds objects.
    """
    data = read_bytes(path, kind)
    return _array(path, BytesIO(data), len(data), f"{kind}, but")


def read_arrays(path: Path, kind: str) -> dict[str, np.ndarray]:
    """Return the arrays of an .npz file by name.

    Args:
        path: the file.
        kind: what it should be, for the error: "a prior file (npz)".

    Raises:
        UserError: as `read_array`, or its arrays together take more memory than `largest` says.
    """
    require_there(path, kind.partition(" (")[0])
    return arrays_of(path, read_bytes(path, kind), kind)


def arrays_of(path: Path, data: bytes, kind: str) -> dict[str, np.ndarray]:
    """Return the arrays of the content of an .npz file; arguments and errors as of `read_arrays`."""
    fault = f"{kind}, but it cannot be read as one"
    if data.startswith(b"\x93NUMPY"):
        raise UserError(f"{path}: expected {fault}: it holds a single array.")
    with opened_zip(path, BytesIO(data), fault) as archive:
        found = {}
        for info in archive.infolist():
            with archive.open(info) as stream:
                found[info.filename.removesuffix(".npy")] = _array(path, stream, info.file_size, fault)
        return found


def unpacked_size(path: Path) -> int:
    """Return the bytes of all entries of a zip archive together; 0 of a file that is none or a damaged one."""
    with contextlib.suppress(*ZIP_FAULTS), zipfile.ZipFile(path) as archive:
        return sum(info.file_size for info in archive.infolist())
    return 0


@contextlib.contextmanager
def opened_zip(path: Path, stream: IO[bytes], fault: str) -> Iterator[zipfile.ZipFile]:
    """Open a zip archive whose entries together take no more memory than `largest` says.

    Args:
        path: the file, for the error.
        stream: its content.
        fault: what it should be and is not, for the error.

    Raises:
        UserError: it is no archive, damaged (found here or in the block), or takes more memory.
    """
    try:
        with zipfile.ZipFile(stream) as archive:
            require_room(path, sum(info.file_size for info in archive.infolist()), "arrays")
            yield archive
    except ZIP_FAULTS as error:
        raise UserError(f"{path}: expected {fault}: it is cut off, damaged or another file.") from error


def _array(path: Path, stream: IO[bytes], size: int, fault: str) -> np.ndarray:
    """Return the array of a stream of ``size`` bytes; what its header asks for has to be there."""
    import numpy as np

    shape, fortran, dtype = _header(path, stream, fault)
    if dtype.kind not in READABLE:
        raise UserError(f"{path}: expected {fault}: it holds {str(dtype)[:40]}, not plain numbers or text.")
    needed = math.prod(shape) * dtype.itemsize
    if len(shape) > MOST_AXES or max(shape, default=0) > size or needed > size:
        raise UserError(f"{path}: expected {fault}: it is cut off, its header says more values than it holds.")
    data = stream.read(needed)
    if len(data) < needed:
        raise UserError(f"{path}: expected {fault}: it is cut off.")
    if dtype.kind == "U" and data and np.frombuffer(data, dtype.byteorder.replace("|", "=") + "u4").max() > 0x10FFFF:
        raise UserError(f"{path}: expected {fault}: it holds text of characters that do not exist.")
    order: Any = "F" if fortran else "C"
    return np.frombuffer(data, dtype).reshape(shape, order=order).copy(order) if data else np.zeros(shape, dtype)


def _header(path: Path, stream: IO[bytes], fault: str) -> tuple[tuple[int, ...], bool, np.dtype]:
    """Return shape, order of the axes and type that an .npy stream begins with."""
    from numpy.lib import format as npy

    readers = {(1, 0): npy.read_array_header_1_0, (2, 0): npy.read_array_header_2_0}
    try:
        shape, fortran, dtype = readers[npy.read_magic(stream)](stream)
    except (zipfile.BadZipFile, zlib.error):  # of the archive around it
        raise
    except Exception as error:  # NumPy parses it as Python text, which fails in any way where it is damaged
        raise UserError(f"{path}: expected {fault}: the header of an array is damaged or another file's.") from error
    if any(type(length) is not int or length < 0 for length in shape):
        raise UserError(f"{path}: expected {fault}: an array has the shape {str(shape)[:60]}.")
    return shape, fortran, dtype


def picture_size(path: Path, source: bytes | Path) -> tuple[int, int] | None:
    """Return the width and height of a picture from its header; None where it is no picture that Pillow knows.

    Args:
        path: the file, for the error.
        source: its content, or the file.

    Raises:
        UserError: it takes more memory than `largest` says.
    """
    import warnings

    from PIL import Image

    if largest() // PIXEL > (Image.MAX_IMAGE_PIXELS or math.inf):  # Pillow's own limit follows where ours is raised
        Image.MAX_IMAGE_PIXELS = largest() // PIXEL
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", Image.DecompressionBombWarning)
            with Image.open(BytesIO(source) if isinstance(source, bytes) else source) as image:
                width, height = image.size
    except Image.DecompressionBombError as error:
        most = f"{largest() // PIXEL} pixels (the environment variable {VARIABLE} sets the limit)"
        raise UserError(f"{path}: expected a picture of at most {most}, got far more.") from error
    except Exception:  # any damage: whoever decodes the picture says so
        return None
    require_room(path, PIXEL * width * height, f"a picture, {width}x{height} pixels,")
    return width, height
