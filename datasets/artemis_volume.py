"""The true geometry of an Artemis animal: rest-pose voxels with skinning weights, moved by the bones."""

import pickle
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch

from rewild4d.datasets.artemis_files import read_matrices, read_parents
from rewild4d.errors import UserError

SURFACE_POINTS = 10_000
FILES = ("coords_init.pth", "volume_indices.pth", "volume_weights.pth")


@dataclass(frozen=True)
class Surface:
    """Rest-pose surface points with skinning weights.

    Attributes:
        points: world units, float64, [n, 3].
        indices: bones that move each point, int64, [n, K].
        weights: as the files have them, nothing below zero, float64, [n, K].
        bones_rest: global bone-to-world matrices at rest, float64, [J, 4, 4].
    """

    points: np.ndarray
    indices: np.ndarray
    weights: np.ndarray
    bones_rest: np.ndarray

    def posed(self, bones: np.ndarray) -> np.ndarray:
        """Plain linear blend skinning with T_b = bones[b] @ inv(rest[b]), weights not renormalised, [n, 3]."""
        transforms = (bones @ np.linalg.inv(self.bones_rest))[:, :3]
        blended = np.einsum("nk,nkab->nab", self.weights, transforms[self.indices])
        return np.einsum("nab,nb->na", blended[..., :3], self.points) + blended[..., 3]


def read_skeleton(animal: Path) -> np.ndarray:
    """Rest bones of an animal, [J, 4, 4], held against the file of parents.

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
    """Global bone-to-world matrices at one frame, [J, 4, 4].

    Raises:
        UserError: no such file, or another number of bones than at rest.
    """
    path = animal / "bones" / motion / f"Bones_{frame:04d}.inf"
    pose = read_matrices(path, "bone")
    if len(pose) != bones:
        raise UserError(f"{path}: expected {bones} bones as in the rest pose, got {len(pose)}.")
    return pose


def read_surface(animal: Path) -> Surface | None:
    """The voxels of an animal that miss one of their six neighbours, or None where it has no folder of volumes.

    At most `SURFACE_POINTS` of them, always the same ones.

    Raises:
        UserError: a file is missing or damaged, shapes that do not fit, a bone index out of range, no lattice.
    """
    folder = animal / "volumes"
    if not folder.is_dir():
        return None
    bones_rest = read_skeleton(animal)
    points, indices, weights = (_tensor(folder / name) for name in FILES)
    if points.ndim != 2 or points.shape[1] != 3 or not len(points) or not np.isfinite(points).all():
        raise UserError(f"{folder / FILES[0]}: expected finite points [V, 3], got shape {points.shape}.")
    if indices.ndim != 2 or len(indices) != len(points) or not np.issubdtype(indices.dtype, np.integer):
        raise UserError(
            f"{folder / FILES[1]}: expected integers [{len(points)}, K], got {indices.dtype} of shape {indices.shape}."
        )
    if weights.shape != indices.shape or not np.isfinite(weights).all():
        raise UserError(f"{folder / FILES[2]}: expected finite weights {indices.shape}, got shape {weights.shape}.")
    used = weights > 0
    outside = indices[used & ((indices < 0) | (indices >= len(bones_rest)))]
    if len(outside):
        raise UserError(f"{folder / FILES[1]}: expected bones 0 to {len(bones_rest) - 1}, got index {outside[0]}.")
    points = points.astype(np.float64)
    cells, error = lattice(points)
    if error > 0.1:
        raise UserError(f"{folder / FILES[0]}: expected voxel centres on a lattice, got one {error:.2g} cells off.")
    rows = np.flatnonzero(is_surface(cells))
    if len(rows) > SURFACE_POINTS:
        rows = np.sort(np.random.default_rng(0).choice(rows, SURFACE_POINTS, replace=False))
    used = used[rows]
    return Surface(
        points[rows],
        np.where(used, indices[rows], 0).astype(np.int64),
        np.where(used, weights[rows], 0).astype(np.float64),
        bones_rest,
    )


def lattice(points: np.ndarray) -> tuple[np.ndarray, float]:
    """Integer cells of points on an axis-aligned lattice whose pitch may differ per axis.

    Args:
        points: float64, [n, 3].

    Returns:
        Cells from zero, int64, [n, 3], and how far the worst point is from its cell's centre, in cells.
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
    """Which cells miss at least one of their six neighbours, bool, [n]."""
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


def surface_over_time(surface: Surface, poses: list[np.ndarray], fps: float) -> Callable[[float], torch.Tensor]:
    """The function time -> surface points in the world, float64 [n, 3]; known at the given frames only.

    Args:
        surface: the points at rest.
        poses: bones of each kept frame, [J, 4, 4].
        fps: kept frames per second.
    """

    def at(time: float) -> torch.Tensor:
        frame = round(time * fps)
        if not 0 <= frame < len(poses) or abs(time * fps - frame) > 1e-3:
            raise ValueError(f"the surface is known at {len(poses)} frames of 1/{fps:g} s, not at {time} s")
        return torch.from_numpy(surface.posed(poses[frame]))

    return at


def _tensor(path: Path) -> np.ndarray:
    try:
        value = torch.load(path, map_location="cpu", weights_only=True)
    except OSError as error:
        raise UserError(f"{path}: expected a file that can be read, but: {error.strerror}.") from error
    except (RuntimeError, pickle.UnpicklingError, EOFError, ValueError, KeyError) as error:
        raise UserError(f"{path}: expected a saved torch tensor, but it cannot be read as one.") from error
    if not isinstance(value, torch.Tensor):
        raise UserError(f"{path}: expected a saved torch tensor, got {type(value).__name__}.")
    return value.numpy()
