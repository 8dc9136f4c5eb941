"""The true shape and skeleton of an Artemis animal: a mesh of its voxels, bones that move something, their poses."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from scipy.ndimage import gaussian_filter
from scipy.spatial import cKDTree

from rewild4d.datasets.artemis.files import read_parents
from rewild4d.datasets.artemis.volume import Voxels, read_voxels
from rewild4d.datasets.surface_nets import normals, surface_nets
from rewild4d.errors import UserError
from rewild4d.types import Rig

MESH_CELLS = 96
"""Cells of the mesh along the longest axis: finer lattices are joined in cubes."""
BLUR = 0.7
"""Blur of the occupied cells before they are polygonised, in cells: the steps between them go."""
LEVEL = 0.4
"""Of the blurred cells, at which the surface is taken: plates of one cell stay."""


def read_rig(animal: Path, poses: Sequence[np.ndarray]) -> Rig:
    """Return the rig of an animal at the given poses.

    Args:
        animal: its folder.
        poses: global bone-to-world matrices of each frame, [J, 4, 4] each.

    Raises:
        UserError: no volume, or a file of it that cannot be used.
    """
    voxels = read_voxels(animal)
    if voxels is None:
        raise UserError(f"{animal / 'volumes'}: expected the animal's voxels and their weights, got no such folder.")
    vertices, faces = skin(voxels)
    weights = np.zeros((len(vertices), len(voxels.bones_rest)))
    nearest = cKDTree(voxels.points).query(vertices)[1]
    rows = np.arange(len(vertices))[:, None]
    np.add.at(weights, (rows, voxels.indices[nearest]), voxels.weights[nearest])
    weights /= np.maximum(weights.sum(1, keepdims=True), 1e-12)
    kept = np.flatnonzero(weights.any(axis=0))
    bones_rest, bones = voxels.bones_rest[kept], np.stack(poses)[:, kept]
    parents = _parents_among(kept, read_parents(animal / "bones"))
    return Rig(*map(torch.from_numpy, (vertices, faces, weights[:, kept], bones_rest, bones, parents)))


def skin(voxels: Voxels) -> tuple[np.ndarray, np.ndarray]:
    """Return the surface through the outermost voxels' centres: vertices [n, 3] in the world and triangles [f, 3]."""
    step = -(-(int(voxels.cells.max()) + 1) // MESH_CELLS)
    cells = voxels.cells // step
    border = 2
    occupied = np.zeros(cells.max(axis=0) + 1 + 2 * border, np.float32)
    occupied[tuple((cells + border).T)] = 1
    places, faces = surface_nets(LEVEL - gaussian_filter(occupied, BLUR), np.full(3, -float(border)), 1.0)
    # Half a cell inwards: what is polygonised is the outside of the outermost cells.
    places = places - 0.5 * normals(places, faces)
    return voxels.points.min(axis=0) + voxels.pitch * (step * places + (step - 1) / 2), faces


def _parents_among(kept: np.ndarray, parents: np.ndarray) -> np.ndarray:
    """Return the nearest ancestor of each kept bone that is kept, as a row of ``kept``, -1 for none."""
    row = {int(bone): index for index, bone in enumerate(kept)}
    found = []
    for bone in kept:
        seen = {int(bone)}
        above = int(parents[bone])
        while 0 <= above < len(parents) and above not in seen and above not in row:
            seen.add(above)
            above = int(parents[above])
        found.append(-1 if above in seen else row.get(above, -1))
    return np.array(found, np.int64)
