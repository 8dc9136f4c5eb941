"""A folder as one zip file, the same bytes for the same files, and back: of others' files nothing is trusted.

The file holds regular files and nothing else: no folder, link, comment, extra field or byte that belongs to no file.
"""

import hashlib
import re
import stat
import struct
import zipfile
from collections import Counter
from pathlib import Path, PurePosixPath
from typing import BinaryIO

from rewild4d.errors import UserError, reason, shown
from rewild4d.files import atomic
from rewild4d.foreign.reading import VARIABLE, ZIP_FAULTS, largest, require_there

MOST_FILES = 20_000
MOST_DEEP = 8
"""Folders and file in one name."""
MOST_NAME = 240
"""Characters of one name."""
KIND = "a bundle as `leaderboard submit` writes it"
_NAME = re.compile(r"[\w@+-][\w@+.-]*(?:/[\w@+-][\w@+.-]*)*")
_TIME = (1980, 1, 1, 0, 0, 0)
"""Of every file: the first moment that a zip file can hold."""
_LOCAL, _CENTRAL = 30, 46
"""Bytes of a file's heads in the zip file, without its name."""
_END = struct.Struct("<4s4H2LH")
"""The last bytes of a zip file: its number of files, size and place of the list of them."""
_CHUNK = 1 << 20


def write_bundle(folder: Path, path: Path) -> None:
    """Write all files of a folder into a zip file, in the order of their names, atomically.

    The same files give the same bytes, whenever and by whomever they were made, with one version of zlib.

    Raises:
        UserError: the file cannot be written.
    """
    names = sorted(file.relative_to(folder).as_posix() for file in folder.rglob("*") if file.is_file())
    with atomic(path) as temporary, zipfile.ZipFile(temporary, "w") as archive:
        for name in names:
            info = zipfile.ZipInfo(name, _TIME)
            info.create_system, info.external_attr = 3, (stat.S_IFREG | 0o644) << 16
            info.compress_type = zipfile.ZIP_DEFLATED
            archive.writestr(info, (folder / name).read_bytes(), compresslevel=9)


def unpack(path: Path, folder: Path) -> tuple[dict[str, str], list[str]]:
    """Unpack a zip file into an empty folder, if nothing speaks against it; what it takes is known before.

    Args:
        path: the zip file.
        folder: where its files go.

    Returns:
        SHA-256 of each file by name; what is wrong, a sentence each. Where anything is, the folder may lack files.

    Raises:
        UserError: it is missing, no zip file, cut off, or of more than `MOST_FILES` files.
    """
    require_there(path, KIND)
    with path.open("rb") as stream:
        start = _start_of_list(path, stream)
        try:
            with zipfile.ZipFile(stream) as archive:
                found = archive.infolist()
                faults = [*_faults(found), *_hidden(found, start)]
                return ({}, faults) if faults else _unpacked(archive, folder)
        except ZIP_FAULTS as error:
            raise UserError(f"{path}: expected {KIND}, but it is damaged: {reason(error)}.") from error


def _start_of_list(path: Path, stream: BinaryIO) -> int:
    """Return where the list of files starts, after the end of the file says how long it is."""
    size = stream.seek(0, 2)
    stream.seek(max(0, size - _END.size))
    end = stream.read()
    if len(end) < _END.size or not end.startswith(b"PK\5\6"):
        raise UserError(f"{path}: expected {KIND}, but it is cut off, goes on behind its end, or is another file.")
    _, _, _, _, count, length, start, _ = _END.unpack(end)
    if count > MOST_FILES or length > MOST_FILES * (_CENTRAL + 4 * MOST_NAME):
        raise UserError(f"{path}: expected {KIND}, of at most {MOST_FILES} files, got {count}.")
    if start + length + _END.size != size:
        raise UserError(f"{path}: expected {KIND}, but its list of files is not where it should be.")
    return start


def _faults(found: list[zipfile.ZipInfo]) -> list[str]:
    """Say what is wrong with names, kinds and sizes of the files of an archive."""
    faults = []
    for info in found:
        name, mode = shown(info.orig_filename), info.external_attr >> 16
        if not safe_name(info.orig_filename):
            faults.append(f"expected names of files below its own folder, got '{name}'.")
        elif stat.S_ISLNK(mode):
            faults.append(f"expected regular files, but '{name}' is a symbolic link.")
        elif stat.S_IFMT(mode) not in (0, stat.S_IFREG):
            faults.append(f"expected regular files, but '{name}' is something else.")
        elif info.flag_bits & 1:
            faults.append(f"expected files without a password, but '{name}' has one.")
        elif info.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
            faults.append(f"expected files stored or deflated, but '{name}' is packed in another way.")
    twice = Counter(info.orig_filename.casefold() for info in found)
    folders = {str(above) for name in twice for above in PurePosixPath(name).parents}
    faults += [f"expected every name once, got '{shown(n)}' {count} times." for n, count in twice.items() if count > 1]
    faults += [f"expected '{shown(name)}' to be a file or a folder, got both." for name in twice if name in folders]
    if (size := sum(info.file_size for info in found)) > largest():
        faults.append(
            f"expected at most {largest() / 2**30:.3g} GiB once unpacked (the environment variable {VARIABLE} sets "
            f"the limit), got {size / 2**30:.3g} GiB."
        )
    return faults


def safe_name(name: str) -> bool:
    """Tell whether a name is one of a file below a folder on every system: no root, drive, ".." or hidden part."""
    return len(name) <= MOST_NAME and name.count("/") < MOST_DEEP and bool(_NAME.fullmatch(name))


def _hidden(found: list[zipfile.ZipInfo], start: int) -> list[str]:
    """Say whether bytes before the list of files belong to none, or to several."""
    place = 0
    for info in sorted(found, key=lambda info: info.header_offset):
        if info.header_offset != place:
            break
        place += _LOCAL + len(info.orig_filename.encode()) + info.compress_size
    is_plain = not any(info.comment or info.extra for info in found)
    if place == start and is_plain:
        return []
    return [f"expected {KIND}, but it has bytes that belong to no file, or to two."]


def _unpacked(archive: zipfile.ZipFile, folder: Path) -> tuple[dict[str, str], list[str]]:
    digests: dict[str, str] = {}
    faults = []
    for info in archive.infolist():
        target = folder / info.filename
        target.parent.mkdir(parents=True, exist_ok=True)
        sha = hashlib.sha256()
        try:
            with archive.open(info) as packed, target.open("xb") as file:
                while chunk := packed.read(_CHUNK):
                    sha.update(chunk)
                    file.write(chunk)
        except ZIP_FAULTS as error:
            target.unlink(missing_ok=True)
            faults.append(f"'{info.filename}' cannot be unpacked: {reason(error)}.")
            continue
        digests[info.filename] = sha.hexdigest()
    return digests, faults
