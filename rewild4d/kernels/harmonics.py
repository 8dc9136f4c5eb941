"""Real spherical harmonics up to degree 3 for kernels, and the colours of many Gaussians from one point.

The twin in plain torch is `rewild4d.harmonics`.
"""

import math

import numpy as np
import torch
from torch import Tensor

from rewild4d.kernels.arrays import array
from rewild4d.kernels.compiling import inlined, kernel
from rewild4d.kernels.simd import take_ticket
from rewild4d.kernels.threads import run, thread_count

C0 = 0.28209479177387814
C1 = 0.4886025119029199
C2 = (1.0925484305920792, -1.0925484305920792, 0.31539156525252005, -1.0925484305920792, 0.5462742152960396)
C3 = (
    -0.5900435899266435, 2.890611442640554, -0.4570457994644658, 0.3731763325901154,
    -0.4570457994644658, 1.445305721320277, -0.5900435899266435,
)  # fmt: skip

CHUNK = 1024
"""Gaussians a unit of work holds."""


@inlined
def set_basis(direction: tuple, degree: int, values: np.ndarray) -> None:
    """Values of the basis functions above degree 0, for a unit direction."""
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
            set_basis((x * inverse, y * inverse, z * inverse), degree, values)
            row = colors[n]
            red, green, blue = half + constant * row[0, 0], half + constant * row[0, 1], half + constant * row[0, 2]
            for k in range((degree + 1) ** 2 - 1):
                red += values[k] * row[k + 1, 0]
                green += values[k] * row[k + 1, 1]
                blue += values[k] * row[k + 1, 2]
            seen[n, 0], seen[n, 1], seen[n, 2] = max(red, zero), max(green, zero), max(blue, zero)


def shade(colors: Tensor, means: Tensor, eye: Tensor) -> Tensor:
    """Colours from a point; float32, CPU, without gradients.

    Args:
        colors: coefficients of degree 1 to 3, 0.5 standing for their zero, [n, 4 or 9 or 16, 3].
        means: of the Gaussians, [n, 3].
        eye: [3].

    Returns:
        Not below 0, [n, 3].
    """
    seen = torch.empty(len(means), 3)
    degree = math.isqrt(colors.shape[1]) - 1
    call = np.zeros(1, np.int64), array(colors), array(means), array(eye.float()), degree, seen.numpy()
    run(_shade, [call] * thread_count())
    return seen
