"""The closest point of a triangle mesh to each of many points, in single precision.

trimesh takes ten times as long, and embreex has no point queries.
"""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from rewild4d.kernels.compiling import inlined, kernel

BLOCK = 16
"""Neighbouring triangles that are skipped together where their bounding sphere is too far away."""


class Closest(NamedTuple):
    """Closest points of a mesh.

    Attributes:
        faces: index of the triangle, the lowest of those equally close, -1 where none is within the limit, int64, [n].
        uv: barycentric coordinates that belong to its second and third corner, float32, [n, 2].
        distances: Euclidean, the limit where no triangle is within it, float32, [n].
    """

    faces: NDArray[np.int64]
    uv: NDArray[np.float32]
    distances: NDArray[np.float32]


def closest_points(triangles: NDArray[np.float64], points: NDArray[np.float64], limit: float = np.inf) -> Closest:
    """Find the closest point of a mesh for each point.

    Args:
        triangles: corners of at least one triangle, [f, 3, 3].
        points: fastest where neighbours in the list are neighbours in space, [n, 3].
        limit: distance below which triangles are looked for, in the points' unit.
    """
    order = cKDTree(triangles.mean(1)).indices  # neighbours in space become neighbours in the list
    order = np.pad(order, (0, -len(order) % BLOCK), mode="edge")
    corners = triangles[order].astype(np.float32)
    blocks = corners.reshape(-1, BLOCK * 3, 3)
    low, high = blocks.min(1), blocks.max(1)
    radii = np.linalg.norm(high - low, axis=1) * np.float32(0.5 + 1e-5)
    return Closest(*_search(corners, order, (low + high) / 2, radii, points.astype(np.float32), np.float32(limit)))


@kernel
def _search(
    corners: np.ndarray, face_of: np.ndarray, centres: np.ndarray, radii: np.ndarray, points: np.ndarray, limit: float
) -> tuple:
    """Find `Closest` of each point; ``face_of`` holds the number of the triangle in each row of the corners."""
    faces, distances = np.full(len(points), -1, np.int64), np.full(len(points), limit, np.float32)
    uv = np.zeros((len(points), 2), np.float32)
    first = 0  # the block of the point before: it is near, so that most others are skipped
    for i in range(len(points)):
        point, nearest = (points[i, 0], points[i, 1], points[i, 2]), limit
        for turn in range(-1, len(centres)):
            block = first if turn < 0 else turn
            gap = _minus(point, (centres[block, 0], centres[block, 1], centres[block, 2]))
            most = nearest + radii[block]
            if _dot(gap, gap) > most * most:
                continue
            for row in range(block * BLOCK, (block + 1) * BLOCK):
                u, v, distance = _closest(corners, row, point)
                if distance < nearest or (distance == nearest and face_of[row] < faces[i]):
                    faces[i], uv[i, 0], uv[i, 1], nearest = face_of[row], u, v, distance
                    first = block
        distances[i] = nearest
    return faces, uv, distances


@inlined
def _closest(corners: np.ndarray, row: int, point: tuple) -> tuple:
    """Barycentric coordinates and distance of a triangle's closest point (Ericson, Real-Time Collision Detection)."""
    a = corners[row, 0, 0], corners[row, 0, 1], corners[row, 0, 2]
    b = corners[row, 1, 0], corners[row, 1, 1], corners[row, 1, 2]
    c = corners[row, 2, 0], corners[row, 2, 1], corners[row, 2, 2]
    ab, ac, ap, bp, cp = _minus(b, a), _minus(c, a), _minus(point, a), _minus(point, b), _minus(point, c)
    d1, d2, d3, d4, d5, d6 = _dot(ab, ap), _dot(ac, ap), _dot(ab, bp), _dot(ac, bp), _dot(ab, cp), _dot(ac, cp)
    va, vb, vc = d3 * d6 - d5 * d4, d5 * d2 - d1 * d6, d1 * d4 - d3 * d2
    u, v, closest = np.float32(0), np.float32(0), a
    if d1 <= 0 and d2 <= 0:
        pass
    elif d3 >= 0 and d4 <= d3:
        u, closest = np.float32(1), b
    elif d6 >= 0 and d5 <= d6:
        v, closest = np.float32(1), c
    elif vc <= 0 and d1 >= 0 and d3 <= 0:
        u = d1 / (d1 - d3)
        closest = _along(a, u, ab)
    elif vb <= 0 and d2 >= 0 and d6 <= 0:
        v = d2 / (d2 - d6)
        closest = _along(a, v, ac)
    elif va <= 0 and d4 >= d3 and d5 >= d6:
        v = (d4 - d3) / ((d4 - d3) + (d5 - d6))
        u, closest = np.float32(1) - v, _along(b, v, _minus(c, b))
    else:
        share = np.float32(1) / (va + vb + vc)
        u, v = vb * share, vc * share
        closest = _along(_along(a, u, ab), v, ac)
    return u, v, _length(_minus(point, closest))


@inlined
def _minus(a: tuple, b: tuple) -> tuple:
    return a[0] - b[0], a[1] - b[1], a[2] - b[2]


@inlined
def _along(a: tuple, share: float, way: tuple) -> tuple:
    return a[0] + share * way[0], a[1] + share * way[1], a[2] + share * way[2]


@inlined
def _dot(a: tuple, b: tuple) -> float:
    return a[0] * b[0] + a[2] * b[2] + a[1] * b[1]  # summed as Open3D sums, which made the data of version 1


@inlined
def _length(a: tuple) -> float:
    return math.sqrt(a[0] * a[0] + a[1] * a[1] + a[2] * a[2])
