"""Random coats of the zoo: a palette, a pattern, darker or lighter ends, symmetric or not."""

from collections.abc import Callable

import numpy as np

from rewild4d.datasets.builtin.coats import Coat, mix, noise, patches, rgb

PALETTES = {
    "earth": ("8a5a32", "5a3820", "e6d3b0"),
    "sand": ("c9a26a", "8f6a3c", "f3e6cc"),
    "grey": ("8b8a88", "55565a", "cfcfcb"),
    "black": ("2e2b2c", "1a191b", "d9d4cc"),
    "white": ("e8e4da", "bfb8ab", "4a3f38"),
    "orange": ("c8752e", "7c3f18", "f6ead4"),
    "pink": ("d9a294", "b57f74", "5b4a48"),
    "green": ("6b7548", "3f4a2c", "c8c494"),
    "blue": ("3f5f86", "20324e", "d8dfe2"),
    "red": ("a03a2a", "5d1f18", "e8c9a0"),
}
"""Base, dark and light colour of a coat, sRGB."""

Pattern = Callable[[np.ndarray, np.ndarray, float, int], np.ndarray]
"""Rest vertices and normals [n, 3], the size of a mark in metres and a seed -> how much of the second colour, [n]."""


def _plain(points: np.ndarray, normals: np.ndarray, size: float, seed: int) -> np.ndarray:
    return np.zeros(len(points))


def _belly(points: np.ndarray, normals: np.ndarray, size: float, seed: int) -> np.ndarray:
    return (-normals[:, 1] - 0.25 + 0.3 * noise(points, size, seed)) * 3


def _blotches(points: np.ndarray, normals: np.ndarray, size: float, seed: int) -> np.ndarray:
    return (noise(points, 1.7 * size, seed) + 0.35 * noise(points, 0.6 * size, seed + 1) - 0.15) * 20


def _spots(points: np.ndarray, normals: np.ndarray, size: float, seed: int) -> np.ndarray:
    return (patches(points, 0.6 * size, seed) - 0.42) * 12


def _nets(points: np.ndarray, normals: np.ndarray, size: float, seed: int) -> np.ndarray:
    return 1 - np.clip((patches(points, 1.1 * size, seed) - 0.14) * 14, 0, 1)


def _stripes(points: np.ndarray, normals: np.ndarray, size: float, seed: int) -> np.ndarray:
    warp = 0.5 * noise(points, 0.8 * size, seed) + 0.25 * noise(points, 0.35 * size, seed + 1)
    return (np.sin(2 * np.pi * (points[:, 2] / (0.55 * size) + 0.25 * points[:, 1] / size + warp)) - 0.25) * 6


def _saddle(points: np.ndarray, normals: np.ndarray, size: float, seed: int) -> np.ndarray:
    return (normals[:, 1] - 0.1 + 0.4 * noise(points, size, seed)) * 5


PATTERNS: dict[str, Pattern] = {
    "plain": _plain,
    "belly": _belly,
    "blotches": _blotches,
    "spots": _spots,
    "net": _nets,
    "stripes": _stripes,
    "saddle": _saddle,
}
"""Patterns by name."""


def draw(
    rng: np.random.Generator, palettes: tuple[str, ...], patterns: tuple[str, ...], size: float
) -> tuple[Coat, str]:
    """Draw a coat.

    Args:
        rng: source of every choice.
        palettes: names in `PALETTES` to choose from.
        patterns: names in `PATTERNS` to choose from.
        size: size of a mark in metres.

    Returns:
        The coat, and its description, such as "orange, stripes, symmetric".
    """
    palette, pattern = str(rng.choice(palettes)), str(rng.choice(patterns))
    base, dark, light = (rgb(text) * float(np.exp(rng.normal(0, 0.08))) for text in PALETTES[palette])
    marks = dark if rng.random() < 0.5 or pattern == "stripes" else light
    if pattern == "belly":
        marks = light
    symmetric, ends = bool(rng.random() < 0.5), rng.random()
    size, seed = size * float(np.exp(rng.normal(0, 0.15))), int(rng.integers(1000, 100_000))

    def coat(points: np.ndarray, normals: np.ndarray) -> np.ndarray:
        x, y, _ = points.T
        at = points * (1.0, 1.0, 1.0)
        if symmetric:
            at[:, 0] = np.abs(x)
        found = mix(base, 0.5 * (base + dark), 0.5 + 0.7 * noise(at, 0.5 * size, seed + 7))
        found = mix(found, marks, PATTERNS[pattern](at, normals, size, seed))
        if ends < 0.4:
            leg = (0.28 * y.max() * 0.6 + 0.1 * size * noise(at, size, seed + 9) - y) / (0.1 * size)
            found = mix(found, dark if ends < 0.25 else light, leg)
        return found

    return coat, f"{palette}, {pattern}, {'symmetric' if symmetric else 'asymmetric'}"
