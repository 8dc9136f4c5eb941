"""Quaternions, wxyz, inside kernels: tuples (or rows of an array) of four numbers; unit ones carry a fifth.

A number is a float or `simd.Lanes`, except in `side`, `unit` and `unit_row`.
"""

import math

import numpy as np

from rewild4d.kernels.compiling import inlined
from rewild4d.kernels.simd import divide, maximum, splat, square_root

SHORTEST = 1e-12
"""Least length in a division, as in torch's `normalize`."""


@inlined
def dot(p: tuple, q: tuple) -> float:
    """Return the dot product."""
    return p[0] * q[0] + p[1] * q[1] + p[2] * q[2] + p[3] * q[3]


@inlined
def side(p: tuple, q: tuple) -> float:
    """Return the sign that aligns one with the other."""
    return -1.0 if dot(p, q) < 0 else 1.0


@inlined
def times(p: tuple, q: tuple) -> tuple:
    """Multiply p q: rotation q, then p."""
    return (
        p[0] * q[0] - p[1] * q[1] - p[2] * q[2] - p[3] * q[3],
        p[0] * q[1] + p[1] * q[0] + p[2] * q[3] - p[3] * q[2],
        p[0] * q[2] - p[1] * q[3] + p[2] * q[0] + p[3] * q[1],
        p[0] * q[3] + p[1] * q[2] - p[2] * q[1] + p[3] * q[0],
    )


@inlined
def times_back(p: tuple, q: tuple) -> tuple:
    """Multiply p conj(q)."""
    return (
        dot(p, q),
        p[1] * q[0] - p[0] * q[1] - p[2] * q[3] + p[3] * q[2],
        p[2] * q[0] - p[0] * q[2] + p[1] * q[3] - p[3] * q[1],
        p[3] * q[0] - p[0] * q[3] - p[1] * q[2] + p[2] * q[1],
    )


@inlined
def back_times(p: tuple, q: tuple) -> tuple:
    """Multiply conj(p) q."""
    return (
        dot(p, q),
        p[0] * q[1] - p[1] * q[0] - p[2] * q[3] + p[3] * q[2],
        p[0] * q[2] + p[1] * q[3] - p[2] * q[0] - p[3] * q[1],
        p[0] * q[3] - p[1] * q[2] + p[2] * q[1] - p[3] * q[0],
    )


@inlined
def read_row(quats: np.ndarray, n: int) -> tuple:
    """Read a row of an array."""
    return quats[n, 0], quats[n, 1], quats[n, 2], quats[n, 3]


@inlined
def unit(q: tuple) -> tuple:
    """Normalise in double precision; append one over the length."""
    inverse = 1 / max(math.sqrt(dot(q, q)), SHORTEST)
    return q[0] * inverse, q[1] * inverse, q[2] * inverse, q[3] * inverse, inverse


@inlined
def unit_row(quats: np.ndarray, n: int) -> tuple:
    """Normalise a row of a float32 array in single precision; append one over the length."""
    a, b, c, d = read_row(quats, n)
    inverse = np.float32(1 / max(math.sqrt(a * a + b * b + c * c + d * d), SHORTEST))
    return a * inverse, b * inverse, c * inverse, d * inverse, inverse


@inlined
def unit_lanes(q: tuple) -> tuple:
    """Normalise sixteen quaternions in single precision; append one over the length."""
    # In this order of the limit a NaN stays one.
    inverse = divide(splat(np.float32(1)), maximum(splat(np.float32(SHORTEST)), square_root(dot(q, q))))
    return q[0] * inverse, q[1] * inverse, q[2] * inverse, q[3] * inverse, inverse


@inlined
def unit_grad(unit: tuple, grad: tuple) -> tuple:
    """Compute the gradient of a quaternion from that of its unit quaternion."""
    along, inverse = dot(unit, grad), unit[4]
    return (
        (grad[0] - along * unit[0]) * inverse, (grad[1] - along * unit[1]) * inverse,
        (grad[2] - along * unit[2]) * inverse, (grad[3] - along * unit[3]) * inverse,
    )  # fmt: skip


@inlined
def rotation(q: tuple) -> tuple:
    """Return the rows of the matrix of a unit quaternion."""
    w, x, y, z = q[0], q[1], q[2], q[3]
    return (
        (1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
        (2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
        (2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
    )


@inlined
def rotation_grad(q: tuple, g: np.ndarray) -> tuple:
    """Compute the gradient of a unit quaternion from that of its matrix, the upper left of ``g``."""
    w, x, y, z = q[0], q[1], q[2], q[3]
    return (
        2 * (x * (g[2, 1] - g[1, 2]) + y * (g[0, 2] - g[2, 0]) + z * (g[1, 0] - g[0, 1])),
        2 * (y * (g[0, 1] + g[1, 0]) + z * (g[0, 2] + g[2, 0]) + w * (g[2, 1] - g[1, 2]) - 2 * x * (g[1, 1] + g[2, 2])),
        2 * (x * (g[0, 1] + g[1, 0]) + z * (g[1, 2] + g[2, 1]) + w * (g[0, 2] - g[2, 0]) - 2 * y * (g[0, 0] + g[2, 2])),
        2 * (x * (g[0, 2] + g[2, 0]) + y * (g[1, 2] + g[2, 1]) + w * (g[1, 0] - g[0, 1]) - 2 * z * (g[0, 0] + g[1, 1])),
    )
