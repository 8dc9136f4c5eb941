"""The bytes of a glTF file: its chunks, its JSON, files beside it. What is outsized or lies elsewhere is refused."""

import base64
import binascii
import struct
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from urllib.parse import unquote

import cv2
import numpy as np
from numpy.typing import NDArray

from rewild4d.errors import UserError, reason
from rewild4d.foreign.reading import TEXT, beside, picture_size, read_bytes, require_room
from rewild4d.foreign.texts import parse_json

MOST_NODES = 20_000
"""Of a file: rigs have hundreds."""
MOST_PARTS = 200_000
"""Of a file's JSON, objects and lists in all: rigs of a hundred clips have tens of thousands."""
MOST_NESTED = 50
"""Objects and lists of the JSON within each other."""
LISTS = (
    "nodes", "scenes", "meshes", "skins", "animations", "accessors", "bufferViews", "buffers", "materials", "textures",
    "images", "samplers",
)  # fmt: skip
PLAIN = ("extensions", "extras", "targets")
"""Members that stay dictionaries."""
MAGIC, TEXT_CHUNK, DATA_CHUNK = b"glTF", 0x4E4F534A, 0x004E4942
HEADER, CHUNK = struct.Struct("<4sII"), struct.Struct("<II")


class Part:
    """An object of a glTF file's JSON: members that it lacks are None."""

    def __init__(self, members: dict[str, Any]) -> None:
        self.__dict__.update(members)

    def __getattr__(self, name: str) -> Any:
        """Return None for what the file does not say."""
        if name.startswith("__"):
            raise AttributeError(name)
        return None


class Rows(list[Any]):
    """A list of a glTF file that is counted from 0: a number below is no place in it."""

    def __getitem__(self, index: Any) -> Any:
        """Return the entry at a place; IndexError where there is none."""
        if isinstance(index, int) and index < 0:
            raise IndexError(f"list index {index} out of range")
        return super().__getitem__(index)


@dataclass(frozen=True)
class GltfFile:
    """What one .glb or .gltf file holds.

    Attributes:
        tree: its JSON: each object a `Part`, but extensions are dictionaries; each of `LISTS` is there.
        blob: the buffer inside a .glb, or None.
        size: bytes of the file.
    """

    tree: Part
    blob: bytes | None
    size: int


def read_file(path: Path) -> GltfFile:
    """Read a file and take it apart.

    Raises:
        UserError: it is missing, no glTF 2, damaged, or has more nodes or parts than rigs have.
    """
    data = read_bytes(path, "a .glb or .gltf file")
    text, blob = _chunks(path, data) if data[:4] == MAGIC else (data, None)
    require_room(path, TEXT * len(text), "the JSON of a .glb or .gltf file")
    written = parse_json(text, path, "a .glb or .gltf file")
    about = written.get("asset") if isinstance(written, dict) else None
    if not isinstance(about, dict) or not str(about.get("version", "")).startswith("2"):
        raise UserError(f"{path}: expected glTF version 2, but it is another format or version.")
    for name in LISTS:
        rows = written.get(name) or []
        if not isinstance(rows, list) or not all(isinstance(row, dict) for row in rows):
            raise UserError(f"{path}: expected a list of objects '{name}', got something else.")
        written[name] = rows
    _require_few(path, written)
    return GltfFile(Part({name: _parts(value) for name, value in written.items()}), blob, len(data))


def _parts(value: Any) -> Any:
    """Return JSON with its objects as `Part`s; it is nested `MOST_NESTED` times at most."""
    if isinstance(value, dict):
        return Part({key: part if key in PLAIN else _parts(part) for key, part in value.items()})
    if isinstance(value, list):
        return Rows(_parts(item) if isinstance(item, dict | list) else item for item in value)
    return value


def _chunks(path: Path, data: bytes) -> tuple[bytes, bytes | None]:
    """Return the JSON of a .glb and its buffer."""
    found: dict[int, bytes] = {}
    place = HEADER.size
    while place + CHUNK.size <= len(data):
        length, kind = CHUNK.unpack_from(data, place)
        place += CHUNK.size
        if place + length > len(data):
            raise UserError(f"{path}: expected a whole .glb file, but it is cut off after {len(data)} bytes.")
        found.setdefault(kind, data[place : place + length])
        place += length
    if TEXT_CHUNK not in found:
        raise UserError(f"{path}: expected a .glb or .gltf file, but it cannot be parsed (it has no JSON).")
    return found[TEXT_CHUNK], found.get(DATA_CHUNK)


def _require_few(path: Path, written: dict[str, Any]) -> None:
    """Refuse a file that would take long before its parts are made objects of."""
    if (count := len(written["nodes"])) > MOST_NODES:
        raise UserError(f"{path}: expected a rig of at most {MOST_NODES} nodes, got {count}.")
    waiting: list[tuple[Any, int]] = [(written, 0)]
    parts = 0
    while waiting and parts <= MOST_PARTS:
        item, level = waiting.pop()
        if level > MOST_NESTED:
            raise UserError(f"{path}: expected JSON of a rig, got some that is nested {level} times.")
        if isinstance(item, dict):
            parts += 1
            waiting += [(entry, level + 1) for entry in item.values() if isinstance(entry, dict | list)]
        else:
            parts += 1 + len(item) // 100  # numbers are cheap
            waiting += [(entry, level + 1) for entry in item if isinstance(entry, dict | list)]
    if parts > MOST_PARTS:
        raise UserError(f"{path}: expected a rig of at most {MOST_PARTS} parts, got more.")


def fetch(path: Path, uri: Any) -> bytes:
    """Return what a URI of a glTF file names: data inside it, or a file in its folder.

    Raises:
        UserError: another kind of URI, a file elsewhere, missing or no plain file, or text that is no base64.
    """
    if not isinstance(uri, str) or not uri:
        raise UserError(f"{path}: expected the URI of a buffer or an image, but it has none.")
    if uri.startswith("data:"):
        try:
            return base64.b64decode(uri.partition(",")[2])
        except (binascii.Error, ValueError) as error:
            raise UserError(f"{path}: expected base64 in a data URI, but: {reason(error)}.") from error
    file = beside(path, unquote(uri))
    return read_bytes(file, f"the file that {path.name} names")


def decoded(path: Path, data: bytes, index: int) -> NDArray[np.uint8]:
    """Return an image, sRGB uint8, [h, w, 3].

    Raises:
        UserError: it cannot be decoded or is too large.
    """
    picture_size(path, data)
    try:
        pixels = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR) if data else None
    except cv2.error:  # more pixels than it takes
        pixels = None
    if pixels is None:
        raise UserError(f"{path}: expected a png, jpeg or webp texture, but image {index} cannot be decoded.")
    return np.ascontiguousarray(pixels[..., ::-1])


def least_alpha(data: bytes) -> float:
    """Return the least alpha of an image that `decoded` takes, in [0, 1]; 1 where it has none."""
    pixels = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
    if pixels is None or pixels.ndim < 3 or pixels.shape[2] < 4:
        return 1.0
    return float(pixels[..., 3].min() / (65535 if pixels.dtype == np.uint16 else 255))
