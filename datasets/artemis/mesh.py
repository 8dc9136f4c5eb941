"""The true surface of an animal that was rendered from a rig: the rig's own triangles, posed as the rig poses them.

Voxels of a coarse rig are no truth: a point inside a large triangle, skinned by blended weights, leaves the flat
triangle that was drawn. Where a rig made the folder, its mesh lies beside the voxels, and shapes are scored by it.
"""

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.ndimage import binary_dilation

from rewild4d.datasets.artemis.volume import Voxels
from rewild4d.datasets.triangles import draw
from rewild4d.errors import UserError
from rewild4d.files import load_tensors, save_tensors

FILE = "mesh.pth"
"""In an animal's folder: {"vertices", "faces", "indices", "weights"}; not part of the Artemis format."""
KINDS = (np.float64, np.int64, np.int64, np.float64)
BORDER = 2
"""Empty cells around the voxels: room for their neighbours."""


class Mesh(NamedTuple):
    """Triangles of the rest pose with skinning weights.

    Attributes:
        vertices: world units, float64, [n, 3].
        faces: int64, [f, 3].
        indices: bones that move each vertex, int64, [n, K].
        weights: their weights, each row sums to one, float64, [n, K].
    """

    vertices: NDArray[np.float64]
    faces: NDArray[np.int64]
    indices: NDArray[np.int64]
    weights: NDArray[np.float64]

    def posed(self, transforms: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the vertices by linear blend skinning with rest -> posed transforms [J, 4, 4], [n, 3]."""
        blended = np.einsum("nk,nkab->nab", self.weights, transforms[self.indices, :3])
        return np.einsum("nab,nb->na", blended[..., :3], self.vertices) + blended[..., 3]


@dataclass(frozen=True)
class TrueMesh:
    """The outside of a mesh.

    Attributes:
        mesh: all triangles.
        surface: voxels of the animal's surface: triangles deeper inside are no part of it.
    """

    mesh: Mesh
    surface: Voxels

    @property
    def diagonal(self) -> float:
        """Diagonal of the rest pose's bounding box, world units."""
        return float(np.linalg.norm(np.ptp(self.mesh.vertices, axis=0)))

    def thinned(self, count: int) -> "MeshPoints":
        """Return so many points, always the same ones."""
        return self.sampled(count, 0)

    def sampled(self, count: int, seed: int) -> "MeshPoints":
        """Return points uniform by the rest pose's area."""
        rng = np.random.default_rng((seed, count))
        vertices, faces = self.mesh.vertices, self.mesh.faces
        chosen, shares, missing = [], [], count
        while missing > 0:
            rows, parts = draw(vertices, faces, 2 * missing + 64, rng)
            kept = np.flatnonzero(self._is_outside(np.einsum("nk,nkd->nd", parts, vertices[faces[rows]])))[:missing]
            chosen.append(rows[kept])
            shares.append(parts[kept])
            missing -= len(kept)
        return MeshPoints(self, np.concatenate(chosen), np.concatenate(shares))

    def _is_outside(self, points: NDArray[np.float64]) -> NDArray[np.bool_]:
        """Return which points lie in a voxel of the surface or next to one; all where none does."""
        pitch = np.where(self.surface.pitch > 0, self.surface.pitch, 1.0)
        cells = np.rint((points - self.surface.points.min(axis=0)) / pitch).astype(np.int64) + BORDER
        found: NDArray[np.bool_] = self._shell[tuple(cells.clip(0, np.array(self._shell.shape) - 1).T)]
        return found if found.any() else np.ones(len(points), dtype=bool)

    @cached_property
    def _shell(self) -> NDArray[np.bool_]:
        """Cells of the surface and their neighbours, bool, [x, y, z]."""
        cells = self.surface.cells + BORDER
        shell = np.zeros(cells.max(axis=0) + BORDER + 1, dtype=bool)
        shell[tuple(cells.T)] = True
        return binary_dilation(shell, np.ones((3, 3, 3)))


@dataclass(frozen=True)
class MeshPoints:
    """Points on a mesh: the triangle of each, [n], and the weights of its corners, [n, 3]."""

    of: TrueMesh
    rows: NDArray[np.intp]
    shares: NDArray[np.float64]

    def posed(self, bones: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the points on the posed triangles, [n, 3].

        Args:
            bones: global bone-to-world matrices, [J, 4, 4].
        """
        vertices = self.of.mesh.posed(bones @ np.linalg.inv(self.of.surface.bones_rest))
        return np.einsum("nk,nkd->nd", self.shares, vertices[self.of.mesh.faces[self.rows]])


def write_mesh(folder: Path, mesh: Mesh) -> None:
    """Write a mesh into an animal's folder."""
    save_tensors({name: torch.from_numpy(array) for name, array in mesh._asdict().items()}, folder / FILE)


def read_mesh(animal: Path, surface: Voxels) -> TrueMesh | None:
    """Return the mesh of an animal's folder, or None where it has none.

    Args:
        animal: its folder.
        surface: surface voxels of the same folder.

    Raises:
        UserError: a damaged file, shapes that do not fit, indices out of range.
    """
    path = animal / FILE
    if not path.is_file():
        return None
    found = load_tensors(path, "mesh of a rig")
    if not isinstance(found, dict) or not all(isinstance(found.get(name), torch.Tensor) for name in Mesh._fields):
        raise UserError(f"{path}: expected the tensors {', '.join(Mesh._fields)}, got other content.")
    vertices, faces, indices, weights = (found[name].numpy() for name in Mesh._fields)
    count = len(vertices) if vertices.ndim else 0
    flat = vertices.shape == (count, 3) and faces.ndim == 2 and faces.shape[1] == 3 and faces.size
    if not count or not flat or indices.ndim != 2 or indices.shape != weights.shape or len(indices) != count:
        shapes = ", ".join(str(tuple(found[name].shape)) for name in Mesh._fields)
        raise UserError(f"{path}: expected vertices [n, 3], faces [f, 3], indices and weights [n, K], got {shapes}.")
    for name, values, limit in (("faces", faces, count), ("indices", indices, len(surface.bones_rest))):
        if not np.issubdtype(values.dtype, np.integer) or values.min() < 0 or values.max() >= limit:
            raise UserError(f"{path}: expected {name} as whole numbers from 0 to {limit - 1}, got others.")
    if not (np.isfinite(vertices).all() and np.isfinite(weights).all()):
        raise UserError(f"{path}: expected finite vertices and weights, got a NaN or an infinity.")
    mesh = Mesh(*(array.astype(kind) for array, kind in zip((vertices, faces, indices, weights), KINDS, strict=True)))
    return TrueMesh(mesh, surface)
