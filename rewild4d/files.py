"""Files and folders: whole or not at all, one writer at a time, known by their content, in the order people count."""

from __future__ import annotations

import contextlib
import errno
import hashlib
import os
import re
import shlex
import shutil
import sys
import tempfile
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import platformdirs

from rewild4d.errors import DiskFull, UserError
from rewild4d.foreign.reading import require_room, require_there, unpacked_size

if TYPE_CHECKING:
    import numpy as np
    import torch

try:
    import fcntl
except ImportError:  # Windows has none
    fcntl = None  # type: ignore[assignment]


FULL = (errno.ENOSPC, errno.EFBIG, getattr(errno, "EDQUOT", errno.ENOSPC))
"""Errors of a disk or a quota that is full, and of a file that may not grow."""


def not_written(path: Path, error: OSError) -> UserError:
    """Make the error for a file or folder that could not be written; `DiskFull` where that is the reason."""
    is_full = error.errno in FULL or os.strerror(errno.ENOSPC) in str(error)  # ffmpeg's words, inside of imageio's
    reason = os.strerror(errno.ENOSPC) if is_full and error.errno not in FULL else error.strerror or error
    return (DiskFull if is_full else UserError)(f"{path}: could not be written: {reason}.")


@contextmanager
def atomic(path: Path) -> Iterator[Path]:
    """Give a temporary path beside ``path`` and move it there when the block ends well; else leave nothing behind.

    What a killed process leaves is used by the next one that writes the same file, so that it never adds up.

    Raises:
        UserError: the folder cannot be written.
        DiskFull: the disk is full.
    """
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        handle, temporary = _begin(path)
    except OSError as error:
        if error.errno in FULL:
            raise not_written(path, error) from error
        raise UserError(f"{path}: expected a folder that can be written, but: {error.strerror}.") from error
    try:
        yield temporary
        os.chmod(temporary, 0o666 & ~_umask())
        os.replace(temporary, path)
    except OSError as error:
        raise not_written(path, error) from error
    finally:
        temporary.unlink(missing_ok=True)
        if handle is not None:
            os.close(handle)


def _begin(path: Path) -> tuple[int | None, Path]:
    """Make an empty file beside a path; a handle that is given holds it until it is closed."""
    usual = path.with_name(f".{path.stem}.part{path.suffix}")
    if fcntl is not None:
        handle = os.open(usual, os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW | os.O_CLOEXEC, 0o600)
        with contextlib.suppress(OSError):
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
            if os.path.samestat(os.fstat(handle), os.stat(usual)):  # else its writer has just moved it away
                os.truncate(handle, 0)
                return handle, usual
        os.close(handle)
    handle, name = tempfile.mkstemp(dir=path.parent, prefix=f".{path.stem}.", suffix=path.suffix)
    os.close(handle)
    return None, Path(name)


def remove_leftovers(folder: Path) -> None:
    """Remove what `atomic` and `new_folder` had begun in a folder when their process was killed; nobody else may be
    writing there."""
    for path in (*folder.glob(".*.????????.*"), *folder.glob(".*.part"), *folder.glob(".*.part.*")):
        if path.is_dir() and not path.is_symlink():
            if path.suffix == ".part":
                shutil.rmtree(path, ignore_errors=True)
        else:
            path.unlink(missing_ok=True)


def _umask() -> int:
    current = os.umask(0)
    os.umask(current)
    return current


@contextmanager
def replaced_folder(folder: Path, marker: str, earlier: str) -> Iterator[Path]:
    """Give a new folder that takes the place of ``folder`` when the block ends well; else nothing has changed.

    Args:
        folder: not there, empty, or one that holds ``marker``: anything else is somebody's own.
        marker: name of the file that the block has to write.
        earlier: what a folder with the marker is called ("an earlier collection").

    Raises:
        UserError: the folder holds something else, or cannot be written.
    """
    if folder.exists() and not (folder.is_dir() and ((folder / marker).is_file() or not any(folder.iterdir()))):
        raise UserError(f"{folder}: expected an empty folder or {earlier}, but it holds something else.")
    building, old = (folder.with_name(f".{folder.name}.{kind}") for kind in ("part", "old"))
    with held(folder.parent, f"{folder}: waiting for another process that writes into {folder.parent}"):
        try:
            for left in (building, old) if folder.exists() else (building,):  # of a process that was killed
                shutil.rmtree(left, ignore_errors=True)
            building.mkdir()
            yield building
            if folder.exists():
                folder.rename(old)
            building.rename(folder)
        except OSError as error:
            raise not_written(folder, error) from error
        finally:
            shutil.rmtree(building, ignore_errors=True)
            if folder.exists():
                shutil.rmtree(old, ignore_errors=True)
            elif old.exists():
                old.rename(folder)


@contextmanager
def held(folder: Path, waiting: str) -> Iterator[None]:
    """Hold a folder, made where it is not there, so that other processes that ask for it wait for the block's end.

    Where the system or the file system has no such locks, nothing is held.

    Args:
        folder: of the work.
        waiting: said on standard error when another process holds it.

    Raises:
        UserError: the folder cannot be made.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise UserError(f"{folder}: expected a folder that can be written, but: {error.strerror}.") from error
    if fcntl is None:
        yield
        return
    handle = os.open(folder, os.O_RDONLY)
    try:
        with contextlib.suppress(OSError):
            try:
                fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                print(waiting, file=sys.stderr)
                fcntl.flock(handle, fcntl.LOCK_EX)
        yield
    finally:
        os.close(handle)


def is_held(folder: Path) -> bool | None:
    """Tell whether a process holds a folder (`held`); None where the system or the file system does not say."""
    if fcntl is None:
        return None
    try:
        handle = os.open(folder, os.O_RDONLY)
    except OSError:
        return False
    try:
        fcntl.flock(handle, fcntl.LOCK_SH | fcntl.LOCK_NB)
    except BlockingIOError:
        return True
    except OSError:
        return None
    finally:
        os.close(handle)
    return False


def regular_inside(path: Path, folder: Path) -> None:
    """Fail unless a path is a regular file that lies inside a folder when all links are followed.

    Raises:
        UserError: it is not there, a folder, a pipe or a device, or a link that leads out of the folder.
    """
    try:
        real = path.resolve(strict=True)
        is_file = real.is_file()
    except (OSError, RuntimeError, ValueError) as error:  # links in a circle; a name that no file can have
        reason = getattr(error, "strerror", None) or error
        raise UserError(f"{str(path)[:200]}: expected a file, but: {reason}.") from error
    if not is_file:
        raise UserError(f"{path}: expected a regular file, got something else.")
    if not real.is_relative_to(folder.resolve()):
        raise UserError(f"{path}: expected a file inside {folder}, got a link that leads out of it.")


def write_text(path: Path, text: str) -> None:
    """Write text atomically, the same bytes on every system."""
    with atomic(path) as temporary:
        temporary.write_text(text, encoding="utf-8", newline="\n")


def save_tensors(state: Any, path: Path) -> None:
    """Write what `torch.load` reads, atomically; see `atomic` for errors."""
    import torch

    with atomic(path) as temporary, temporary.open("wb") as file:
        try:
            torch.save(state, file)
        except RuntimeError as error:  # torch complains of its own position and hides that the disk is full
            if isinstance(error.__context__, OSError):
                raise error.__context__ from None
            raise


def digest(*parts: bytes | str | np.ndarray | torch.Tensor) -> str:
    """Return SHA-256 over text, bytes and arrays (with their shape and type), as hex."""
    sha = hashlib.sha256()
    for part in parts:
        if isinstance(part, str):
            part = part.encode()
        elif not isinstance(part, bytes):
            array = part.detach().cpu().numpy() if hasattr(part, "detach") else part
            sha.update(f"{array.dtype}{array.shape}".encode())
            part = array.tobytes()
        sha.update(part)
        sha.update(b"\0")
    return sha.hexdigest()


def file_state(path: Path) -> str:
    """Return the path, size and time of change of a file, as text.

    Raises:
        UserError: there is no such file, or only a link to nothing.
    """
    try:
        state = path.stat()
    except OSError as error:
        raise UserError(f"{path}: expected a file that can be read, but: {error.strerror}.") from error
    return f"{path.resolve()} {state.st_size} {state.st_mtime_ns}"


def command_words(command: str) -> list[str]:
    """Split a command line into words as a POSIX shell does; on Windows a backslash is part of a path.

    Raises:
        ValueError: a quote does not end.
    """
    lexer = shlex.shlex(command, posix=True)
    lexer.whitespace_split, lexer.commenters = True, ""
    if os.name == "nt":
        lexer.escape = ""
    return list(lexer)


def natural(path: Path) -> list[str | int]:
    """Return a key that sorts files by name so that 2 comes before 10."""
    return [int(part) if index % 2 else part for index, part in enumerate(re.split(r"([0-9]+)", path.name))]


def load_tensors(path: Path, kind: str = "saved reconstruction") -> Any:
    """Return what torch saved, on the CPU.

    Args:
        path: the file.
        kind: what the file should be, for the error.

    Raises:
        UserError: it is missing, damaged, or holds more than tensors and numbers, a tensor without values, or more than
            `reading.largest` lets in.
    """
    import torch

    require_there(path, f"a {kind}")
    require_room(path, unpacked_size(path), f"a {kind}")
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of torch, about pickles of its first years
            content = torch.load(path, map_location="cpu", weights_only=True)
    except OSError as error:
        raise UserError(f"{path}: expected a {kind}, but: {error.strerror or error}.") from error
    except Exception as error:  # an unpickler that meets other bytes fails in any way
        raise UserError(f"{path}: expected a {kind}, but it is cut off or another file.") from error
    _require_values(path, content, kind)
    return content


def _require_values(path: Path, content: Any, kind: str) -> None:
    """Refuse tensors without values, and those that repeat few values until they fill the memory."""
    import torch

    seen: set[int] = set()
    waiting, size = [content], 0
    while waiting:
        item = waiting.pop()
        if id(item) in seen:
            continue
        seen.add(id(item))
        if isinstance(item, dict):
            waiting += item.values()
        elif isinstance(item, list | tuple):
            waiting += item
        elif isinstance(item, torch.Tensor):
            if item.device.type != "cpu":
                raise UserError(f"{path}: expected a {kind}, got a tensor without values (device {item.device}).")
            size += item.numel() * item.element_size()
    require_room(path, size, f"a {kind}")


def cache_folder() -> Path:
    """Where decoded images, built-in data and compiled kernels are kept: $REWILD4D_CACHE or the platform's cache."""
    chosen = os.environ.get("REWILD4D_CACHE")
    return Path(chosen) if chosen else Path(platformdirs.user_cache_dir("rewild4d"))
