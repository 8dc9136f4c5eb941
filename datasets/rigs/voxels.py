"""The canonical volume of an Artemis folder: a lattice inside the rest mesh, with skinning weights."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import binary_fill_holes

from rewild4d.datasets.rigs.animal import Surface
from rewild4d.datasets.rigs.closest_points import closest_points

CELLS = 96
"""Lattice cells along the longest axis: fine enough for ears and tails, a few hundred thousand cells at most."""

INFLUENCES = 10
"""Bones per voxel at most, as in the original data (FORMATS, 1.6)."""

CHUNK = 1 << 24
"""Weights of voxels that are held at a time, a dense row of all bones each."""


@dataclass(frozen=True)
class Volume:
    """Rest-pose voxels.

    Attributes:
        voxels: centres in world units, on a lattice, float64, [V, 3].
        indices: the bones that move each voxel, by falling weight, int64, [V, K].
        weights: their weights, each row sums to one, float64, [V, K].
        radius: half extent of the 256-cell octree box whose cells are the lattice's, [3].
    """

    voxels: NDArray[np.float64]
    indices: NDArray[np.int64]
    weights: NDArray[np.float64]
    radius: NDArray[np.float64]


def voxelise(surfaces: Sequence[Surface], cells: int = CELLS) -> Volume:
    """Return voxels inside the rest surfaces or within half a cell of them, weighted like the nearest surface point.

    Inside means: not connected to the outside of the lattice. So open seams between materials and overlapping parts do
    no harm; a hole wider than a cell empties the body and leaves its shell.
    """
    points = np.concatenate([surface.vertices for surface in surfaces])
    low, high = points.min(0), points.max(0)
    pitch = float((high - low).max()) / cells
    counts = np.ceil((high - low) / pitch).astype(int) + 3
    centre = (low + high) / 2
    axes = [(np.arange(n) - (n - 1) / 2) * pitch for n in counts]
    lattice = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)
    triangles = np.concatenate([(surface.vertices - centre)[surface.faces] for surface in surfaces])
    near = closest_points(triangles, lattice.reshape(-1, 3), 0.5 * pitch * (1 + 1e-3)).faces >= 0
    local = lattice[binary_fill_holes(near.reshape(counts))]
    indices, weights = _nearest_weights(triangles, surfaces, local)
    return Volume(local + centre, indices, weights, np.full(3, 128 * pitch))


def _nearest_weights(
    triangles: NDArray[np.float64], surfaces: Sequence[Surface], points: NDArray[np.float64]
) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Return the top weights of the nearest surface point of each point, [V, K] and [V, K]."""
    bones = 1 + max(int(surface.bone_indices.max()) for surface in surfaces)
    keep = min(INFLUENCES, bones)
    faces, uv, _ = closest_points(triangles, points)
    ends = np.cumsum([len(surface.faces) for surface in surfaces])
    indices, weights = np.empty((len(points), keep), np.int64), np.empty((len(points), keep))
    step = max(1, CHUNK // bones)
    for start in range(0, len(points), step):
        rows = slice(start, start + step)
        dense = np.zeros((len(points[rows]), bones))
        owner = np.searchsorted(ends, faces[rows], side="right")
        for number, surface in enumerate(surfaces):
            hit = np.flatnonzero(owner == number)
            corners = surface.faces[faces[rows][hit] - ends[number] + len(surface.faces)]
            share = barycentric(uv[rows][hit])
            for corner in range(3):
                vertex = corners[:, corner]
                amount = share[:, corner, None] * surface.bone_weights[vertex]
                np.add.at(dense, (hit[:, None], surface.bone_indices[vertex]), amount)
        best = np.argsort(-dense, axis=1, kind="stable")[:, :keep]
        top = np.take_along_axis(dense, best, axis=1)
        indices[rows], weights[rows] = best, top / top.sum(1, keepdims=True)
    return indices, weights


def barycentric(uvs: NDArray[np.float32]) -> NDArray[np.float64]:
    """Return weights of a triangle's three corners from Embree's two coordinates, [n, 2] -> [n, 3]."""
    pair = np.clip(uvs.astype(np.float64), 0.0, 1.0)
    return np.stack((np.clip(1.0 - pair.sum(1), 0.0, 1.0), pair[:, 0], pair[:, 1]), axis=1)
