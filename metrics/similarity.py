"""Compute the similarity (7 degrees of freedom) between matched points in closed form. A reflection is never one."""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from rewild4d.metrics.clouds import Points, as_points, is_straight


class Undetermined(ValueError):
    """The points do not determine a similarity."""


@dataclass(frozen=True)
class Similarity:
    """The map x -> scale * rotation @ x + translation.

    Attributes:
        scale: above zero.
        rotation: proper (determinant +1), float64, [3, 3].
        translation: float64, [3].
    """

    scale: float
    rotation: Tensor
    translation: Tensor

    @property
    def matrix(self) -> Tensor:
        """The same map on homogeneous column vectors, float64, [4, 4]."""
        matrix = torch.eye(4, dtype=torch.float64)
        matrix[:3, :3] = self.scale * self.rotation
        matrix[:3, 3] = self.translation
        return matrix

    def apply(self, points: Tensor) -> Tensor:
        """Map points in their own precision and on their device, [..., 3] -> [..., 3]."""
        moved = self.scale * points.double() @ self.rotation.to(points.device).T
        return (moved + self.translation.to(points.device)).to(points.dtype)


def umeyama(source: Tensor, target: Tensor, weights: Tensor | None = None) -> Similarity:
    """Compute the similarity with the least (weighted) squared distance of matched points (Umeyama 1991, eqs. 40-43).

    Args:
        source: finite, [n, 3].
        target: row i belongs to row i of the source, finite, [n, 3].
        weights: not negative, not all zero, [n]; equal where None.

    Raises:
        Undetermined: fewer than three points, or all at one position or on one line. Points in one plane are enough.
        ValueError: shapes that do not fit, or a NaN.

    Examples:
        >>> source = torch.tensor([[0.0, 0, 0], [1, 0, 0], [0, 1, 0]])
        >>> found = umeyama(source, 2 * source + torch.tensor([0.0, 0, 3]))
        >>> round(found.scale, 4), [round(x, 4) + 0.0 for x in found.translation.tolist()]
        (2.0, [0.0, 0.0, 3.0])
    """
    x, y = as_points(source, "source"), as_points(target, "target")
    if x.shape != y.shape:
        raise ValueError(f"expected as many target as source points, got {tuple(y.shape)} and {tuple(x.shape)}")
    share = np.ones(len(x)) if weights is None else weights.detach().cpu().double().numpy()
    if share.shape != (len(x),) or not (share >= 0).all() or not (0 < share.sum() < np.inf):
        raise ValueError(f"expected {len(x)} weights of at least zero and one above it, got shape {share.shape}")
    counted = share > 0
    for points, name in ((x, "source"), (y, "target")):
        if is_straight(points[counted]):
            raise Undetermined(f"the {name}'s points lie on one line, so no rotation is unique")
    found, spread = fit_matched(x, y, share / share.sum(), (0.0, np.inf))
    if spread[1] <= 1e-10 * spread[0]:
        raise Undetermined("the matched points vary together along one line only, so no rotation is unique")
    return found.similarity()


class Map(NamedTuple):
    """A similarity in NumPy: scale, rotation [3, 3], translation [3]."""

    scale: float
    rotation: Points
    translation: Points

    def __call__(self, points: Points) -> Points:
        return self.scale * points @ self.rotation.T + self.translation

    def similarity(self) -> Similarity:
        return Similarity(self.scale, torch.from_numpy(self.rotation), torch.from_numpy(self.translation))

    def inverse(self, points: Points) -> Points:
        return (points - self.translation) @ self.rotation / self.scale


def fit_matched(x: Points, y: Points, share: Points, bounds: tuple[float, float]) -> tuple[Map, Points]:
    """Compute Umeyama's closed form with the scale kept within bounds, and the covariance's singular values, [3].

    The best rotation does not depend on the scale, and the squared distance is a parabola in it: clamping is exact.

    Args:
        x: [n, 3].
        y: [n, 3].
        share: weights that sum to one, [n].
        bounds: lowest and highest scale.
    """
    centre_x, centre_y = share @ x, share @ y
    centred_x, centred_y = x - centre_x, y - centre_y
    u, spread, vt = np.linalg.svd((centred_y * share[:, None]).T @ centred_x)
    signs = np.array((1.0, 1.0, np.sign(np.linalg.det(u) * np.linalg.det(vt))))
    rotation = (u * signs) @ vt
    variance = max(share @ (centred_x**2).sum(axis=1), np.finfo(float).tiny)
    scale = float(np.clip(spread @ signs / variance, *bounds))
    return Map(scale, rotation, centre_y - scale * rotation @ centre_x), spread


def scale_matched(x: Points, y: Points, share: Points, bounds: tuple[float, float]) -> float:
    """Compute the scale about the origin with the least squared distance of matched points, kept within bounds.

    Args:
        x: [n, 3].
        y: [n, 3].
        share: weights, [n].
        bounds: lowest and highest scale.
    """
    length = max(share @ (x**2).sum(axis=1), np.finfo(float).tiny)
    return float(np.clip(share @ (x * y).sum(axis=1) / length, *bounds))
