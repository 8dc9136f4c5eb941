"""Read the convolutions of an ONNX file, without the package of that name: its wire format is protocol buffers."""

from collections.abc import Iterator

import numpy as np
import torch
from torch import Tensor

from rewild4d.errors import UserError

GRAPH, NODE, INITIALIZER = 7, 1, 5
"""Numbers of fields: of a model, and two of a graph."""
INPUT, KIND = 1, 4
"""Of a node."""
DIMENSIONS, TYPE, NAME, RAW = 1, 2, 8, 9
"""Of a tensor."""
FLOAT = 1
"""The type of a tensor."""


def read_convolutions(data: bytes, label: str) -> dict[str, Tensor]:
    """Read weights and biases of all convolutions, in the order in which the network uses them.

    Args:
        data: the file.
        label: its name in errors.

    Returns:
        "000.weight", [out, in, h, w], "000.bias", [out], "001.weight" and so on, float32.

    Raises:
        UserError: no ONNX file, or one whose convolutions have other than stored float32 weights and biases.
    """
    try:
        graph = next(
            value for field, value in _fields(memoryview(data)) if field == GRAPH and not isinstance(value, int)
        )
        nodes: list[tuple[str, list[str]]] = []
        tensors: dict[str, Tensor] = {}
        for field, value in _fields(graph):
            if isinstance(value, int):
                continue
            if field == NODE:
                nodes.append(_texts(value))
            elif field == INITIALIZER:
                tensors |= _tensor(value)
        used = [inputs for kind, inputs in nodes if kind == "Conv"]
        parts = ("weight", "bias")
        return {
            f"{index:03d}.{part}": tensors[name]
            for index, inputs in enumerate(used)
            for part, name in zip(parts, inputs[1:], strict=True)
        }
    except (StopIteration, IndexError, KeyError, ValueError, UnicodeDecodeError) as error:
        raise UserError(f"{label}: expected an ONNX file with stored float32 convolutions.") from error


def _texts(node: memoryview) -> tuple[str, list[str]]:
    """Return a node's kind and the names of its inputs."""
    kind, inputs = "", list[str]()
    for field, value in _fields(node):
        if not isinstance(value, int) and field in (INPUT, KIND):
            text = bytes(value).decode()
            kind, inputs = (text, inputs) if field == KIND else (kind, [*inputs, text])
    return kind, inputs


def _tensor(stored: memoryview) -> dict[str, Tensor]:
    """Return a float32 tensor by its name; nothing for those of another type."""
    shape: list[int] = []
    name, kind, raw = "", 0, b""
    for field, value in _fields(stored):
        if field == DIMENSIONS:
            shape += [value] if isinstance(value, int) else list(_numbers(value))
        elif field == TYPE and isinstance(value, int):
            kind = value
        elif field == NAME and not isinstance(value, int):
            name = bytes(value).decode()
        elif field == RAW and not isinstance(value, int):
            raw = bytes(value)
    if kind != FLOAT:
        return {}
    return {name: torch.from_numpy(np.frombuffer(raw, "<f4").reshape(shape).copy())}


def _fields(message: memoryview) -> Iterator[tuple[int, int | memoryview]]:
    """Yield the numbers and values of a message's fields; an IndexError where it ends too early."""
    place = 0
    while place < len(message):
        key, place = _number(message, place)
        kind = key & 7
        if kind == 0:
            value, place = _number(message, place)
            yield key >> 3, value
            continue
        length, place = (8, place) if kind == 1 else (4, place) if kind == 5 else _number(message, place)
        if kind not in (1, 2, 5) or place + length > len(message):
            raise IndexError
        yield key >> 3, message[place : place + length]
        place += length


def _numbers(packed: memoryview) -> Iterator[int]:
    place = 0
    while place < len(packed):
        value, place = _number(packed, place)
        yield value


def _number(message: memoryview, place: int) -> tuple[int, int]:
    """Return the number of seven bits a byte at a place, and the place behind it.

    Examples:
        >>> _number(memoryview(bytes((0b10101100, 0b10))), 0)  # 0b0101100 + (0b10 << 7)
        (300, 2)
    """
    value = shift = 0
    while True:
        byte = message[place]
        value, shift, place = value | (byte & 127) << shift, shift + 7, place + 1
        if byte < 128:
            return value, place
