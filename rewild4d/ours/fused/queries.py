"""What a Gaussian asks the deformation network: rows of a block of `layers.BLOCK` Gaussians."""

import math
from typing import Any, NamedTuple

import numpy as np

from rewild4d.kernels.compiling import kernel
from rewild4d.kernels.matrix import transpose_tile
from rewild4d.kernels.simd import LANES, fma, load, splat, store
from rewild4d.ours.fused.layers import BLOCK


class Reach(NamedTuple):
    """What an output of one means.

    Attributes:
        place: scale of the position before its code.
        frequencies: octaves of the code.
        parts: inputs before the position.
        strength: the ramp.
        reach: displacement.
        grow: bound on the change of log scale.
    """

    place: float
    frequencies: int
    parts: int
    strength: float
    reach: float
    grow: float


@kernel
def _sines(query: np.ndarray, row: int, sine: int, cosine: int) -> None:
    """Sine and cosine of a row of angles, by Taylor series of a quarter and two doublings, absolute error 3e-7."""
    for lane in range(0, BLOCK, LANES):
        x = load(query, row * BLOCK + lane)
        magic = splat(np.float32(1.5 * 2.0**23))
        turns = (fma(x, splat(np.float32(0.5 / math.pi)), magic)) - magic
        # Two pi as the sum of a short and a long part, so that the product loses nothing.
        x = fma(turns, splat(np.float32(-6.28125)), x)
        x = fma(turns, splat(np.float32(6.28125 - 2 * math.pi)), x)
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
    """Sine and cosine of twice the angle."""
    twice = s + s
    return twice * c, splat(np.float32(1)) - twice * s


@kernel
def mix(begin: int, end: int, weights: np.ndarray, anchors: np.ndarray, query: np.ndarray) -> None:
    """Set the first sixteen rows to the weighted sums of the anchors, of which there are fewer."""
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
    """Add to the gradient of the anchors from that of the rows; ``lines`` is scratch."""
    for lane in range(0, BLOCK, LANES):
        transpose_tile(on_query, lane, BLOCK, lines, lane * LANES, LANES)
    for n in range(begin, end):
        slope = load(lines, (n - begin) * LANES)
        for j in range(weights.shape[1]):
            store(on_anchors, j * LANES, fma(splat(weights[n, j]), slope, load(on_anchors, j * LANES)))


@kernel
def read_query(
    begin: int, end: int, reach: Reach, weights: np.ndarray, anchors: np.ndarray, means: np.ndarray,
    quats: np.ndarray, log_scales: np.ndarray, query: np.ndarray,
) -> None:  # fmt: skip
    """Rows of part mixture, position code, orientation (w >= 0) and size of Gaussians begin..end; the rest are zero."""
    query[:] = 0
    code = reach.parts + 3
    tail = code + 6 * reach.frequencies
    if len(anchors) > 0:
        mix(begin, end, weights, anchors, query)
    for lane in range(end - begin):
        n = begin + lane
        if len(anchors) == 0:
            for i in range(reach.parts):
                query[i * BLOCK + lane] = weights[n, i]
        sign = np.float32(-1.0) if quats[n, 0] < 0 else np.float32(1.0)
        for i in range(3):
            query[(reach.parts + i) * BLOCK + lane] = means[n, i] * np.float32(reach.place)
            query[(tail + 4 + i) * BLOCK + lane] = log_scales[n, i]
        for i in range(4):
            query[(tail + i) * BLOCK + lane] = sign * quats[n, i]
    cosines = code + 3 * reach.frequencies
    for axis in range(3 if reach.frequencies > 0 else 0):
        _sines(query, reach.parts + axis, code + axis, cosines + axis)
        for octave in range(1, reach.frequencies):
            row = 3 * octave + axis
            for lane in range(0, BLOCK, LANES):
                before = (code + row - 3) * BLOCK + lane, (cosines + row - 3) * BLOCK + lane
                s, c = _doubled(load(query, before[0]), load(query, before[1]))
                store(query, (code + row) * BLOCK + lane, s)
                store(query, (cosines + row) * BLOCK + lane, c)
