"""PLY files: point clouds, meshes and 3D Gaussians in the layout of the reference implementation (INRIA).

That layout stores logarithms of the scales, logits of the opacities, quaternions wxyz of any length, and spherical
harmonics with the channel as the slower index of `f_rest_*`. ASCII and both binary byte orders are read, properties in
any order. The 3D filter of Mip-Splatting is applied; Gaussians of other kinds (2DGS, moving ones) are refused by name.
"""

from collections.abc import Collection, Iterable
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from rewild4d.errors import UserError, shown
from rewild4d.files import atomic
from rewild4d.harmonics import C0
from rewild4d.io.ply_elements import Element, read_elements
from rewild4d.io.sampling import sample_gaussians, sample_mesh
from rewild4d.types import Splats

SCALES = tuple(f"scale_{i}" for i in range(3))
QUATS = tuple(f"rot_{i}" for i in range(4))
COLORS = tuple(f"f_dc_{i}" for i in range(3))
SPLAT_PROPERTIES = (*COLORS, "opacity", *SCALES, *QUATS)
REST_COUNTS = {0: 0, 1: 9, 2: 24, 3: 45}
"""Degree of the spherical harmonics -> number of `f_rest_*` properties."""
FILTER = "filter_3D"
"""Smoothing filter of Mip-Splatting, a standard deviation in world units (`_smoothed`)."""
OF_GAUSSIANS = ("f_dc_", "f_rest_", "scale_", "rot_")
"""Files with a property that begins so hold Gaussians: those that are not the reference's are refused by name."""
OTHER_GAUSSIANS = (*OF_GAUSSIANS, "f_", "filter_", "motion_", "trbf_", "omega_")
MESH_COLORS = (("red", "green", "blue"), ("r", "g", "b"), ("diffuse_red", "diffuse_green", "diffuse_blue"))
FULL = {"u1": 255, "u2": 65535, "f4": 1, "f8": 1}
"""Declared type of a colour -> what full brightness is."""
ROUNDING = 1e-3
"""Colours of floats may leave [0, 1] by so much."""
LARGEST = {"means": 1e9, "scales": 1e6, "colors": 1e6}
"""Of what is read, in absolute value: what a camera makes of more does not fit single precision."""
BRIGHTEST_LOGIT = 15.0
"""Opacities are written within this logit of 0 and 1, so that 0 and 1 themselves stay finite."""


def read_mesh(path: Path) -> tuple[Tensor, Tensor]:
    """Return vertices, float64, [n, 3], and triangles, int64, [f, 3]; polygons are cut into fans, [0, 3] without faces.

    Raises:
        UserError: no such file, not a PLY, damaged, without x, y and z, with a NaN, or a face without its vertex.
    """
    elements = read_elements(path)
    points = _points(path, _vertices(path, elements))
    return points, _triangles(path, elements, len(points))[0]


def read_colored_mesh(path: Path) -> tuple[Tensor, Tensor, Tensor | None]:
    """Return a mesh as `read_mesh` with the RGB colour of each vertex in [0, 1], float32, [n, 3]; None without colours.

    Where the file has colours of faces instead, each triangle gets three vertices of its own.

    Raises:
        UserError: as `read_mesh`, or colours of a type without a range, outside their range, or not all three.
    """
    elements = read_elements(path)
    vertices = _vertices(path, elements)
    points = _points(path, vertices)
    triangles, faces = _triangles(path, elements, len(points))
    colors = _mesh_colors(path, vertices, "vertex")
    if colors is None and len(triangles):
        of_faces = _mesh_colors(path, elements["face"], "face")
        if of_faces is not None:
            points, triangles = points[triangles].flatten(0, 1), torch.arange(3 * len(triangles)).view(-1, 3)
            colors = of_faces[faces].repeat_interleave(3, 0)
    return points, triangles, colors


def read_splats(path: Path) -> Splats:
    """Return the Gaussians of a PLY file, activated values in single precision.

    Raises:
        UserError: as `read_mesh`, a property of a Gaussian is missing, or a value is beyond `LARGEST`.
    """
    splats = _splats(path, _vertices(path, read_elements(path)))
    require_at_most(path, "coordinates", splats.means, LARGEST["means"])
    require_at_most(path, "scales (e to the power of scale_0 to scale_2)", splats.scales, LARGEST["scales"])
    require_at_most(path, "coefficients of colour", splats.colors, LARGEST["colors"])
    return splats


def read_surface(path: Path, count: int, seed: int) -> Tensor:
    """Return points that stand for the surface in a PLY file, float64, [n, 3].

    A mesh is sampled uniformly by area, ``count`` points; Gaussians stand with their centres (`sample_gaussians`); of a
    plain cloud all points are taken as they are.

    Raises:
        UserError: as `read_mesh` and `read_splats`, or a mesh without area.
    """
    elements = read_elements(path)
    vertices = _vertices(path, elements)
    if holds_gaussians(vertices.columns):
        return sample_gaussians(_splats(path, vertices), count, seed)
    points = _points(path, vertices)
    faces, _ = _triangles(path, elements, len(points))
    if not len(faces):
        return points
    try:
        return sample_mesh(points, faces, count, seed)
    except ValueError as error:
        raise UserError(f"{path}: {error}.") from error


def is_mesh(path: Path) -> bool:
    """Tell whether `read_surface` samples a mesh of a PLY file; its errors are those of `read_surface`."""
    elements = read_elements(path)
    vertices = _vertices(path, elements)
    if holds_gaussians(vertices.columns):
        return False
    return len(_triangles(path, elements, len(_points(path, vertices)))[0]) > 0


def holds_gaussians(names: Iterable[str]) -> bool:
    """Tell whether properties of vertices of these names are those of Gaussians, of whatever kind."""
    return any(name.startswith(OF_GAUSSIANS) for name in names)


def write_splats(path: Path, splats: Splats) -> None:
    """Write Gaussians in the INRIA layout, binary little-endian, atomically.

    Raises:
        UserError: the folder cannot be written.
        ValueError: values that are not finite, scales not above zero, opacities outside [0, 1], coefficients other
            than 1, 4, 9 or 16 a Gaussian, and what `read_splats` refuses.
    """
    count, bands = len(splats), splats.colors.shape[1]
    if bands not in (1, 4, 9, 16):
        raise ValueError(f"expected 1, 4, 9 or 16 colour coefficients per Gaussian, got {bands}")
    colors = splats.colors.detach().cpu().double()
    if bands == 1:  # plain colour has no offset of one half, a harmonic of degree zero has
        colors = (colors - 0.5) / C0
    parts = {
        ("x", "y", "z"): splats.means,
        ("nx", "ny", "nz"): torch.zeros(count, 3),
        COLORS: colors[:, 0],
        tuple(f"f_rest_{i}" for i in range(3 * (bands - 1))): colors[:, 1:].transpose(1, 2).flatten(1),
        ("opacity",): splats.opacities.double().logit().clamp(-BRIGHTEST_LOGIT, BRIGHTEST_LOGIT)[:, None],
        SCALES: splats.scales.double().log(),
        QUATS: splats.quats,
    }
    names = [name for group in parts for name in group]
    values = torch.cat([part.detach().cpu().float() for part in parts.values()], dim=1).numpy()
    if not np.isfinite(values).all():
        raise ValueError("expected finite Gaussians, scales above zero, opacities in [0, 1]; got something else")
    for name, most in LARGEST.items():
        if (largest := float(getattr(splats, name).detach().abs().max()) if count else 0.0) > most:
            raise ValueError(f"expected {name} up to {most:g}, which is what can be read again, got {largest:.3g}")
    if bool((splats.quats == 0).all(dim=1).any()):
        raise ValueError("expected orientations (quats) of any length but zero, got a zero")
    lines = ["ply", "format binary_little_endian 1.0", f"element vertex {count}"]
    header = "\n".join([*lines, *(f"property float {name}" for name in names), "end_header", ""])
    with atomic(path) as temporary:
        temporary.write_bytes(header.encode("ascii") + values.astype("<f4").tobytes())


def require_at_most(path: Path, what: str, values: Tensor, most: float) -> None:
    """Refuse a file one of whose vertices has a larger value than ``most``, or one that is not finite, [n, ...].

    Raises:
        UserError: names the file, the value and the vertex.
    """
    largest = values.flatten(1).abs().amax(1)
    bad = (~(largest <= most)).nonzero()
    if len(bad):
        row = int(bad[0])
        raise UserError(f"{path}: expected {what} of at most {most:g}, got {float(largest[row]):.3g} in vertex {row}.")


def _vertices(path: Path, elements: dict[str, Element]) -> Element:
    found = elements.get("vertex")
    if found is None:
        raise UserError(f"{path}: expected an element 'vertex', got {', '.join(elements) or 'no element'}.")
    return found


def _columns(path: Path, element: Element, names: tuple[str, ...]) -> np.ndarray:
    """Return the finite values of the named properties, float64, [n, len(names)]."""
    missing = [name for name in names if name not in element.columns]
    if missing:
        raise UserError(f"{path}: expected vertices with {', '.join(names)}, got none of the name {missing[0]}.")
    with np.errstate(invalid="ignore"):  # a signalling NaN is refused below
        values = np.stack([element.columns[name].astype(np.float64) for name in names], axis=1)
    bad = np.flatnonzero(~np.isfinite(values).all(axis=1))
    if len(bad):
        what = f"{names[0]} to {names[-1]}" if len(names) > 1 else names[0]
        raise UserError(f"{path}: expected finite {what}, got a NaN or an infinite value in vertex {bad[0]}.")
    return values


def _points(path: Path, vertices: Element) -> Tensor:
    return torch.from_numpy(_columns(path, vertices, ("x", "y", "z")))


def _mesh_colors(path: Path, element: Element, row: str) -> Tensor | None:
    """Return RGB in [0, 1], [count, 3]: the declared type of the properties says what full brightness is."""
    columns = {name.lower(): column for name, column in element.columns.items()}
    named = next((names for names in MESH_COLORS if set(names) <= columns.keys()), None)
    if named is None:
        if part := next((name for names in MESH_COLORS if len(names[0]) > 1 for name in names if name in columns), ""):
            raise UserError(f"{path}: expected red, green and blue of a {row} or none of them, got only '{part}'.")
        return None
    kinds = {columns[name].dtype.newbyteorder("=").str[1:] for name in named}
    if len(kinds) > 1 or not kinds <= FULL.keys():
        wanted = "colours of one type, uchar, ushort, float or double"
        raise UserError(f"{path}: expected {wanted}, got {', '.join(str(columns[name].dtype) for name in named)}.")
    values = np.stack([columns[name].astype(np.float64) for name in named], axis=1) / FULL[kinds.pop()]
    bad = np.flatnonzero(~((values >= -ROUNDING) & (values <= 1 + ROUNDING)).all(axis=1))
    if len(bad):
        raise UserError(
            f"{path}: expected colours of floats in [0, 1], got {values[bad[0]].max():g} in {row} {bad[0]}."
        )
    return torch.from_numpy(values).float().clamp(0, 1)


def _triangles(path: Path, elements: dict[str, Element], vertices: int) -> tuple[Tensor, Tensor]:
    """Return triangles, [f, 3], and the face that each is cut from, [f]."""
    element = elements.get("face")
    if element is None or not element.count:
        return torch.empty(0, 3, dtype=torch.int64), torch.empty(0, dtype=torch.int64)
    name = next((name for name in ("vertex_indices", "vertex_index") if name in element.lists), None)
    if name is None:
        raise UserError(f"{path}: expected faces with a list 'vertex_indices', got none.")
    lengths, flat = element.lists[name]
    outside = flat[~((flat >= 0) & (flat < vertices))]
    if len(outside):
        raise UserError(f"{path}: expected faces of vertices 0 to {vertices - 1}, got vertex {outside[0]:g}.")
    # A polygon of k corners is a fan of k - 2 triangles around its first corner.
    fans = np.maximum(lengths - 2, 0)
    first = np.repeat(np.cumsum(lengths) - lengths, fans)
    step = np.arange(fans.sum()) - np.repeat(np.cumsum(fans) - fans, fans) + 1
    corners = np.stack((first, first + step, first + step + 1), axis=1)
    owner = np.repeat(np.arange(len(lengths)), fans)
    return torch.from_numpy(flat.astype(np.int64)[corners]), torch.from_numpy(owner)


def _require_reference(path: Path, names: Collection[str]) -> None:
    """Refuse Gaussians that others draw in another way than the reference: read as its own they would be wrong."""
    known = {*SPLAT_PROPERTIES, FILTER}
    if set(SPLAT_PROPERTIES).difference(names) == {"scale_2"}:
        raise UserError(f"{path}: expected 3D Gaussians, got flat ones without scale_2 (2DGS), which are not read.")
    for name in names:
        if name.startswith(OTHER_GAUSSIANS) and name not in known and not name.startswith("f_rest_"):
            raise UserError(
                f"{path}: expected Gaussians of 3DGS or Mip-Splatting, got '{shown(name)}', which is not read."
            )


def _smoothed(
    path: Path, vertices: Element, scales: np.ndarray, opacities: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Apply the 3D smoothing filter of Mip-Splatting where a file has one; scales [n, 3] and opacities [n].

    Scales become sqrt(scale^2 + filter^2); opacities are multiplied by sqrt(det / det'), the determinants of the
    covariance before and after, so that a Gaussian holds as much as before.
    """
    if FILTER not in vertices.columns:
        return scales, opacities
    width = _columns(path, vertices, (FILTER,))
    if (width < 0).any():
        raise UserError(f"{path}: expected {FILTER} of zero or more, got {width.min():g} in vertex {width.argmin()}.")
    wide = np.hypot(scales, width)
    share = np.divide(scales, wide, out=np.ones_like(scales), where=wide > 0)
    return wide, opacities * share.prod(axis=1)


def _splats(path: Path, vertices: Element) -> Splats:
    _require_reference(path, vertices.columns)
    rest = sum(name.startswith("f_rest_") for name in vertices.columns)
    degree = next((degree for degree, count in REST_COUNTS.items() if count == rest), None)
    if degree is None:
        raise UserError(f"{path}: expected 0, 9, 24 or 45 properties f_rest_*, got {rest}.")
    colors = _columns(path, vertices, COLORS)[:, None]
    if degree:
        others = _columns(path, vertices, tuple(f"f_rest_{i}" for i in range(rest)))
        colors = np.concatenate((colors, others.reshape(len(others), 3, rest // 3).transpose(0, 2, 1)), axis=1)
    else:
        colors = 0.5 + C0 * colors
    quats = _columns(path, vertices, QUATS)
    lengths = np.linalg.norm(quats, axis=1, keepdims=True)
    if not lengths.all():
        raise UserError(f"{path}: expected quaternions that are not zero, got one in vertex {lengths.argmin()}.")
    with np.errstate(over="ignore"):  # an infinite scale is refused where scales count, and 1 / inf is an opacity of 0
        scales, opacities = _smoothed(
            path, vertices, np.exp(_columns(path, vertices, SCALES)),
            1 / (1 + np.exp(-_columns(path, vertices, ("opacity",))[:, 0])),
        )  # fmt: skip
        values = {
            "means": _columns(path, vertices, ("x", "y", "z")),
            "quats": quats / lengths,
            "scales": scales,
            "opacities": opacities,
            "colors": colors,
        }
    return Splats(**{name: torch.from_numpy(value).float() for name, value in values.items()})
