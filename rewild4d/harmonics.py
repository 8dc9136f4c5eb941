"""View-dependent colour: real spherical harmonics up to degree 3, in the order and sign of 3D Gaussian Splatting."""

import math
from functools import cache

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import normalize

from rewild4d.kernels import gpu
from rewild4d.kernels.harmonics import C0 as C0
from rewild4d.kernels.harmonics import C1, C2, C3, HARMONICS, shade, turn
from rewild4d.types import Splats


def basis(directions: Tensor, degree: int) -> Tensor:
    """Return values of the basis functions for unit directions, [..., 3] -> [..., (degree + 1)^2], degree 0 to 3."""
    powers = [torch.ones_like(directions[..., :1])]
    for _ in range(degree):
        powers.append(products(powers[-1], directions))
    tables = [_table(level, directions.device, directions.dtype) for level in range(degree + 1)]
    return torch.cat([power @ table for power, table in zip(powers, tables, strict=True)], dim=-1)


def _band(directions: Tensor, level: int) -> Tensor:
    """Return values of the functions of one degree, [..., 3] -> [..., 2 level + 1]."""
    power = torch.ones_like(directions[..., :1])
    for _ in range(level):
        power = products(power, directions)
    return power @ _table(level, directions.device, directions.dtype)


FUNCTIONS: tuple[tuple[dict[str, float], ...], ...] = (
    ({"": C0},),
    ({"y": -C1}, {"z": C1}, {"x": -C1}),
    (
        {"xy": C2[0]},
        {"yz": C2[1]},
        {"zz": 2 * C2[2], "xx": -C2[2], "yy": -C2[2]},
        {"xz": C2[3]},
        {"xx": C2[4], "yy": -C2[4]},
    ),
    (
        {"xxy": 3 * C3[0], "yyy": -C3[0]},
        {"xyz": C3[1]},
        {"yzz": 4 * C3[2], "xxy": -C3[2], "yyy": -C3[2]},
        {"zzz": 2 * C3[3], "xxz": -3 * C3[3], "yyz": -3 * C3[3]},
        {"xzz": 4 * C3[4], "xxx": -C3[4], "xyy": -C3[4]},
        {"xxz": C3[5], "yyz": -C3[5]},
        {"xxx": C3[6], "xyy": -3 * C3[6]},
    ),
)
"""The functions of each degree as polynomials in the coordinates of a unit direction."""


@cache
def _table(level: int, device: torch.device, dtype: torch.dtype) -> Tensor:
    """Coefficients of the products of ``level`` coordinates in each function of that degree, [3^level, 2 level + 1]."""
    table = torch.zeros(3**level, 2 * level + 1, dtype=torch.float64)
    for column, polynomial in enumerate(FUNCTIONS[level]):
        for letters, factor in polynomial.items():
            table[int("0" + letters.translate(str.maketrans("xyz", "012")), 3), column] = factor
    return table.to(device, dtype)


def rotated(coefficients: Tensor, rotations: Tensor) -> Tensor:
    """Rotate the coefficients of colours: rotated(c, R) seen along R d is c seen along d.

    The functions of one degree are closed under rotation, so matching them at enough directions is exact.

    Args:
        coefficients: k = 4, 9 or 16, [n, k, 3].
        rotations: of each Gaussian, [n, 3, 3].

    Returns:
        [n, k, 3].

    Raises:
        ValueError: other shapes.
    """
    count, k = coefficients.shape[:2]
    if k not in (4, 9, 16) or coefficients.shape[2:] != (3,) or rotations.shape != (count, 3, 3):
        found = f"{list(coefficients.shape)} and {list(rotations.shape)}"
        raise ValueError(f"expected coefficients [n, 4 or 9 or 16, 3] and rotations [n, 3, 3], got {found}")
    if _for_kernels(coefficients, rotations):
        return turn(coefficients, rotations, _tables())
    made = [coefficients[:, :1]]
    for level in range(1, math.isqrt(k)):
        directions, inverse = (table.to(rotations) for table in _matching(level))
        before = torch.einsum("da,nab->ndb", directions, rotations)
        turns = torch.einsum("dk,ndl->nkl", inverse, _band(before, level))
        made.append(turns @ coefficients[:, level**2 : (level + 1) ** 2])
    return torch.cat(made, dim=1)


def _for_kernels(*tensors: Tensor) -> bool:
    """Tell whether the kernels take them: they give no gradients."""
    wanted = torch.is_grad_enabled() and any(tensor.requires_grad for tensor in tensors)
    return not wanted and HARMONICS.takes(*tensors)


@cache
def _tables() -> tuple[np.ndarray, ...]:
    return tuple(table.float().numpy() for level in (1, 2, 3) for table in _matching(level))


def _matching(level: int) -> tuple[Tensor, Tensor]:
    """Directions [D, 3] and the transposed pseudoinverse of the values of a degree's functions there, float64."""
    directions = spiral(2 * (2 * level + 1))
    return directions, torch.linalg.pinv(_band(directions, level)).T.contiguous()


def spiral(count: int) -> Tensor:
    """Return the unit directions spread over the sphere, [count, 3]."""
    order = torch.arange(count, dtype=torch.float64)
    height, angle = 1 - (2 * order + 1) / count, order * (math.pi * (3 - 5**0.5))
    ring = (1 - height.square()).sqrt()
    return torch.stack((ring * angle.cos(), ring * angle.sin(), height), dim=-1)


def seen_colors(splats: Splats, eye: Tensor) -> Tensor:
    """Return RGB of each Gaussian from a camera centre.

    Args:
        splats: colours [n, k, 3]; k = 1 is RGB itself, k = 4, 9, 16 are coefficients, 0.5 standing for their zero.
        eye: camera centre in the frame of the Gaussians, [3].

    Returns:
        [n, 3], not below 0.

    Raises:
        ValueError: another k, or other shapes.
    """
    count = splats.colors.shape[1]
    if count == 1:
        return splats.colors[:, 0]
    if count not in (4, 9, 16):
        raise ValueError(f"expected 1, 4, 9 or 16 colour coefficients per Gaussian, got {count}")
    if splats.colors.shape != (len(splats), count, 3) or splats.means.shape[1:] != (3,):
        found = f"{list(splats.means.shape)} and {list(splats.colors.shape)}"
        raise ValueError(f"expected means [n, 3] and colours [n, k, 3] of as many Gaussians, got {found}")
    eye = eye.to(splats.means)
    if _for_kernels(splats.colors, splats.means):
        return shade(splats.colors, splats.means, eye)
    if gpu.on_gpu(splats.colors, splats.means) and not (splats.colors.requires_grad or splats.means.requires_grad):
        return gpu.splat_colors(splats.colors, splats.means, eye)
    directions = normalize(splats.means - eye, dim=-1)
    values = basis(directions, round(count**0.5) - 1)
    return (torch.einsum("nk,nkc->nc", values, splats.colors) + 0.5).clamp_min(0)


def base_colors(splats: Splats) -> Tensor:
    """Return RGB of each Gaussian without what depends on the view, in [0, 1], [n, 3]."""
    colors = splats.colors[:, 0]
    return (colors if splats.colors.shape[1] == 1 else 0.5 + C0 * colors).clamp(0, 1)


def products(a: Tensor, b: Tensor) -> Tensor:
    """Compute all a_i b_j, i the slower index, [..., n] and [..., m] -> [..., n m].

    The components are spread by matrices of zeros and ones: the gradient of a broadcast product would be a sum along
    short axes, which takes a CPU twice as long.
    """
    left, right = _spread(a.shape[-1], b.shape[-1], a.device, a.dtype)
    return (a @ left) * (b @ right)


@cache
def _spread(n: int, m: int, device: torch.device, dtype: torch.dtype) -> tuple[Tensor, Tensor]:
    left, right = torch.eye(n).repeat_interleave(m, dim=1), torch.eye(m).repeat(1, n)
    return left.to(device, dtype), right.to(device, dtype)
