"""Cover a skinned mesh with flat squares, and fill it with round Gaussians: what silhouettes are drawn from."""

import numpy as np
import torch
from scipy.spatial import cKDTree
from torch import Tensor

from rewild4d.priors.motion import quats_from_normals, sample_mesh
from rewild4d.transforms import quat_to_matrix

SQUARES, BLOBS = 1400, 700
"""Squares and round Gaussians."""
INNER, DRAWN = 2500, 40000
"""Points of the surface that Gaussians, and that these points, are chosen from."""
OVERLAP = 1.15
"""Side of a square over that of its share of the area."""
BALL = 0.3
"""Standard deviation of a Gaussian over the radius of the largest ball inside the surface there, as in `Tube.blobs`."""
WALL = 0.3
"""Cosine between normals below which a wall is another than the point's own."""
INSET = 2.1
"""Depth of its centre below the surface, in standard deviations."""


def spread_points(
    vertices: Tensor, faces: Tensor, weights: Tensor, count: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray, float]:
    """Return about ``count`` evenly spread points of a surface.

    Args:
        vertices: [n, 3].
        faces: [f, 3].
        weights: skinning weights, [n, J].
        count: of points.

    Returns:
        Points [m, 3], unit normals [m, 3], weights [m, J], and the area of the surface.
    """
    drawn = sample_mesh(vertices, faces, weights, DRAWN, torch.Generator().manual_seed(0))
    kept = _one_per_cell(drawn.points.numpy(), count)
    points, normals, blended = (value[kept].numpy() for value in (drawn.points, drawn.normals, drawn.weights))
    return points, normals, blended, DRAWN * np.pi * drawn.radius**2


def _one_per_cell(points: np.ndarray, count: int) -> np.ndarray:
    """Return the points nearest to the middle of their cells, of cells so large that about ``count`` are filled."""
    points = points - points.min(axis=0)
    low, high = 1e-4 * points.max(), points.max()
    for _ in range(20):
        cell = float(np.sqrt(low * high))
        filled = len(np.unique(_numbers(points / cell)))
        low, high = (cell, high) if filled > count else (low, cell)
    away = np.linalg.norm(points / high - np.floor(points / high) - 0.5, axis=1)
    order = np.argsort(away, kind="stable")
    return order[np.unique(_numbers(points / high)[order], return_index=True)[1]]


def _numbers(cells: np.ndarray) -> np.ndarray:
    """Return a number for the cell of each point, of points at least 0 in sides of a cell, [n]."""
    x, y, z = np.floor(cells).astype(np.int64).T
    return (x * 100_000 + y) * 100_000 + z


def squares(points: np.ndarray, normals: np.ndarray, area: float) -> np.ndarray:
    """Return corners of squares on a surface's points whose areas are its share, in order, [m, 4, 3]."""
    half = 0.5 * OVERLAP * np.sqrt(area / len(points))
    axes = quat_to_matrix(quats_from_normals(torch.from_numpy(normals))).numpy()
    across, upward = half * axes[:, :, 0], half * axes[:, :, 1]
    return points[:, None] + np.stack(
        (-across - upward, across - upward, across + upward, -across + upward), axis=1
    )  # fmt: skip


def balls(points: np.ndarray, normals: np.ndarray) -> np.ndarray:
    """Return radii of the largest balls that touch the surface at its points from inside, [m].

    Only walls that face the other way count, since creases would leave no room for any.
    """
    size = float(np.linalg.norm(np.ptp(points, axis=0)))
    radii = np.full(len(points), 0.5 * size)
    for rows in np.array_split(np.arange(len(points)), len(points) // 200 + 1):
        away = points[rows, None] - points
        facing = np.einsum("na,nma->nm", normals[rows], away)
        walls = (facing > 1e-9) & (normals[rows] @ normals.T < WALL)
        touching = np.where(walls, (away * away).sum(-1) / np.maximum(2 * facing, 1e-9), np.inf)
        radii[rows] = np.minimum(radii[rows], touching.min(axis=1))
    return np.maximum(radii, 0.004 * size)


def filled(points: np.ndarray, normals: np.ndarray, count: int) -> tuple[Tensor, Tensor, np.ndarray]:
    """Fill a surface with about ``count`` round Gaussians, closer together where it is thin.

    Returns:
        Centres [m, 3], standard deviations [m] and the points that they lie below, [m].
    """
    sizes = BALL * balls(points, normals)
    tree, (low, high) = cKDTree(points), (0.1, 20.0)
    for _ in range(12):
        apart = float(np.sqrt(low * high))
        kept = _apart(tree, apart * sizes)
        low, high = (apart, high) if len(kept) > count else (low, apart)
    centers = points[kept] - INSET * sizes[kept, None] * normals[kept]
    return torch.from_numpy(centers).float(), torch.from_numpy(sizes[kept]).float(), kept


def _apart(tree: cKDTree, distances: np.ndarray) -> np.ndarray:
    """Return points of which none is nearer to an earlier one than that one's distance, [m]."""
    free, kept = np.ones(len(distances), bool), []
    for row in np.random.default_rng(0).permutation(len(distances)):
        if free[row]:
            kept.append(row)
            free[tree.query_ball_point(tree.data[row], distances[row])] = False
    return np.array(kept)
