"""From flesh to a skinned surface: a signed distance field with smooth seams, surface nets, skinning weights.

Surface nets: Gibson, "Constrained elastic surface nets" (MICCAI 1998), without the elastic part: one vertex in each
cell that the surface crosses, one quad around each grid edge that it crosses.
"""

from collections.abc import Sequence

import numpy as np
import scipy.sparse

from rewild4d.datasets.anatomy import Flesh

SEAM = 0.2
"""How far skinning weights reach over a joint, in units of the local radius."""


def distance(points: np.ndarray, flesh: Flesh) -> np.ndarray:
    """Signed distance (squashed capsules: a lower bound) of points [..., 3] in metres, [...]."""
    start, axis = flesh.start, (flesh.end - flesh.start) / flesh.squash
    local = (points - start) / flesh.squash
    along = np.clip(local @ axis / max(axis @ axis, 1e-12), 0.0, 1.0)
    radius = flesh.radii[0] + (flesh.radii[1] - flesh.radii[0]) * along
    return (np.linalg.norm(local - along[..., None] * axis, axis=-1) - radius) * flesh.squash.min()


def polygonise(parts: Sequence[Flesh], cell: float) -> tuple[np.ndarray, np.ndarray]:
    """The smooth union of all parts above the ground y = 0, as a closed surface.

    Args:
        parts: flesh in the body frame.
        cell: grid spacing in metres.

    Returns:
        Vertices float64 [n, 3] and outward-facing triangles int64 [f, 3].
    """
    ends = np.stack([end for part in parts for end in (part.start, part.end)])
    reach = max(max(part.radii) for part in parts) + 3 * cell
    low = np.floor((ends.min(0) - reach) / cell)
    shape = (np.ceil((ends.max(0) + reach) / cell) - low).astype(int) + 1
    axes = [(low[k] + np.arange(shape[k])) * cell for k in range(3)]
    field = np.full(shape, 1e3)
    for part in parts:
        _blend_in(field, axes, part, cell)
    field = np.maximum(field, -axes[1][None, :, None])
    return surface_nets(field, low * cell, cell)


def _blend_in(field: np.ndarray, axes: list[np.ndarray], part: Flesh, cell: float) -> None:
    """Smooth union of one part into the field, in the box where it can matter."""
    both = np.stack((part.start, part.end))
    margin = max(part.radii) * part.squash + part.blend / part.squash.min() * part.squash + 3 * cell
    window = tuple(
        slice(*np.searchsorted(axes[k], (both[:, k].min() - margin[k], both[:, k].max() + margin[k]))) for k in range(3)
    )
    grid = np.stack(np.meshgrid(*(axes[k][window[k]] for k in range(3)), indexing="ij"), axis=-1)
    here, there = distance(grid, part), field[window]
    overlap = np.maximum(part.blend - np.abs(here - there), 0.0) / part.blend
    field[window] = np.minimum(here, there) - overlap**2 * part.blend / 4


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
    """Two triangles around each crossed grid edge along one axis, [f, 3]."""
    step, u, v = np.eye(3, dtype=int)[[axis, (axis + 1) % 3, (axis + 2) % 3]]
    ahead = np.moveaxis(np.diff(np.moveaxis(inside.astype(np.int8), axis, 0), axis=0), 0, axis)
    edges = np.argwhere(ahead != 0)
    leaving = ahead[tuple(edges.T)] < 0
    ring = np.stack([index[tuple((edges - a * u - b * v).T)] for a, b in ((1, 1), (0, 1), (0, 0), (1, 0))], axis=1)
    ring = np.where(leaving[:, None], ring, ring[:, ::-1])
    return np.concatenate((ring[:, [0, 1, 2]], ring[:, [0, 2, 3]]))


def normals(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Unit outward normals at the vertices (area-weighted), [n, 3]."""
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    summed = np.zeros_like(vertices)
    for k in range(3):
        np.add.at(summed, faces[:, k], np.cross(b - a, c - a))
    return summed / np.maximum(np.linalg.norm(summed, axis=1, keepdims=True), 1e-12)


def nearest_part(vertices: np.ndarray, parts: Sequence[Flesh]) -> np.ndarray:
    """Which part each vertex [n, 3] lies on, int64, [n]."""
    return np.stack([distance(vertices, part) for part in parts]).argmin(axis=0)


def skinning(
    vertices: np.ndarray, faces: np.ndarray, parts: Sequence[Flesh], bones: int
) -> tuple[np.ndarray, np.ndarray]:
    """Smooth skinning weights: a soft minimum over each bone's flesh, diffused along the surface.

    Distance to flesh, not to a bone's axis, keeps thick and thin parts alike and the left leg off the right one.

    Returns:
        Bone indices int64 [n, 4] and weights float64 [n, 4] whose rows sum to one.
    """
    gaps = np.full((len(vertices), bones), np.inf)
    for part in parts:
        gaps[:, part.bone] = np.minimum(gaps[:, part.bone], distance(vertices, part))
    radius = np.array([np.mean(part.radii) for part in parts])[nearest_part(vertices, parts)]
    weights = np.exp(-(gaps - gaps.min(axis=1, keepdims=True)) / (SEAM * radius[:, None]))
    spread = _averaging(faces, len(vertices))
    for _ in range(6):
        weights = spread @ weights
    indices = np.argsort(-weights, axis=1, kind="stable")[:, :4]
    kept = np.take_along_axis(weights, indices, axis=1)
    return indices, kept / kept.sum(axis=1, keepdims=True)


def _averaging(faces: np.ndarray, count: int) -> scipy.sparse.csr_matrix:
    """Row-stochastic matrix: half a vertex, half the mean of its neighbours."""
    edges = np.concatenate((faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]))
    both = np.concatenate((edges, edges[:, ::-1]))
    adjacency = scipy.sparse.csr_matrix((np.ones(len(both)), both.T), shape=(count, count)).minimum(1.0)
    degree = scipy.sparse.diags(0.5 / np.asarray(adjacency.sum(axis=1)).ravel())
    return (scipy.sparse.identity(count) * 0.5 + degree @ adjacency).tocsr()
