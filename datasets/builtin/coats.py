"""Coats of the built-in animals: sRGB colours at the vertices of the rest surface.

Patterns are functions of position, seeded, and not the same on the left and on the right, as in nature.
"""

from collections.abc import Callable, Mapping

import numpy as np
from scipy.spatial import cKDTree

Coat = Callable[[np.ndarray, np.ndarray], np.ndarray]
"""Rest vertices [n, 3] in the body frame and outward normals [n, 3] -> sRGB colours in [0, 1] of the coat, [n, 3]."""


def noise(points: np.ndarray, size: float, seed: int) -> np.ndarray:
    """Smooth value noise in [-1, 1] with features of ``size`` metres, [n, 3] -> [n]."""
    lattice = np.random.default_rng(seed).uniform(-1.0, 1.0, (32, 32, 32))
    base = np.floor(points / size)
    part, cell = points / size - base, base.astype(int)
    part = part * part * (3 - 2 * part)
    value = np.zeros(len(points))
    for corner in np.ndindex(2, 2, 2):
        weight = np.where(corner, part, 1 - part).prod(axis=1)
        value += weight * lattice[tuple(((cell + corner) % 32).T)]
    return value


def patches(points: np.ndarray, size: float, seed: int) -> np.ndarray:
    """Gap between the two nearest of jittered seeds ``size`` metres apart, in sizes: 0 on patch borders, [n]."""
    low, high = points.min(axis=0) - size, points.max(axis=0) + size
    grid = np.stack(np.meshgrid(*(np.arange(a, b, size) for a, b in zip(low, high, strict=True))), -1).reshape(-1, 3)
    seeds = grid + np.random.default_rng(seed).uniform(-0.38, 0.38, grid.shape) * size
    near = cKDTree(seeds).query(points, k=2)[0]
    return (near[:, 1] - near[:, 0]) / size


def mix(first: np.ndarray, second: np.ndarray, amount: np.ndarray) -> np.ndarray:
    """Blend of two colours [3] or [n, 3] by amounts in [0, 1], [n] -> [n, 3]."""
    amount = np.clip(amount, 0.0, 1.0)[:, None]
    return first * (1 - amount) + second * amount


def rgb(text: str) -> np.ndarray:
    """Return the colour of six hexadecimal digits, [3]."""
    return np.array([int(text[i : i + 2], 16) for i in (0, 2, 4)]) / 255


def chestnut_pinto(points: np.ndarray, normals: np.ndarray) -> np.ndarray:
    """Return a horse: chestnut with white patches, white socks and a blaze."""
    x, y, z = points.T
    chestnut = mix(rgb("8a4a22"), rgb("6b3416"), 0.5 + 0.7 * noise(points, 0.22, 1))
    white = rgb("efe9dd")
    blotch = noise(points, 0.47, 2) + 0.35 * noise(points, 0.17, 6)
    body = mix(chestnut, white, (blotch - 0.25) * 25 * (z < 0.75))
    socks = 0.34 + 0.10 * np.sign(x) * np.sign(z) + 0.04 * noise(points, 0.1, 7)
    body = mix(body, white, (socks - y) * 40)
    blaze = (z > 1.2) & (np.abs(x) < 0.035 + 0.012 * noise(points, 0.08, 8)) & (normals[:, 1] > 0.1)
    body = mix(body, white, blaze.astype(float))
    return mix(body, rgb("4b3a35"), (z - 1.50) * 22)


def tiger(points: np.ndarray, normals: np.ndarray) -> np.ndarray:
    """Return a tiger: orange with a white belly and face, black stripes around the body, the legs and the tail."""
    x, y, z = points.T
    orange = mix(rgb("e08a28"), rgb("c96f1c"), 0.5 + 0.6 * noise(points, 0.2, 11))
    inner = -np.sign(x) * normals[:, 0] * (y < 0.62)
    pale = 1.6 * np.maximum(-normals[:, 1], inner * 0.5) - 0.55 + 0.25 * noise(points, 0.1, 12)
    cheek = (z > 1.0) * ((0.98 - y) * 12 + (np.abs(x) - 0.09) * 10)
    base = mix(orange, rgb("f4ead6"), np.maximum(pale, cheek) * 2)
    warp = 0.5 * noise(points, 0.16, 13) + 0.25 * noise(points, 0.07, 14)
    leg = np.clip((0.60 - y) * 7, 0, 1) * (z > -0.8)
    along = np.where(leg > 0.5, y / 0.085, (z + 0.25 * (y - 0.8)) / 0.115)
    stripe = np.sin(2 * np.pi * (along + warp)) - 0.30 - 0.35 * leg - 0.5 * np.clip(pale, 0, 1)
    stripe -= 3.0 * np.clip((0.22 - y) * 8, 0, 1)
    brow = np.sin(2 * np.pi * ((y + 0.6 * np.abs(x)) / 0.07 + 0.2 * warp)) - 0.35 - 2.0 * (np.abs(x) < 0.015)
    stripe = np.where(z > 0.93, np.where((z < 1.12) & (y > 0.97), brow, -1.0), stripe)
    return mix(base, rgb("1d1612"), stripe * 6)


def giraffe(points: np.ndarray, normals: np.ndarray) -> np.ndarray:
    """Return a giraffe: brown patches with cream borders, fading on the lower legs and the face."""
    x, y, z = points.T
    cream = mix(rgb("f0dcb0"), rgb("e2c48d"), 0.5 + 0.5 * noise(points, 0.3, 21))
    brown = mix(rgb("8a4f20"), rgb("a4652b"), 0.5 + 0.6 * noise(points, 0.25, 22))
    wobble = 0.05 * np.stack([noise(points, 0.15, 23 + k) for k in range(3)], axis=1)
    border = patches(points + wobble, 0.30, 29)
    patch = (border - 0.14) * 14
    fade = np.minimum((y - 0.75) * 3, np.minimum((2.05 - z) * 6, 1.0))
    coat = mix(cream, brown, np.minimum(np.clip(patch, 0, 1), fade) - 0.8 * np.clip(-normals[:, 1] - 0.6, 0, 1))
    return mix(coat, rgb("6d5240"), (z - 2.17) * 9)


def painted(
    coat: Coat, points: np.ndarray, normals: np.ndarray, labels: np.ndarray, paints: Mapping[str, str]
) -> np.ndarray:
    """Colours of a whole animal: the coat, and one plain colour (slightly uneven) where a label names it, [n, 3]."""
    colors = coat(points, normals)
    for label, plain in paints.items():
        chosen = labels == label
        colors[chosen] = rgb(plain) * (1 + 0.12 * noise(points[chosen], 0.05, 41))[:, None]
    return np.clip(colors, 0.0, 1.0)
