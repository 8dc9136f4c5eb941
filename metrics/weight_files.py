"""Recognise a user's weight files by their SHA-256, convert them once, and list what is there."""

import hashlib
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field
from pathlib import Path

from rewild4d.errors import UserError
from rewild4d.metrics.weights import Copy, Pinned, by_name, keep, make, network, read_pinned, search_folders, table

LISTED = "`rewild4d-bench weights --help` lists"


@dataclass(frozen=True)
class Found:
    """A file of a network in one of the searched folders.

    Attributes:
        network: name of the network.
        path: of the file.
        ready: whether it is the kept network itself, and not a published file to convert.
        fault: why it is refused.
    """

    network: str
    path: Path
    ready: bool
    fault: str | None


@dataclass
class Recognised:
    """A user's files: kept networks, and copies of published files."""

    networks: dict[str, Path] = field(default_factory=dict)
    files: dict[str, Copy] = field(default_factory=dict)


def inspect(names: Iterable[str] | None = None) -> list[Found]:
    """List every file of the networks in the searched folders, read and hashed, in the order of preference.

    Args:
        names: of networks; all where None.
    """
    found = []
    for name in names if names is not None else table().networks:
        known = network(name)
        for folder in search_folders():
            kept = folder / f"{name}.safetensors"
            if kept.is_file():
                found.append(Found(name, kept, True, _fault(kept, known, name)))
            for file in (file for files in known.made_from for file in files):
                for path in by_name(folder, file):
                    found.append(Found(name, path, False, _fault(path, table().files[file], file)))
    return found


def _fault(path: Path, known: Pinned, what: str) -> str | None:
    try:
        read_pinned(path, known, what)
    except UserError as error:
        return str(error)
    return None


def import_weights(paths: Iterable[Path], say: Callable[[str], None], names: Iterable[str] | None = None) -> list[Path]:
    """Make every network that some files suffice for, and keep it.

    Args:
        paths: files under any name, or folders that are searched recursively.
        say: called with a line before each conversion.
        names: of the networks to make; all where None.

    Returns:
        The files that were written.

    Raises:
        UserError: no such path, a file has other bytes than its name implies, none is known, or none suffices; nothing
            is written then.
    """
    given = list(paths)
    recognised = _recognise(given)
    made = {}
    for name in names if names is not None else table().networks:
        sets = [files for files in network(name).made_from if recognised.files.keys() >= set(files)]
        if name in recognised.networks:
            made[name] = read_pinned(recognised.networks[name], network(name), name)
        elif sets:
            say(f"{name}: converting {' and '.join(sets[0])}")
            made[name] = make(name, {file: recognised.files[file] for file in sets[0]})
    if not made:
        raise UserError(_nothing_made(given, recognised))
    return [keep(name, data) for name, data in made.items()]


def _recognise(paths: list[Path]) -> Recognised:
    result = Recognised()
    for path in paths:
        if not path.exists():
            raise UserError(f"{path}: expected a file or a folder of weights, found neither.")
        inside = path.is_dir()
        for file in sorted(_candidates(path)) if inside else [path]:
            _recognise_file(file, result)
    return result


def _candidates(folder: Path) -> Iterator[Path]:
    """List files whose size or name is that of a known one; only these are hashed."""
    sizes = {known.bytes for known in _all_known().values()}
    for path in folder.rglob("*"):
        if path.is_file() and (path.name in _all_known() or path.stat().st_size in sizes):
            yield path


def _all_known() -> dict[str, Pinned]:
    """Return every accepted file by each of its names."""
    known: dict[str, Pinned] = {f"{name}.safetensors": network for name, network in table().networks.items()}
    known |= table().archives
    for name, file in table().files.items():
        known |= dict.fromkeys((name, *file.also), file)
    return known


def _recognise_file(path: Path, result: Recognised) -> None:
    """Register a file; unknown ones are skipped, one with a known name and other bytes raises UserError."""
    try:
        with path.open("rb") as stream:
            sha256 = hashlib.file_digest(stream, "sha256").hexdigest()
    except OSError as error:
        raise UserError(f"{path}: could not be read: {error.strerror}.") from error
    for name, known in table().networks.items():
        if known.sha256 == sha256:
            result.networks[name] = path
    for archive in table().archives.values():
        if archive.sha256 == sha256:
            result.files |= {file: Copy(path, member) for file, member in archive.members.items()}
    for name, file in table().files.items():
        if file.sha256 == sha256:
            result.files[name] = Copy(path)
    named = _all_known().get(path.name)
    if named is not None and named.sha256 != sha256:
        raise UserError(
            f"{path}: expected {named.bytes} bytes with SHA-256 {named.sha256[:16]}..., got {path.stat().st_size} "
            f"bytes with {sha256[:16]}...; it is damaged or another file, and nothing was imported."
        )


def _nothing_made(paths: list[Path], recognised: Recognised) -> str:
    """Say in one sentence why no network could be made."""
    given = ", ".join(map(str, paths))
    for file in recognised.files:
        for known in table().networks.values():
            for files in known.made_from:
                if file in files and len(files) > 1:
                    others = " and ".join(f"'{other}'" for other in files if other not in recognised.files)
                    return f"{given}: expected {others} beside '{file}'; give both, or a folder that holds both."
    if len(paths) == 1 and paths[0].is_file():
        sha256 = hashlib.sha256(paths[0].read_bytes()).hexdigest()
        return f"{given}: its SHA-256 {sha256} is none of those that {LISTED}."
    return f"{given}: expected at least one of the files that {LISTED}, found none."
