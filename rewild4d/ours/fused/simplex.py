"""Softmax of the rows of a large matrix; the twin is `torch.softmax`."""

from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from rewild4d.kernels.arrays import array
from rewild4d.kernels.compiling import kernel
from rewild4d.kernels.powers import LOG2_E, exp2
from rewild4d.kernels.simd import LANES, fma, maximum, splat, take_ticket
from rewild4d.kernels.tails import lanes_maximum, lanes_sum, load_first, store_first
from rewild4d.kernels.threads import run, thread_count

CHUNK = 1024
"""Rows a unit of work holds."""
LOWEST = np.float32(-126)
"""Powers of two below are all this one: exp2 knows no smaller, and beside a one it is nothing."""


@kernel
def _forward(tickets: np.ndarray, logits: np.ndarray, width: int, shares: np.ndarray) -> None:
    """Set shares; it and the logits are flat."""
    rows, bottom, zero = len(logits) // width, splat(np.float32(-np.inf)), splat(np.float32(0))
    while True:
        begin = take_ticket(tickets) * CHUNK
        if begin >= rows:
            return
        for place in range(begin * width, min(begin + CHUNK, rows) * width, width):
            top, total = bottom, zero
            for i in range(0, width, LANES):
                top = maximum(top, load_first(logits, place + i, width - i, bottom))
            shift = splat(-lanes_maximum(top) * LOG2_E)
            for i in range(0, width, LANES):
                bits = fma(load_first(logits, place + i, width - i, bottom), splat(LOG2_E), shift)
                share = exp2(maximum(splat(LOWEST), bits))  # in this order a NaN stays one
                store_first(shares, place + i, width - i, share)
                total = total + load_first(shares, place + i, width - i, zero)
            inverse = splat(np.float32(1) / lanes_sum(total))
            for i in range(0, width, LANES):
                store_first(shares, place + i, width - i, load_first(shares, place + i, width - i, zero) * inverse)


@kernel
def _backward(tickets: np.ndarray, shares: np.ndarray, slope: np.ndarray, width: int, on_logits: np.ndarray) -> None:
    rows, zero = len(shares) // width, splat(np.float32(0))
    while True:
        begin = take_ticket(tickets) * CHUNK
        if begin >= rows:
            return
        for place in range(begin * width, min(begin + CHUNK, rows) * width, width):
            along = zero
            for i in range(0, width, LANES):
                share = load_first(shares, place + i, width - i, zero)
                along = fma(share, load_first(slope, place + i, width - i, zero), along)
            mean = splat(lanes_sum(along))
            for i in range(0, width, LANES):
                share = load_first(shares, place + i, width - i, zero)
                own = load_first(slope, place + i, width - i, zero) - mean
                store_first(on_logits, place + i, width - i, share * own)


def softmax(logits: Tensor) -> Tensor:
    """Softmax over the last dimension; float32, CPU, [n, J] -> [n, J]."""
    return _Softmax.apply(logits)


class _Softmax(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, logits: Tensor) -> Tensor:
        shares, ctx.width = torch.empty(logits.shape), logits.shape[1]
        ctx.shares = shares.numpy().ravel()
        run(_forward, [(np.zeros(1, np.int64), array(logits).ravel(), ctx.width, ctx.shares)] * thread_count())
        return shares

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, slope: Tensor) -> Tensor:
        on_logits = torch.empty(slope.shape)
        call = np.zeros(1, np.int64), ctx.shares, array(slope).ravel(), ctx.width, on_logits.numpy().ravel()
        run(_backward, [call] * thread_count())
        return on_logits
