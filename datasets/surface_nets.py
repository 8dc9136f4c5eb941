"""Extract a triangle mesh from a field on a grid: surface nets, and normals at the vertices."""

import numpy as np


def surface_nets(field: np.ndarray, origin: np.ndarray, cell: float) -> tuple[np.ndarray, np.ndarray]:
    """Polygonise the zero level of a field [a, b, c] (negative inside): vertices [n, 3] and triangles [f, 3]."""
    inside = field < 0
    cells = np.array(field.shape) - 1
    total, count = np.zeros((*cells, 3)), np.zeros(cells)
    corners = [np.array(((i >> 2) & 1, (i >> 1) & 1, i & 1)) for i in range(8)]
    pairs = [(a, b) for a in corners for b in corners if (b - a).sum() == 1 and (b - a).min() == 0]

    def corner(array: np.ndarray, at: np.ndarray) -> np.ndarray:
        return array[tuple(slice(at[k], at[k] + cells[k]) for k in range(3))]

    for a, b in pairs:
        first, second = corner(field, a), corner(field, b)
        crossed = corner(inside, a) != corner(inside, b)
        fraction = np.where(crossed, first / np.where(crossed, first - second, 1.0), 0.0)
        total += crossed[..., None] * (a + fraction[..., None] * (b - a))
        count += crossed
    used = count > 0
    index = np.full(cells, -1)
    index[used] = np.arange(used.sum())
    vertices = origin + cell * (np.argwhere(used) + total[used] / count[used][:, None])
    return vertices, np.concatenate([_quads(inside, index, axis) for axis in range(3)])


def _quads(inside: np.ndarray, index: np.ndarray, axis: int) -> np.ndarray:
    """Return two triangles around each crossed grid edge along one axis, [f, 3]."""
    step, u, v = np.eye(3, dtype=int)[[axis, (axis + 1) % 3, (axis + 2) % 3]]
    ahead = np.moveaxis(np.diff(np.moveaxis(inside.astype(np.int8), axis, 0), axis=0), 0, axis)
    edges = np.argwhere(ahead != 0)
    leaving = ahead[tuple(edges.T)] < 0
    ring = np.stack([index[tuple((edges - a * u - b * v).T)] for a, b in ((1, 1), (0, 1), (0, 0), (1, 0))], axis=1)
    ring = np.where(leaving[:, None], ring, ring[:, ::-1])
    return np.concatenate((ring[:, [0, 1, 2]], ring[:, [0, 2, 3]]))


def normals(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Return the unit outward normals at the vertices (area-weighted), [n, 3]."""
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    summed = np.zeros_like(vertices)
    for k in range(3):
        np.add.at(summed, faces[:, k], np.cross(b - a, c - a))
    return summed / np.maximum(np.linalg.norm(summed, axis=1, keepdims=True), 1e-12)
