"""The true geometry of an Artemis animal: rest-pose voxels with skinning weights, moved by the bones."""

from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Protocol

import numpy as np
import torch

from rewild4d.datasets.artemis.files import read_matrices, read_parents
from rewild4d.errors import UserError
from rewild4d.files import load_tensors

SURFACE_POINTS = 10_000
"""Voxels of `Truth.surface` at most; `Truth.sample` draws as many points as it is asked for."""
PLAIN = (
    torch.float16, torch.float32, torch.float64, torch.uint8, torch.int8, torch.int16, torch.int32, torch.int64,
)  # fmt: skip
"""Types of tensors that files may hold."""
FILES = ("coords_init.pth", "volume_indices.pth", "volume_weights.pth")

OFF, RARE = 0.05, 0.01
"""How far from 1 the weights of a voxel may sum, and the share of voxels that may be further off."""


@dataclass(frozen=True)
class Voxels:
    """Voxels of the rest pose with skinning weights: all of them, or those of the surface.

    Attributes:
        points: centres, world units, float64, [V, 3].
        cells: their indices on the lattice, from zero, int64, [V, 3].
        indices: bones that move each voxel, 0 where the weight is, int64, [V, K].
        weights: as the files have them, nothing below zero, float64, [V, K].
        bones_rest: global bone-to-world matrices at rest, float64, [J, 4, 4].
        pitch: size of a voxel along each axis, world units, zero along an axis with one layer, [3].
        diagonal: of the rest pose's bounding box, world units.
    """

    points: np.ndarray
    cells: np.ndarray
    indices: np.ndarray
    weights: np.ndarray
    bones_rest: np.ndarray
    pitch: np.ndarray
    diagonal: float

    def posed(self, bones: np.ndarray) -> np.ndarray:
        """Return plain linear blend skinning with T_b = bones[b] @ inv(rest[b]), weights not renormalised, [n, 3]."""
        transforms = (bones @ np.linalg.inv(self.bones_rest))[:, :3]
        blended = np.einsum("nk,nkab->nab", self.weights, transforms[self.indices])
        return np.einsum("nab,nb->na", blended[..., :3], self.points) + blended[..., 3]

    def thinned(self, count: int) -> "Voxels":
        """Return at most ``count`` of the points, always the same ones."""
        if len(self.points) <= count:
            return self
        return self.rows(np.sort(np.random.default_rng(0).choice(len(self.points), count, replace=False)))

    def sampled(self, count: int, seed: int) -> "Voxels":
        """Return points in the cells of the surface voxels: each voxel gets as many as any other or one more.

        A point lies anywhere in its voxel's cell, as the true surface does, so two seeds give independent samplings of
        the surface and the distance between them is what a perfect reconstruction would get.
        """
        rng = np.random.default_rng((seed, count))
        whole, rest = divmod(count, len(self.points))
        drawn = rng.choice(len(self.points), rest, replace=False)
        picked = self.rows(np.sort(np.concatenate((np.tile(np.arange(len(self.points)), whole), drawn))))
        return replace(picked, points=picked.points + (rng.random((count, 3)) - 0.5) * self.pitch)

    def rows(self, rows: np.ndarray) -> "Voxels":
        """Return some of the voxels."""
        names = ("points", "cells", "indices", "weights")
        return replace(self, **{name: getattr(self, name)[rows] for name in names})


def read_skeleton(animal: Path) -> np.ndarray:
    """Return the rest bones of an animal, [J, 4, 4], held against the file of parents.

    Raises:
        UserError: a file is missing or damaged, a bone that cannot be inverted, another number of bones than parents.
    """
    path = animal / "bones" / "Bones_0000.inf"
    bones = read_matrices(path, "bone")
    parents = read_parents(animal / "bones")
    if len(parents) != len(bones):
        raise UserError(f"{path}: expected {len(parents)} bones (one for each parent listed), got {len(bones)}.")
    flat = np.flatnonzero(np.abs(np.linalg.det(bones[:, :3, :3])) < 1e-12)
    if len(flat):
        raise UserError(f"{path}: expected matrices that can be inverted, got a singular one in row {flat[0] + 1}.")
    return bones


def read_pose(animal: Path, motion: str, frame: int, bones: int) -> np.ndarray:
    """Return the global bone-to-world matrices at one frame, [J, 4, 4].

    Raises:
        UserError: no such file, or another number of bones than at rest.
    """
    path = animal / "bones" / motion / f"Bones_{frame:04d}.inf"
    pose = read_matrices(path, "bone")
    if len(pose) != bones:
        raise UserError(f"{path}: expected {bones} bones as in the rest pose, got {len(pose)}.")
    return pose


def read_surface(animal: Path) -> Voxels | None:
    """Return the voxels (see `read_voxels`) that miss one of their six neighbours, or None without volumes."""
    voxels = read_voxels(animal)
    return voxels and voxels.rows(np.flatnonzero(is_surface(voxels.cells)))


def read_voxels(animal: Path) -> Voxels | None:
    """Return the voxels of an animal, or None where it has no folder of volumes.

    Raises:
        UserError: a file is missing or damaged, shapes that do not fit, a bone index out of range, no lattice.
    """
    folder = animal / "volumes"
    if not folder.is_dir():
        return None
    bones_rest = read_skeleton(animal)
    points, indices, weights = (_tensor(folder / name) for name in FILES)
    if points.ndim != 2 or points.shape[1] != 3 or not len(points):
        raise UserError(f"{folder / FILES[0]}: expected points [V, 3], got shape {points.shape}.")
    if not np.isfinite(points).all():
        raise UserError(f"{folder / FILES[0]}: expected finite points, got NaN or infinity in {_unsound(points)}.")
    if indices.ndim != 2 or len(indices) != len(points) or not np.issubdtype(indices.dtype, np.integer):
        raise UserError(
            f"{folder / FILES[1]}: expected integers [{len(points)}, K], got {indices.dtype} of shape {indices.shape}."
        )
    if weights.shape != indices.shape:
        raise UserError(f"{folder / FILES[2]}: expected finite weights {indices.shape}, got shape {weights.shape}.")
    if not np.isfinite(weights).all():
        raise UserError(f"{folder / FILES[2]}: expected finite weights, got NaN or infinity in {_unsound(weights)}.")
    used = weights > 0
    outside = indices[used & ((indices < 0) | (indices >= len(bones_rest)))]
    if len(outside):
        raise UserError(f"{folder / FILES[1]}: expected bones 0 to {len(bones_rest) - 1}, got index {outside[0]}.")
    sums = np.where(used, weights, 0).sum(axis=1, dtype=np.float64)
    off = np.abs(sums - 1) > OFF
    if off.mean() > RARE:
        first = int(np.flatnonzero(off)[0])
        raise UserError(f"{folder / FILES[2]}: expected weights that sum to 1, got {sums[first]:.3g} at voxel {first}.")
    points = points.astype(np.float64)
    cells, error = lattice(points)
    if error > 0.1:
        raise UserError(f"{folder / FILES[0]}: expected voxel centres on a lattice, got one {error:.2g} cells off.")
    indices, weights = np.where(used, indices, 0).astype(np.int64), np.where(used, weights, 0).astype(np.float64)
    extent = np.ptp(points, axis=0)
    pitch = extent / np.maximum(cells.max(axis=0), 1)
    return Voxels(points, cells, indices, weights, bones_rest, pitch, float(np.linalg.norm(extent)))


def _unsound(rows: np.ndarray) -> str:
    return f"{int((~np.isfinite(rows)).any(axis=1).sum())} of {len(rows)} rows"


def lattice(points: np.ndarray) -> tuple[np.ndarray, float]:
    """Return the cells (from zero, int64) of points on a lattice, [n, 3], and the worst distance from a cell's centre.

    The lattice is axis-aligned, its pitch may differ per axis; the distance is in cells.
    """
    low = points.min(axis=0)
    extent = points.max(axis=0) - low
    # The octree has 256 cells an axis: gaps far below that are rounding of the stored numbers.
    noise = extent.max() / 65536 + 1e-12
    cells = np.zeros(points.shape)
    for axis in range(3):
        gaps = np.diff(np.unique(points[:, axis]))
        gaps = gaps[gaps > noise]
        if len(gaps):
            cells[:, axis] = (points[:, axis] - low[axis]) / np.median(gaps[gaps < 1.5 * gaps.min()])
    whole = np.rint(cells)
    return whole.astype(np.int64), float(np.abs(cells - whole).max())


def is_surface(cells: np.ndarray) -> np.ndarray:
    """Return which cells miss at least one of their six neighbours, bool, [n]."""
    # A border of one cell on each side keeps neighbours from wrapping into another row.
    size = cells.max(axis=0) + 3
    steps = np.array([size[1] * size[2], size[2], 1])
    keys = (cells + 1) @ steps
    filled = np.unique(keys)
    missing = np.zeros(len(cells), dtype=bool)
    for step in steps:
        for neighbour in (keys - step, keys + step):
            spot = np.searchsorted(filled, neighbour).clip(max=len(filled) - 1)
            missing |= filled[spot] != neighbour
    return missing


class Posable(Protocol):
    """Points at rest that bones move."""

    def posed(self, bones: np.ndarray) -> np.ndarray:
        """Return the points under global bone-to-world matrices [J, 4, 4], [n, 3]."""
        ...


class Surface(Protocol):
    """A surface at rest, of voxels or of triangles."""

    def thinned(self, count: int) -> Posable:
        """Return at most ``count`` points, always the same ones."""
        ...

    def sampled(self, count: int, seed: int) -> Posable:
        """Return so many points; another seed draws an independent sampling."""
        ...


@dataclass(frozen=True)
class MovingSurface:
    """A surface over time, known at the kept frames only.

    Attributes:
        surface: at rest.
        poses: bones of each kept frame, [J, 4, 4].
        fps: kept frames per second.
    """

    surface: Surface
    poses: list[np.ndarray]
    fps: float

    @cached_property
    def _thinned(self) -> Posable:
        return self.surface.thinned(SURFACE_POINTS)

    def at(self, time: float) -> torch.Tensor:
        """Return at most `SURFACE_POINTS` points, of voxels their centres (see `types.Truth.surface`)."""
        return torch.from_numpy(self._thinned.posed(self._pose(time)))

    def sample(self, time: float, count: int, seed: int) -> torch.Tensor:
        """Return points anywhere on the surface (see `types.Truth.sample`)."""
        return torch.from_numpy(self.surface.sampled(count, seed).posed(self._pose(time)))

    def _pose(self, time: float) -> np.ndarray:
        frame = round(time * self.fps)
        if not 0 <= frame < len(self.poses) or abs(time * self.fps - frame) > 1e-3:
            raise ValueError(f"the surface is known at {len(self.poses)} frames of 1/{self.fps:g} s, not at {time} s")
        return self.poses[frame]


def _tensor(path: Path) -> np.ndarray:
    value = load_tensors(path, "saved torch tensor")
    if not isinstance(value, torch.Tensor):
        raise UserError(f"{path}: expected a saved torch tensor, got {type(value).__name__}.")
    if value.layout != torch.strided or value.dtype not in PLAIN:
        raise UserError(f"{path}: expected a dense tensor of integers or floats, got {value.layout} of {value.dtype}.")
    return value.detach().numpy()
