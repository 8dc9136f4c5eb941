"""Real spherical harmonics up to degree 3 for kernels: colours of many Gaussians from one point, and rotations.

The torch twin is `rewild4d.harmonics`, which also checks the shapes: kernels do not check bounds.
"""

import math
from typing import Any

import numpy as np
import torch
from torch import Tensor

from rewild4d.kernels.arrays import array
from rewild4d.kernels.compiling import inlined, kernel
from rewild4d.kernels.simd import LANES, fma, load, splat, store, take_ticket
from rewild4d.kernels.switch import Kernel
from rewild4d.kernels.threads import run_tickets

HARMONICS = Kernel(
    "harmonics of splats",
    "b359f502127f",
    "rewild4d.harmonics:rotated",
    "rewild4d.harmonics:seen_colors",
    "rewild4d.harmonics:basis",
    "rewild4d.harmonics:_band",
    "rewild4d.harmonics:_table",
)

C0 = 0.28209479177387814
C1 = 0.4886025119029199
C2 = (1.0925484305920792, -1.0925484305920792, 0.31539156525252005, -1.0925484305920792, 0.5462742152960396)
C3 = (
    -0.5900435899266435, 2.890611442640554, -0.4570457994644658, 0.3731763325901154,
    -0.4570457994644658, 1.445305721320277, -0.5900435899266435,
)  # fmt: skip

CHUNK = 1024


@inlined
def _set_basis(direction: tuple, degree: int, values: np.ndarray) -> None:
    """Set the basis functions above degree 0 for a unit direction."""
    x, y, z = direction
    values[0], values[1], values[2] = -C1 * y, C1 * z, -C1 * x
    if degree > 1:
        xx, yy, zz = x * x, y * y, z * z
        values[3], values[4] = C2[0] * x * y, C2[1] * y * z
        values[5], values[6] = C2[2] * (2 * zz - xx - yy), C2[3] * x * z
        values[7] = C2[4] * (xx - yy)
        if degree > 2:
            values[8], values[9] = C3[0] * y * (3 * xx - yy), C3[1] * x * y * z
            values[10], values[11] = C3[2] * y * (4 * zz - xx - yy), C3[3] * z * (2 * zz - 3 * xx - 3 * yy)
            values[12], values[13] = C3[4] * x * (4 * zz - xx - yy), C3[5] * z * (xx - yy)
            values[14] = C3[6] * x * (xx - 3 * yy)


@kernel
def _shade(
    tickets: np.ndarray, colors: np.ndarray, means: np.ndarray, eye: np.ndarray, degree: int, seen: np.ndarray
) -> None:
    values = np.empty(15, np.float32)
    zero, half, constant = np.float32(0), np.float32(0.5), np.float32(C0)
    while True:
        begin = take_ticket(tickets) * CHUNK
        if begin >= len(means):
            return
        for n in range(begin, min(begin + CHUNK, len(means))):
            x, y, z = means[n, 0] - eye[0], means[n, 1] - eye[1], means[n, 2] - eye[2]
            inverse = np.float32(1 / max(math.sqrt(x * x + y * y + z * z), 1e-12))
            _set_basis((x * inverse, y * inverse, z * inverse), degree, values)
            row = colors[n]
            red, green, blue = half + constant * row[0, 0], half + constant * row[0, 1], half + constant * row[0, 2]
            for k in range((degree + 1) ** 2 - 1):
                red += values[k] * row[k + 1, 0]
                green += values[k] * row[k + 1, 1]
                blue += values[k] * row[k + 1, 2]
            seen[n, 0], seen[n, 1], seen[n, 2] = max(red, zero), max(green, zero), max(blue, zero)


def shade(colors: Tensor, means: Tensor, eye: Tensor) -> Tensor:
    """Compute colours [n, 3], at least 0, from a point; coefficients offset by 0.5, float32 on the CPU."""
    seen = torch.empty(len(means), 3)
    degree = math.isqrt(colors.shape[1]) - 1
    run_tickets(_shade, array(colors), array(means), array(eye), degree, seen.numpy())
    return seen


@kernel
def set_band(x: Any, y: Any, z: Any, level: int, values: np.ndarray, wide: int) -> None:
    """Set rows, ``wide`` apart, of the functions of one degree, 1 to 3, for sixteen directions."""
    if level == 1:
        store(values, 0, y * splat(np.float32(-C1)))
        store(values, wide, z * splat(np.float32(C1)))
        store(values, 2 * wide, x * splat(np.float32(-C1)))
        return
    xx, yy, zz = x * x, y * y, z * z
    two, three, four = splat(np.float32(2)), splat(np.float32(3)), splat(np.float32(4))
    if level == 2:
        store(values, 0, x * y * splat(np.float32(C2[0])))
        store(values, wide, y * z * splat(np.float32(C2[1])))
        store(values, 2 * wide, (two * zz - xx - yy) * splat(np.float32(C2[2])))
        store(values, 3 * wide, x * z * splat(np.float32(C2[3])))
        store(values, 4 * wide, (xx - yy) * splat(np.float32(C2[4])))
        return
    across = four * zz - xx - yy
    store(values, 0, y * (three * xx - yy) * splat(np.float32(C3[0])))
    store(values, wide, x * y * z * splat(np.float32(C3[1])))
    store(values, 2 * wide, y * across * splat(np.float32(C3[2])))
    store(values, 3 * wide, z * (two * zz - three * (xx + yy)) * splat(np.float32(C3[3])))
    store(values, 4 * wide, x * across * splat(np.float32(C3[4])))
    store(values, 5 * wide, z * (xx - yy) * splat(np.float32(C3[5])))
    store(values, 6 * wide, x * (xx - three * yy) * splat(np.float32(C3[6])))


@kernel
def _rotate_band(
    level: int, directions: np.ndarray, inverses: np.ndarray, rotation: np.ndarray, rows: np.ndarray,
    values: np.ndarray, out: np.ndarray,
) -> None:  # fmt: skip
    """Add the rotated coefficients of one degree, from colours along rotated directions."""
    size, begin = 2 * level + 1, 3 * level * level
    for d in range(len(directions)):
        a, b, c = splat(directions[d, 0]), splat(directions[d, 1]), splat(directions[d, 2])
        x = fma(a, load(rotation, 0), fma(b, load(rotation, 3 * LANES), c * load(rotation, 6 * LANES)))
        y = fma(a, load(rotation, LANES), fma(b, load(rotation, 4 * LANES), c * load(rotation, 7 * LANES)))
        z = fma(a, load(rotation, 2 * LANES), fma(b, load(rotation, 5 * LANES), c * load(rotation, 8 * LANES)))
        set_band(x, y, z, level, values, LANES)
        for channel in range(begin, begin + 3):
            seen = splat(np.float32(0))
            for k in range(size):
                seen = fma(load(values, k * LANES), load(rows, (channel + 3 * k) * LANES), seen)
            for k in range(size):
                index = (channel + 3 * k) * LANES
                store(out, index, fma(splat(inverses[d, k]), seen, load(out, index)))


@kernel
def _rotate(
    tickets: np.ndarray, coefficients: np.ndarray, rotations: np.ndarray, tables: tuple, made: np.ndarray
) -> None:
    count, wide = coefficients.shape
    rotation, rows = np.zeros(9 * LANES, np.float32), np.zeros(wide * LANES, np.float32)
    values, out = np.empty(7 * LANES, np.float32), np.empty(wide * LANES, np.float32)
    while True:
        begin = take_ticket(tickets) * CHUNK
        if begin >= count:
            return
        for first in range(begin, min(begin + CHUNK, count), LANES):
            lanes = min(LANES, count - first)
            for lane in range(lanes):
                for i in range(9):
                    rotation[i * LANES + lane] = rotations[first + lane, i]
                for i in range(wide):
                    rows[i * LANES + lane] = coefficients[first + lane, i]
            out[: 3 * LANES] = rows[: 3 * LANES]
            out[3 * LANES :] = 0
            for level in range(1, len(tables) // 2 + 1):
                if 3 * level * level < wide:
                    _rotate_band(level, tables[2 * level - 2], tables[2 * level - 1], rotation, rows, values, out)
            for lane in range(lanes):
                for i in range(wide):
                    made[first + lane, i] = out[i * LANES + lane]


def turn(coefficients: Tensor, rotations: Tensor, tables: tuple[np.ndarray, ...]) -> Tensor:
    """Rotate the coefficients [n, 4 or 9 or 16, 3] of colours by rotations [n, 3, 3]; float32 on the CPU, no gradients.

    ``tables`` holds for the degrees 1, 2 and 3 directions [D, 3] that tell the functions apart, and the transposed
    pseudoinverse of the functions' values there, [D, 2 degree + 1].
    """
    made = torch.empty(coefficients.shape)
    flat = len(made), 3 * coefficients.shape[1]
    given = array(coefficients).reshape(flat), array(rotations).reshape(-1, 9)
    run_tickets(_rotate, *given, tables, made.numpy().reshape(flat))
    return made
