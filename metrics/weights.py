"""Find, check and convert the weights of the metric networks, and of the one that makes masks.

A network is kept as one safetensors file, `<name>.safetensors`, whose SHA-256 stands in `weights.toml`; it is hashed
before it is parsed, at every load. Networks:

    lpips-alex, lpips-vgg    LPIPS v0.1, trunk and heads
    inception-fid            the Inception-v3 of December 2015, without its classifier
    i3d-k400                 I3D trained on Kinetics-400, TF-hub's i3d-kinetics-400/1
    u2netp                   U²-Net-p, for `masks --tool track`: no metric uses it

Nothing is downloaded unasked. A network that is not found raises `WeightsMissing`, with the command that fetches it.
"""

from __future__ import annotations

import contextlib
import hashlib
import os
import tarfile
import zipfile
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache
from importlib import resources
from pathlib import Path
from typing import TYPE_CHECKING

import msgspec

from rewild4d.errors import UserError, unknown_name
from rewild4d.files import atomic, cache_folder

if TYPE_CHECKING:
    from torch import Tensor

    from rewild4d.metrics.carriers import Tensors

FETCH = "rewild4d-bench weights fetch"


class WeightsMissing(UserError):
    """A network's weights were found nowhere; the text names the command that fetches them."""

    def __init__(self) -> None:
        super().__init__(f"weights missing, run: {FETCH}")


class Pinned(msgspec.Struct, frozen=True, kw_only=True):
    """A file whose bytes are known."""

    bytes: int
    sha256: str


class Network(Pinned, frozen=True, kw_only=True):
    """A kept network; each of the lists in `made_from` names published files that suffice to make it."""

    used_by: str
    licence: str
    made_from: list[list[str]]


class Archive(Pinned, frozen=True, kw_only=True):
    """A package on PyPI with published files: name -> path in the archive; ``python`` is a version that it admits."""

    requirement: str
    members: dict[str, str]
    python: str = ""


class PublishedFile(Pinned, frozen=True, kw_only=True):
    """A published file, its form and layout (`carriers`), and other names of it."""

    form: str
    layout: str
    also: list[str] = []


class Table(msgspec.Struct, frozen=True):
    """Contents of `weights.toml`."""

    networks: dict[str, Network]
    archives: dict[str, Archive]
    files: dict[str, PublishedFile]


@dataclass(frozen=True)
class LoadedWeights:
    """A network's tensors by name, float32, and the SHA-256 of their file."""

    tensors: dict[str, Tensor]
    digest: str


@dataclass(frozen=True)
class Copy:
    """Location of a published file's bytes: a file, or a member of an archive."""

    path: Path
    member: str | None = None


@cache
def table() -> Table:
    """Read the known networks, archives and files."""
    return msgspec.toml.decode((resources.files("rewild4d.metrics") / "weights.toml").read_bytes(), type=Table)


def network(name: str) -> Network:
    """Return a network's entry; UserError where there is none of that name."""
    if name not in table().networks:
        raise unknown_name("network", name, table().networks)
    return table().networks[name]


def home() -> Path:
    """Return the folder of fetched and imported networks: $REWILD4D_WEIGHTS, or `weights` in the toolkit's cache."""
    chosen = os.environ.get("REWILD4D_WEIGHTS")
    return Path(chosen).expanduser() if chosen else cache_folder() / "weights"


def search_folders() -> list[Path]:
    """Return the folders to search, in order: $REWILD4D_WEIGHTS, the toolkit's cache, torch.hub's checkpoints."""
    import torch.hub

    folders = (home(), cache_folder() / "weights", Path(torch.hub.get_dir()) / "checkpoints")
    return list(dict.fromkeys(folders))


def load_weights(name: str, path: Path | None = None) -> LoadedWeights:
    """Find a network, check it byte for byte, and read it.

    Published files in a searched folder are converted, and the result is kept where possible.

    Args:
        name: "lpips-alex", "lpips-vgg", "inception-fid", "i3d-k400" or "u2netp".
        path: a safetensors file, or a folder to search instead of `search_folders`.

    Raises:
        WeightsMissing: it is found nowhere.
        UserError: unknown name, no such path, or a file with other bytes; nothing is loaded then.
    """
    known = network(name)
    if path is not None and not path.exists():
        raise UserError(f"{path}: expected the weights of '{name}', found no such file or folder.")
    if path is not None and path.is_file():
        return _parse(read_pinned(path, known, name), known)
    for folder in [path] if path is not None else search_folders():
        file = folder / f"{name}.safetensors"
        if file.is_file():
            return _parse(read_pinned(file, known, name), known)
        copies = published_copies(folder, name)
        if copies:
            data = make(name, copies)
            with contextlib.suppress(UserError):  # a cache that cannot be written costs a second at the next load
                keep(name, data)
            return _parse(data, known)
    raise WeightsMissing


def is_here(name: str) -> bool:
    """Return whether `load_weights` would find a network or its published files, without reading them."""
    return any((at / f"{name}.safetensors").is_file() or published_copies(at, name) for at in search_folders())


def _parse(data: bytes, known: Network) -> LoadedWeights:
    import safetensors.torch

    return LoadedWeights(safetensors.torch.load(data), known.sha256)


def read_pinned(path: Path, known: Pinned, what: str) -> bytes:
    """Read a file; UserError unless its bytes are the known ones."""
    try:
        data = path.read_bytes()
    except OSError as error:
        raise UserError(f"{path}: could not be read: {error.strerror}.") from error
    _check_pinned(data, known, what, path)
    return data


def _check_pinned(data: bytes, known: Pinned, what: str, path: Path) -> None:
    found = hashlib.sha256(data).hexdigest()
    if found != known.sha256:
        raise UserError(
            f"{path}: expected '{what}' with {known.bytes} bytes and SHA-256 {known.sha256[:16]}..., got {len(data)} "
            f"bytes with {found[:16]}...; it is damaged or another file, and nothing was loaded; remove it, then run: "
            f"{FETCH}"
        )


def published_copies(folder: Path, name: str) -> dict[str, Copy]:
    """Find, by their usual names, one set of files in a folder that a network can be made from."""
    for wanted in network(name).made_from:
        copies = {file: Copy(path) for file in wanted for path in by_name(folder, file)}
        if len(copies) == len(wanted):
            return copies
    return {}


def by_name(folder: Path, file: str) -> Iterator[Path]:
    """Find a published file in a folder under any of its names."""
    for name in (file, *table().files[file].also):
        if (folder / name).is_file():
            yield folder / name


def make(name: str, copies: dict[str, Copy]) -> bytes:
    """Make a network's safetensors file from copies of published files; UserError unless all bytes are known."""
    import safetensors.torch

    from rewild4d.metrics.carriers import convert

    tensors: Tensors = {}
    for file, copy in copies.items():
        known = table().files[file]
        tensors |= convert(_bytes_of(copy, file), known.form, known.layout, str(copy.path))
    data = safetensors.torch.save(dict(sorted(tensors.items())))
    if hashlib.sha256(data).hexdigest() != network(name).sha256:
        files = " and ".join(str(copy.path) for copy in copies.values())
        raise UserError(f"{files}: expected the tensors of '{name}', got others; nothing was kept; run: {FETCH}")
    return data


def _bytes_of(copy: Copy, file: str) -> bytes:
    known = table().files[file]
    if copy.member is None:
        return read_pinned(copy.path, known, file)
    try:
        if zipfile.is_zipfile(copy.path):
            with zipfile.ZipFile(copy.path) as wheel:
                data = wheel.read(copy.member)
        else:
            with tarfile.open(copy.path) as archive:
                member = archive.extractfile(copy.member)
                data = member.read() if member else b""
    except (OSError, EOFError, KeyError, tarfile.TarError, zipfile.BadZipFile) as error:
        raise UserError(f"{copy.path}: expected an archive that holds {copy.member}.") from error
    _check_pinned(data, known, file, copy.path)
    return data


def keep(name: str, data: bytes) -> Path:
    """Write a network where `load_weights` finds it, atomically."""
    path = home() / f"{name}.safetensors"
    with atomic(path) as temporary:
        temporary.write_bytes(data)
    return path
