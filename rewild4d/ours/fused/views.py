"""What a rendered view tells beside its losses: where anything is seen, and what densification collects.

The twins in plain torch are in ours/losses.py and ours/density.py.
"""

import math

import numpy as np
from torch import Tensor

from rewild4d.kernels.arrays import array
from rewild4d.kernels.compiling import kernel


@kernel
def _mark(matte: np.ndarray, rows: np.ndarray, columns: np.ndarray) -> None:
    for y in range(len(rows)):
        line, found = matte[0, y], np.uint8(0)
        for x in range(len(columns)):
            above = np.uint8(line[x] > 0)
            columns[x] |= above
            found |= above
        rows[y] |= found


def extent(mattes: list[Tensor]) -> tuple[tuple[int, int], tuple[int, int]]:
    """First and last row, first and last column with a number above zero in any matte; zeros where there is none.

    Args:
        mattes: of one size, [1, h, w] each; float32, CPU.
    """
    rows, columns = (np.zeros(length, np.uint8) for length in mattes[0].shape[1:])
    for matte in mattes:
        _mark(array(matte), rows, columns)
    return _ends(rows), _ends(columns)


def _ends(marks: np.ndarray) -> tuple[int, int]:
    """The first and the last place that is marked, zeros where none is."""
    places = marks.nonzero()[0]
    return (int(places[0]), int(places[-1])) if len(places) else (0, 0)


@kernel
def _collect(
    slopes: np.ndarray, radii: np.ndarray, half: float, longest: float, gradient: np.ndarray, seen: np.ndarray,
    radius: np.ndarray,
) -> None:  # fmt: skip
    factor, side = np.float32(half), np.float32(longest)
    for n in range(len(radii)):
        drawn = radii[n] > 0
        x, y = slopes[n, 0], slopes[n, 1]
        gradient[n] += math.sqrt(x * x + y * y) * factor if drawn else np.float32(0)
        seen[n] += np.float32(drawn)
        radius[n] = max(radius[n], radii[n] / side)


def collect(
    slopes: Tensor, radii: Tensor, half: float, longest: float, gradient: Tensor, seen: Tensor, radius: Tensor
) -> None:
    """Add a view to the last three in place; float32, CPU.

    Args:
        slopes: of the centres in the image, [n, 2].
        radii: zero where a Gaussian is not drawn, [n].
        half: what the slopes' norms are multiplied by.
        longest: what the radii are divided by.
        gradient: sum of norms where drawn, [n].
        seen: number of views, [n].
        radius: the largest, [n].
    """
    _collect(array(slopes), array(radii), half, longest, gradient.numpy(), seen.numpy(), radius.numpy())
