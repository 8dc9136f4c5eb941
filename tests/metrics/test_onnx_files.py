"""ONNX files, written here byte by byte: convolutions in the order of their use, and what is no such file."""

import numpy as np
import pytest
import torch

from rewild4d.errors import UserError
from rewild4d.metrics.carriers import convert

KERNELS = [np.arange(2 * 3 * 3 * 3, dtype="<f4").reshape(2, 3, 3, 3), np.full((1, 2, 1, 1), 0.5, "<f4")]
BIASES = [np.array((1, -1), "<f4"), np.array((300,), "<f4")]


def number(value: int) -> bytes:
    out = bytearray()
    while value > 127:
        out.append(value & 127 | 128)
        value >>= 7
    return bytes((*out, value))


def field(index: int, value: int | bytes | str) -> bytes:
    if isinstance(value, int):
        return number(index << 3) + number(value)
    data = value.encode() if isinstance(value, str) else value
    return number(index << 3 | 2) + number(len(data)) + data


def tensor(name: str, values: np.ndarray, *, packed: bool, kind: int = 1) -> bytes:
    shape = b"".join(map(number, values.shape))
    sizes = field(1, shape) if packed else b"".join(field(1, size) for size in values.shape)
    return field(5, sizes + field(2, kind) + field(8, name) + field(9, values.tobytes()))


def node(kind: str, *inputs: str) -> bytes:
    return field(1, b"".join(field(1, name) for name in inputs) + field(2, "out") + field(4, kind))


def model(*, kind: int = 1) -> bytes:
    """A model whose second convolution's tensors are stored first."""
    graph = node("Conv", "x", "w0", "b0") + node("Relu", "y") + node("Conv", "z", "w1", "b1")
    for index in (1, 0):
        graph += tensor(f"w{index}", KERNELS[index], packed=index == 0, kind=kind)
        graph += tensor(f"b{index}", BIASES[index], packed=False, kind=kind)
    graph += tensor("size", np.array((1, 2), "<i8"), packed=False, kind=7)
    return field(1, 6) + field(2, "pytorch") + number(15 << 3 | 5) + bytes(4) + field(7, graph)


def test_convolutions_come_in_the_order_of_their_use() -> None:
    found = convert(model(), "onnx", "in-order", "x.onnx")
    assert list(found) == ["000.bias", "000.weight", "001.bias", "001.weight"]
    for index in range(2):
        assert torch.equal(found[f"{index:03d}.weight"], torch.from_numpy(KERNELS[index].copy()))
        assert torch.equal(found[f"{index:03d}.bias"], torch.from_numpy(BIASES[index].copy()))


@pytest.mark.parametrize(
    "data", [b"", b"no model", model()[:-9], model()[:40], model(kind=10), field(7, 3), b"\xff" * 9]
)
def test_another_file_is_refused_in_a_sentence(data: bytes) -> None:
    with pytest.raises(UserError, match=r"x.onnx: expected an ONNX file with stored float32 convolutions\."):
        convert(data, "onnx", "in-order", "x.onnx")
