"""Queries of the deformation network: rows of a block of `layers.BLOCK` Gaussians."""

import math
from typing import Any, NamedTuple

import numpy as np

from rewild4d.kernels.compiling import kernel
from rewild4d.kernels.matrix import transpose_tile
from rewild4d.kernels.simd import LANES, fma, load, splat, store
from rewild4d.ours.fused.layers import BLOCK


class Scales(NamedTuple):
    """Units of the network's inputs and outputs."""

    position: float  # factor on positions before their code
    frequencies: int  # octaves of the code
    parts: int  # inputs before the position
    strength: float  # of the deformation, in [0, 1]
    offset: float  # displacement per unit of output
    log_scale: float  # bound on the change of log scale


@kernel
def _sines(query: np.ndarray, row: int, sine: int, cosine: int) -> None:
    """Set sine and cosine of a row of angles: Taylor series of a quarter, doubled twice; absolute error 3e-7."""
    for lane in range(0, BLOCK, LANES):
        x = load(query, row * BLOCK + lane)
        magic = splat(np.float32(1.5 * 2.0**23))
        cycles = (fma(x, splat(np.float32(0.5 / math.pi)), magic)) - magic
        # Two pi as the sum of a short and a long part, so that the product loses nothing.
        x = fma(cycles, splat(np.float32(-6.28125)), x)
        x = fma(cycles, splat(np.float32(6.28125 - 2 * math.pi)), x)
        x = x * splat(np.float32(0.25))
        xx = x * x
        s = fma(xx, splat(np.float32(1 / 362880)), splat(np.float32(-1 / 5040)))
        s = fma(xx, s, splat(np.float32(1 / 120)))
        s = fma(xx, s, splat(np.float32(-1 / 6)))
        s = fma(x * xx, s, x)
        c = fma(xx, splat(np.float32(-1 / 3628800)), splat(np.float32(1 / 40320)))
        c = fma(xx, c, splat(np.float32(-1 / 720)))
        c = fma(xx, c, splat(np.float32(1 / 24)))
        c = fma(xx, c, splat(np.float32(-0.5)))
        c = fma(xx, c, splat(np.float32(1)))
        for _ in range(2):
            s, c = _doubled(s, c)
        store(query, sine * BLOCK + lane, s)
        store(query, cosine * BLOCK + lane, c)


@kernel
def _doubled(s: Any, c: Any) -> tuple:
    """Return sine and cosine of twice the angle."""
    twice = s + s
    return twice * c, splat(np.float32(1)) - twice * s


@kernel
def mix(begin: int, end: int, weights: np.ndarray, anchors: np.ndarray, query: np.ndarray) -> None:
    """Set the first sixteen rows to the weighted sums of at most sixteen anchor components."""
    lines = np.zeros(BLOCK * LANES, np.float32)
    for n in range(begin, end):
        total = splat(np.float32(0))
        for j in range(weights.shape[1]):
            total = fma(splat(weights[n, j]), load(anchors, j * LANES), total)
        store(lines, (n - begin) * LANES, total)
    for lane in range(0, BLOCK, LANES):
        transpose_tile(lines, lane * LANES, LANES, query, lane, BLOCK)


@kernel
def mix_back(
    begin: int, end: int, weights: np.ndarray, on_query: np.ndarray, lines: np.ndarray, on_anchors: np.ndarray
) -> None:
    """Add the gradient of the anchors from that of the rows; ``lines`` is scratch."""
    for lane in range(0, BLOCK, LANES):
        transpose_tile(on_query, lane, BLOCK, lines, lane * LANES, LANES)
    for n in range(begin, end):
        grad = load(lines, (n - begin) * LANES)
        for j in range(weights.shape[1]):
            store(on_anchors, j * LANES, fma(splat(weights[n, j]), grad, load(on_anchors, j * LANES)))


@kernel
def read_query(
    begin: int, end: int, scales: Scales, weights: np.ndarray, anchors: np.ndarray, posed: tuple, query: np.ndarray
) -> None:
    """Set rows of part mixture, position code, orientation (w >= 0), log scale of Gaussians begin..end, else zero."""
    means, quats, log_scales = posed
    query[:] = 0
    code = scales.parts + 3
    tail = code + 6 * scales.frequencies
    if len(anchors) > 0:
        mix(begin, end, weights, anchors, query)
    for lane in range(end - begin):
        n = begin + lane
        if len(anchors) == 0:
            for i in range(scales.parts):
                query[i * BLOCK + lane] = weights[n, i]
        sign = np.float32(-1.0) if quats[n, 0] < 0 else np.float32(1.0)
        for i in range(3):
            query[(scales.parts + i) * BLOCK + lane] = means[n, i] * np.float32(scales.position)
            query[(tail + 4 + i) * BLOCK + lane] = log_scales[n, i]
        for i in range(4):
            query[(tail + i) * BLOCK + lane] = sign * quats[n, i]
    cosines = code + 3 * scales.frequencies
    for axis in range(3 if scales.frequencies > 0 else 0):
        _sines(query, scales.parts + axis, code + axis, cosines + axis)
        for octave in range(1, scales.frequencies):
            row = 3 * octave + axis
            for lane in range(0, BLOCK, LANES):
                before = (code + row - 3) * BLOCK + lane, (cosines + row - 3) * BLOCK + lane
                s, c = _doubled(load(query, before[0]), load(query, before[1]))
                store(query, (code + row) * BLOCK + lane, s)
                store(query, (cosines + row) * BLOCK + lane, c)
