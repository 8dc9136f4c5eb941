"""Triangle meshes with colour from OBJ and PLY files, and flat Gaussians on their surfaces."""

import math
import os
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import normalize

from rewild4d.errors import UserError
from rewild4d.foreign.reading import beside, picture_size, read_bytes, read_numbers
from rewild4d.io.ply import LARGEST, ROUNDING, read_colored_mesh, require_at_most
from rewild4d.priors.motion import quats_from_normals
from rewild4d.types import Splats

THICKNESS = 0.3
"""Scale along the normal over the scale in the surface, as `prior-only` has it: a thin shell."""


@dataclass(frozen=True)
class Mesh:
    """One moment of a surface.

    Attributes:
        vertices: float32, [n, 3].
        faces: int64, [f, 3].
        colors: RGB in [0, 1] of each vertex, multiplied with the texture where there is one, [n, 3], or None.
        uv: texture coordinates of each face's corners, (0, 0) = lower left, [f, 3, 2], or None.
        texture: RGB in [0, 1], [h, w, 3], or None.
    """

    vertices: Tensor
    faces: Tensor
    colors: Tensor | None = None
    uv: Tensor | None = None
    texture: Tensor | None = None


@dataclass(frozen=True)
class Discs:
    """Points on a mesh with what makes Gaussians of them.

    Attributes:
        points: [n, 3].
        normals: unit, [n, 3].
        radius: of a disc with each point's share of the area.
        colors: RGB in [0, 1], [n, 3], or None where the mesh has none.
    """

    points: Tensor
    normals: Tensor
    radius: float
    colors: Tensor | None

    def splats(self, colors: Tensor) -> Splats:
        """Return the opaque Gaussians of the given colours, [n, 3]."""
        count = len(self.points)
        scales = self.radius * self.points.new_tensor((1.0, 1.0, THICKNESS)).expand(count, 3)
        return Splats(self.points, quats_from_normals(self.normals), scales, torch.ones(count), colors[:, None])


def read_mesh(path: Path) -> Mesh:
    """Return a mesh with its colours, from an .obj or a .ply file.

    Raises:
        UserError: no such file, another kind of file, damaged, without triangles, or beyond `ply.LARGEST`.
    """
    if path.suffix.lower() == ".obj":
        mesh = _read_obj(path)
    elif path.suffix.lower() == ".ply":
        vertices, faces, colors = read_colored_mesh(path)
        mesh = Mesh(vertices.float(), faces, colors)
    else:
        raise UserError(f"{path}: expected a mesh as .obj or .ply, got '{path.suffix}'.")
    if not len(mesh.faces):
        raise UserError(f"{path}: expected a mesh with triangles, got {len(mesh.vertices)} points without any.")
    require_at_most(path, "coordinates", mesh.vertices, LARGEST["means"])
    if mesh.colors is not None:
        _require_finite(path, "colours", mesh.colors, "vertex")
    return mesh


def discs(meshes: Sequence[Mesh], count: int, seed: int) -> list[Discs]:
    """Draw area-uniform points on each mesh; meshes with the same faces get the same points, which move with them.

    Raises:
        ValueError: a mesh without area.
    """
    found: list[Discs] = []
    drawn: tuple[Tensor, Tensor, Tensor] | None = None
    for mesh in meshes:
        if drawn is None or not torch.equal(drawn[0], mesh.faces):
            drawn = (mesh.faces, *_draw(mesh, count, seed))
        _, face, shares = drawn
        corners = mesh.vertices[mesh.faces]
        cross = torch.linalg.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        radius = math.sqrt(float(cross.norm(dim=-1).sum()) / 2 / (math.pi * count))
        points = (shares[..., None] * corners[face]).sum(1)
        found.append(Discs(points, normalize(cross[face], dim=-1), radius, _colors(mesh, face, shares)))
    return found


def _draw(mesh: Mesh, count: int, seed: int) -> tuple[Tensor, Tensor]:
    """Return faces, [count], and barycentric coordinates in them, [count, 3]."""
    generator = torch.Generator().manual_seed(seed)
    corners = mesh.vertices[mesh.faces].double()
    area = torch.linalg.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]).norm(dim=-1)
    if not float(area.sum()) > 0:
        raise ValueError(f"expected triangles with an area, got {len(mesh.faces)} triangles without")
    face = torch.searchsorted(area.cumsum(0), float(area.sum()) * torch.rand(count, generator=generator).double())
    u, v = torch.rand(2, count, generator=generator)
    shares = torch.stack((1 - u.sqrt(), u.sqrt() * (1 - v), u.sqrt() * v), dim=-1)
    return face.clamp(max=len(area) - 1), shares


def _colors(mesh: Mesh, face: Tensor, shares: Tensor) -> Tensor | None:
    own = None if mesh.colors is None else (shares[..., None] * mesh.colors[mesh.faces[face]]).sum(1)
    if mesh.uv is not None and mesh.texture is not None:
        height, width = mesh.texture.shape[:2]
        uv = (shares[..., None] * mesh.uv[face]).sum(1)
        uv = torch.where((uv < 0) | (uv > 1), uv % 1.0, uv)  # repeated outside
        column = (uv[:, 0] * width).long().clamp(max=width - 1)
        row = ((1 - uv[:, 1]) * height).long().clamp(max=height - 1)
        texels = mesh.texture[row, column]
        return texels if own is None else texels * own
    return own


def _read_obj(path: Path) -> Mesh:
    """Return vertices (with colours behind the position where a program writes them), faces, one texture."""
    lines = read_numbers(path, "an OBJ file that can be read").decode("utf-8", errors="replace").splitlines()
    rows: dict[str, list[list[float]]] = {"v": [], "vt": []}
    faces: list[tuple[int, int, int]] = []
    places: list[tuple[int, int, int]] = []
    library = ""
    for number, line in enumerate(lines, 1):
        key, *words = line.split() or [""]
        try:
            if key in rows:
                rows[key].append([float(word) for word in words])
            elif key == "f":
                corners = [[int(part) if part else 0 for part in word.split("/")] for word in words]
                if len(corners) < 3 or not all(corner[0] for corner in corners):
                    wanted = f"a face of three or more corners, counted from 1, in line {number}"
                    raise UserError(f"{path}: expected {wanted}, got '{line.strip()[:60]}'.")
                fan = [(0, i, i + 1) for i in range(1, len(corners) - 1)]
                faces += [tuple(_index(corners[i][0], len(rows["v"])) for i in each) for each in fan]  # type: ignore[misc]
                if all(len(corner) > 1 and corner[1] for corner in corners):
                    places += [tuple(_index(corners[i][1], len(rows["vt"])) for i in each) for each in fan]  # type: ignore[misc]
            elif key == "mtllib" and words:
                library = " ".join(words)
        except ValueError as error:
            raise UserError(f"{path}: expected numbers in line {number}, got '{line.strip()[:60]}'.") from error
    return _mesh(path, rows, faces, places, library)


def _index(number: int, count: int) -> int:
    """Return an index from 0; OBJ counts from 1, and backwards from the latest with negative numbers."""
    return number - 1 if number > 0 else count + number


def _mesh(
    path: Path, rows: dict[str, list[list[float]]], faces: list[tuple[int, int, int]],
    places: list[tuple[int, int, int]], library: str,
) -> Mesh:  # fmt: skip
    widths = {len(row) for row in rows["v"]}
    if not widths or min(widths) < 3:
        raise UserError(f"{path}: expected vertices with three coordinates, got {'fewer' if widths else 'no vertex'}.")
    values = torch.tensor([row[:3] for row in rows["v"]])
    _require_finite(path, "coordinates", values, "vertex")
    indices = _corners(path, faces, len(values), "vertices")
    colors = _vertex_colors(path, rows["v"]) if widths == {6} else None
    texture = _texture(path, library) if places and len(places) == len(faces) else None
    if texture is None:
        return Mesh(values, indices, colors)
    corners = _corners(path, places, len(rows["vt"]), "texture coordinates")
    short = next((index for index, row in enumerate(rows["vt"]) if len(row) < 2), None)
    if short is not None:
        raise UserError(
            f"{path}: expected texture coordinates of two numbers, got {len(rows['vt'][short])} in vt {short}."
        )
    uv = torch.tensor([row[:2] for row in rows["vt"]])
    _require_finite(path, "texture coordinates", uv, "vt")
    return Mesh(values, indices, None, uv[corners], texture)  # programs that write both say one thing twice


def _vertex_colors(path: Path, rows: list[list[float]]) -> Tensor:
    """Return the RGB that stands behind each vertex, [n, 3]."""
    colors = torch.tensor([row[3:6] for row in rows])
    _require_finite(path, "colours", colors, "vertex")
    off = (((colors < -ROUNDING) | (colors > 1 + ROUNDING)).any(1)).nonzero()
    if len(off):
        row = int(off[0])
        raise UserError(f"{path}: expected colours in [0, 1], got {float(colors[row].max()):g} in vertex {row}.")
    return colors.clamp(0, 1)


def _corners(path: Path, triples: list[tuple[int, int, int]], count: int, what: str) -> Tensor:
    """Return rows of ``count`` things that the corners of triangles name, int64, [f, 3]."""
    if not all(0 <= corner < count for triple in triples for corner in triple):
        raise UserError(f"{path}: expected faces of {what} 1 to {count}, got one of another.")
    return torch.tensor(triples, dtype=torch.int64).reshape(-1, 3)


def _require_finite(path: Path, what: str, values: Tensor, row: str) -> None:
    bad = (~torch.isfinite(values).all(1)).nonzero()
    if len(bad):
        raise UserError(f"{path}: expected finite {what}, got a NaN or an infinite value in {row} {int(bad[0])}.")


def _texture(path: Path, library: str) -> Tensor | None:
    """Read the first picture of the material library; a missing library counts as none (3D-Fauna)."""
    if not library or not os.path.isfile(path.parent / library):
        return None
    materials = beside(path, library)
    for line in read_numbers(materials, "materials").decode("utf-8", errors="replace").splitlines():
        found = re.match(r"\s*map_Kd\s+(?:-\S+\s+\S+\s+)*(.+?)\s*$", line)
        if found:
            picture = beside(path, found[1])
            wanted = f"the texture of {path.name}"
            data = read_bytes(picture, wanted)
            picture_size(picture, data)
            pixels = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR) if data else None
            if pixels is None:
                raise UserError(f"{picture}: expected {wanted}, but it cannot be read as a picture.")
            return torch.from_numpy(np.ascontiguousarray(pixels[..., ::-1])).float() / 255
    return None
