"""From flesh to a skinned surface: a signed distance field with smooth seams, surface nets, skinning weights.

Surface nets: Gibson, "Constrained elastic surface nets" (MICCAI 1998), without the elastic part: one vertex in each
cell that the surface crosses, one quad around each grid edge that it crosses.
"""

from collections.abc import Sequence

import numpy as np
import scipy.sparse

from rewild4d.datasets.builtin.anatomy import Flesh
from rewild4d.datasets.surface_nets import surface_nets

SEAM = 0.2
"""How far skinning weights reach over a joint, in units of the local radius."""


def distance(points: np.ndarray, flesh: Flesh) -> np.ndarray:
    """Return the signed distance (squashed capsules: a lower bound) of points [..., 3] in metres, [...]."""
    start, axis = flesh.start, (flesh.end - flesh.start) / flesh.squash
    local = (points - start) / flesh.squash
    along = np.clip(local @ axis / max(axis @ axis, 1e-12), 0.0, 1.0)
    radius = flesh.radii[0] + (flesh.radii[1] - flesh.radii[0]) * along
    return (np.linalg.norm(local - along[..., None] * axis, axis=-1) - radius) * flesh.squash.min()


def polygonise(parts: Sequence[Flesh], cell: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the smooth union of all parts above the ground y = 0, as a closed surface.

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


def nearest_part(vertices: np.ndarray, parts: Sequence[Flesh]) -> np.ndarray:
    """Return which part each vertex [n, 3] lies on, int64, [n]."""
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
    """Return the row-stochastic matrix: half a vertex, half the mean of its neighbours."""
    edges = np.concatenate((faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]))
    both = np.concatenate((edges, edges[:, ::-1]))
    adjacency = scipy.sparse.csr_matrix((np.ones(len(both)), both.T), shape=(count, count)).minimum(1.0)
    degree = scipy.sparse.diags(0.5 / np.asarray(adjacency.sum(axis=1)).ravel())
    return (scipy.sparse.identity(count) * 0.5 + degree @ adjacency).tocsr()
