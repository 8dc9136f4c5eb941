"""What a program of others wrote, as moments: Gaussians, or points on a mesh that become Gaussians once coloured."""

import math
from collections.abc import Sequence
from pathlib import Path

import torch
from scipy.spatial import cKDTree
from torch import Tensor
from torch.nn.functional import grid_sample, normalize

from rewild4d.baselines.external_gltf import read_animation
from rewild4d.errors import UserError
from rewild4d.foreign.reading import require_file
from rewild4d.io.meshes import Discs, Mesh, discs, read_mesh
from rewild4d.io.ply import holds_gaussians, read_splats
from rewild4d.transforms import split_similarity
from rewild4d.types import Camera, Frame, Splats

Moment = Splats | Discs


def read_moments(paths: Sequence[Path], times: Sequence[float], count: int, seed: int) -> list[Moment]:
    """Read a program's files.

    Args:
        paths: one a moment, or a single animated .glb.
        times: of the video's frames in seconds: those of an animated file lie in the same shares of its clip.
        count: points on a mesh.
        seed: of those points.

    Raises:
        UserError: a file that is damaged, empty, or holds a NaN.
    """
    if paths[0].suffix.lower() in (".glb", ".gltf"):
        parts = read_animation(paths[0], times)
        return list(_joined(paths[0], parts, count, seed))
    if all(path.suffix.lower() == ".ply" and _holds_splats(path) for path in paths):
        return [_some(path, read_splats(path)) for path in paths]
    meshes = [read_mesh(path) for path in paths]
    try:
        return list(discs(meshes, count, seed))
    except ValueError as error:
        raise UserError(f"{paths[0].parent}: {error}.") from error


def moved_discs(found: Discs, matrix: Tensor) -> Discs:
    """Move points on a mesh by a proper similarity [4, 4]."""
    scale, turn, shift = split_similarity(matrix.double())
    points = found.points.double() @ (scale * turn).T + shift
    return Discs(points.float(), (found.normals.double() @ turn.T).float(), found.radius * float(scale), found.colors)


def painted(moments: Sequence[Discs], shots: Sequence[tuple[Frame, Camera]]) -> list[Splats]:
    """Colour Gaussians of meshes without colour: what the input frame of the same moment shows where a point is seen.

    Points that move from moment to moment keep the mean of what the frames show of them. A point that no frame shows
    has the colour of the nearest one that is shown.

    Args:
        moments: in the world.
        shots: for each moment its frame and its camera.
    """
    looks = [_look(found, *shot) for found, shot in zip(moments, shots, strict=True)]
    if len({len(found.points) for found in moments}) == 1:
        weight = torch.stack([seen for _, seen in looks]).sum(0)
        mean = torch.stack([color * seen[:, None] for color, seen in looks]).sum(0) / weight.clamp_min(1e-9)[:, None]
        looks = [(mean, weight)] * len(moments)
    return [found.splats(_filled(found.points, *look)) for found, look in zip(moments, looks, strict=True)]


def _look(found: Discs, frame: Frame, camera: Camera) -> tuple[Tensor, Tensor]:
    """Return the colour of each point in a frame, [n, 3], and how squarely it is seen, zero where it is not, [n]."""
    pixels, depth = camera.project(found.points)
    grid = pixels / pixels.new_tensor((camera.width, camera.height)) * 2 - 1
    image = torch.cat((frame.rgb, frame.mask))[None]
    values = grid_sample(image, grid.view(1, 1, -1, 2).to(image), align_corners=False)[0, :, 0].T
    # Outward or inward: of a mesh of others only the nearer side counts, so the sign of its normals does not.
    facing = (found.normals * normalize(found.points - camera.center.to(found.points), dim=-1)).sum(-1).abs()
    near = _nearest(pixels, depth, camera, found.radius)
    shown = (values[:, 3] > 0.5) & near & (facing > 0.2)
    return values[:, :3] / values[:, 3:].clamp_min(1e-3), torch.where(shown, facing, torch.zeros_like(facing))


def _nearest(pixels: Tensor, depth: Tensor, camera: Camera, radius: float) -> Tensor:
    """Return which points lie at the front of a depth buffer whose cells are as large as the discs, boolean [n]."""
    cell = max(1.0, 3 * radius * float(camera.intrinsics[0, 0]) / float(depth.median().clamp_min(1e-6)))
    columns, rows = math.ceil(camera.width / cell), math.ceil(camera.height / cell)
    place = (pixels / cell).floor().clamp(-1, max(columns, rows)).long()
    inside = (depth > 0) & (place >= 0).all(-1) & (place[:, 0] < columns) & (place[:, 1] < rows)
    slot = (place[:, 1] * columns + place[:, 0]).clamp(0, rows * columns - 1)
    front = torch.full((rows * columns,), torch.inf).scatter_reduce_(0, slot[inside], depth[inside].float(), "amin")
    return inside & (depth <= front[slot] + 6 * radius)


def _filled(points: Tensor, colors: Tensor, seen: Tensor) -> Tensor:
    known = seen > 0
    if not known.any():
        return torch.full_like(colors, 0.5)
    colors = colors.clone()
    _, nearest = cKDTree(points[known].numpy()).query(points[~known].numpy())
    colors[~known] = colors[known][torch.from_numpy(nearest)]
    return colors.clamp(0, 1)


def _joined(path: Path, moments: Sequence[Sequence[Mesh]], count: int, seed: int) -> list[Discs]:
    """Return points on all parts of each moment, as many on each as its share of the first moment's area."""
    areas = [_area(part) for part in moments[0]]
    kept = [index for index, area in enumerate(areas) if area > 0]
    if not kept:
        raise UserError(f"{path}: expected triangles with an area, got none.")
    total = sum(areas)
    tracks = [discs([m[i] for m in moments], max(1, round(count * areas[i] / total)), seed + i) for i in kept]
    joined = []
    for parts in zip(*tracks, strict=True):
        colors = [part.colors for part in parts]
        whole = None if any(c is None for c in colors) else torch.cat([c for c in colors if c is not None])
        points, normals = torch.cat([part.points for part in parts]), torch.cat([part.normals for part in parts])
        joined.append(Discs(points, normals, sum(part.radius for part in parts) / len(parts), whole))
    return joined


def _area(mesh: Mesh) -> float:
    corners = mesh.vertices[mesh.faces]
    return float(torch.linalg.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]).norm(dim=-1).sum())


def _holds_splats(path: Path) -> bool:
    """Tell whether a PLY file's header names properties of Gaussians, of whatever kind."""
    require_file(path, "a PLY file that can be read")
    try:
        with path.open("rb") as file:
            header = file.read(1 << 14).split(b"end_header")[0]
    except OSError as error:
        raise UserError(f"{path}: expected a PLY file that can be read, but: {error.strerror}.") from error
    names = (
        line.split()[-1] for line in header.decode("ascii", "replace").splitlines() if line.startswith("property ")
    )
    return holds_gaussians(names)


def _some(path: Path, splats: Splats) -> Splats:
    if not len(splats):
        raise UserError(f"{path}: expected Gaussians, got none.")
    return splats
