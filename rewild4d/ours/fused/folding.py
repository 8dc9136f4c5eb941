"""Flatten the deformation network, its few keys and values folded into the first matrices."""

from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from rewild4d.kernels.arrays import array
from rewild4d.ours.fused.layers import OUTPUTS, Layout, layout, round_up


class Layers(NamedTuple):
    """Weights [outputs, inputs] and biases [outputs] of `DeformNetwork`."""

    query: Any
    query_bias: Any
    skip: Any
    skip_bias: Any
    key: Any
    key_bias: Any
    value: Any
    value_bias: Any
    project: Any
    project_bias: Any
    up: Any
    up_bias: Any
    down: Any
    down_bias: Any
    out: Any
    out_bias: Any


def fold(features: Tensor, layers: Layers, heads: int) -> tuple[Tensor, Layout]:
    """Return the flat array [total] of a network that attends to features [J, K], and its layout; float32, CPU."""
    width, inputs = layers.query.shape
    sizes = layout(inputs, heads * len(features), width, heads)
    return _Fold.apply(features, sizes, *layers), sizes


def _by_head(own: Layers, heads: int) -> tuple[np.ndarray, np.ndarray]:
    """Return query weights [H, S, inputs] and projection weights [H, width, S] of each head."""
    width, inputs = own.query.shape
    asking = own.query.reshape(heads, width // heads, inputs)
    return asking, own.project.reshape(width, heads, width // heads).transpose(1, 0, 2)


class _Fold(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, features: Tensor, sizes: Layout, *layers: Tensor) -> Tensor:
        given, own = array(features), Layers(*map(array, layers))
        heads, width, inputs = sizes.heads, sizes.width, sizes.inputs
        size = width // heads
        scale = np.float32(size**-0.5)
        # [H, J, S] and [H, S, J]
        keys = (given @ own.key.T + own.key_bias).reshape(-1, heads, size).transpose(1, 0, 2) * scale
        values = (given @ own.value.T + own.value_bias).reshape(-1, heads, size).transpose(1, 2, 0)
        asking, mixing = _by_head(own, heads)
        flat = np.zeros(sizes.total, np.float32)
        pieces = matrices(flat, sizes)
        pieces.ask[0][:] = (keys @ asking).reshape(sizes.scores, inputs)
        pieces.ask[1][:] = (keys @ own.query_bias.reshape(heads, size, 1)).ravel()
        pieces.mix[0][:] = (mixing @ values).transpose(1, 0, 2).reshape(width, sizes.scores)
        pieces.skip[0][:], pieces.skip[1][:] = own.skip, own.skip_bias + own.project_bias
        pieces.up[0][:], pieces.up[1][:] = own.up, own.up_bias
        pieces.down[0][:], pieces.down[1][:] = own.down, own.down_bias
        pieces.out[0][:], pieces.out[1][:] = own.out, own.out_bias
        ctx.save_for_backward(features, *layers)
        ctx.sizes, ctx.scale, ctx.made = sizes, scale, (keys, values)
        return torch.from_numpy(flat)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor | None, ...]:
        features, *layers = ctx.saved_tensors
        given, own = array(features), Layers(*map(array, layers))
        sizes, (keys, values) = ctx.sizes, ctx.made
        heads, width = sizes.heads, sizes.width
        asking, mixing = _by_head(own, heads)
        pieces = matrices(array(grad), sizes)
        on_asked = pieces.ask[0].reshape(heads, -1, sizes.inputs)
        on_bias = pieces.ask[1].reshape(heads, -1, 1)
        on_mixed = pieces.mix[0].reshape(width, heads, -1).transpose(1, 0, 2)
        bias = own.query_bias.reshape(heads, 1, -1)
        on_keys = (on_asked @ asking.transpose(0, 2, 1) + on_bias * bias).transpose(1, 0, 2) * ctx.scale
        on_values = (mixing.transpose(0, 2, 1) @ on_mixed).transpose(2, 0, 1)
        on_keys, on_values = on_keys.reshape(-1, width), on_values.reshape(-1, width)
        transposed = keys.transpose(0, 2, 1)
        found = Layers(
            query=(transposed @ on_asked).reshape(width, -1),
            query_bias=(transposed @ on_bias).ravel(),
            skip=pieces.skip[0],
            skip_bias=pieces.skip[1],
            key=on_keys.T @ given,
            key_bias=on_keys.sum(axis=0),
            value=on_values.T @ given,
            value_bias=on_values.sum(axis=0),
            project=(on_mixed @ values.transpose(0, 2, 1)).transpose(1, 0, 2).reshape(width, width),
            project_bias=pieces.skip[1],
            up=pieces.up[0],
            up_bias=pieces.up[1],
            down=pieces.down[0],
            down_bias=pieces.down[1],
            out=pieces.out[0],
            out_bias=pieces.out[1],
        )
        on_features = on_keys @ own.key + on_values @ own.value if ctx.needs_input_grad[0] else None
        return (
            None if on_features is None else torch.from_numpy(on_features),
            None,
            *(torch.from_numpy(np.ascontiguousarray(part)) for part in found),
        )


class Matrices(NamedTuple):
    """Views of matrices and their biases in a flat array, without the padding."""

    ask: tuple[np.ndarray, np.ndarray]
    skip: tuple[np.ndarray, np.ndarray]
    mix: tuple[np.ndarray, np.ndarray]
    up: tuple[np.ndarray, np.ndarray]
    down: tuple[np.ndarray, np.ndarray]
    out: tuple[np.ndarray, np.ndarray]


def matrices(flat: np.ndarray, sizes: Layout) -> Matrices:
    """Return the parts of a flat array, [sizes.total]."""
    width = sizes.width

    def piece(first: int, rows: int, columns: int) -> tuple[np.ndarray, np.ndarray]:
        wide, end = round_up(columns), first + round_up(rows) * round_up(columns)
        return flat[first:end].reshape(-1, wide)[:rows, :columns], flat[end : end + rows]

    return Matrices(
        piece(sizes.ask, sizes.scores, sizes.inputs),
        piece(sizes.skip, width, sizes.inputs),
        piece(sizes.mix, width, sizes.scores),
        piece(sizes.up, width, width),
        piece(sizes.down, width, width),
        piece(sizes.out, OUTPUTS, width),
    )
