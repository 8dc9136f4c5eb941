"""PLY files of other programs: colours in every encoding, and Gaussians that are not the reference's."""

import math
import struct
from itertools import product
from pathlib import Path

import pytest
import torch

from rewild4d.errors import UserError
from rewild4d.io import meshes
from rewild4d.io.ply import is_mesh, read_splats, read_surface

RED, GREEN, BLUE = 200 / 255, 30 / 255, 10 / 255
CORNERS = ((0, 0, 0), (1, 0, 0), (0, 1, 0))
TYPES = {"uchar": ("B", 255), "uint8": ("B", 255), "ushort": ("H", 65535), "float": ("f", 1.0), "double": ("d", 1.0)}
FORMATS = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}
NAMES = ("red green blue", "r g b", "diffuse_red diffuse_green diffuse_blue")
XYZ = "property float x\nproperty float y\nproperty float z\n"


def packed(order: str, code: str, values: tuple[float, ...]) -> bytes:
    """Values as a PLY of this byte order has them; text where there is none."""
    return struct.pack(f"{order}{code}", *values) if order else (" ".join(map(str, values)) + " ").encode()


def triangle(folder: Path, form: str, kind: str, names: str, colors: tuple[float, ...], of: str = "vertex") -> Path:
    """One triangle whose vertices (or whose face) have one colour."""
    order, code = FORMATS[form], TYPES.get(kind, ("i", 1))[0]
    declared = "".join(f"property {kind} {name}\n" for name in names.split())
    own = packed(order, code * len(colors), colors)
    rows = [packed(order, "fff", row) + (own if of == "vertex" else b"") + b"\n" * (not order) for row in CORNERS]
    body = b"".join(rows)
    body += packed(order, "Biii", (3, 0, 1, 2)) + (own if of == "face" else b"")
    header = f"ply\nformat {form} 1.0\nelement vertex 3\n{XYZ}{declared if of == 'vertex' else ''}"
    header += f"element face 1\nproperty list uchar int vertex_indices\n{declared if of == 'face' else ''}end_header\n"
    (folder / "a.ply").write_bytes(header.encode() + body)
    return folder / "a.ply"


def shades(kind: str) -> tuple[float, ...]:
    """200, 30, 10 of 255 in a type."""
    full = TYPES[kind][1]
    return tuple(value * full if isinstance(full, float) else round(value * full) for value in (RED, GREEN, BLUE))


@pytest.mark.parametrize(("form", "kind", "names"), product(FORMATS, TYPES, NAMES))
def test_a_colour_is_the_same_in_every_encoding(form: str, kind: str, names: str, tmp_path: Path) -> None:
    mesh = meshes.read_mesh(triangle(tmp_path, form, kind, names, shades(kind)))
    assert mesh.colors is not None
    torch.testing.assert_close(mesh.colors, torch.tensor([[RED, GREEN, BLUE]] * 3), atol=1e-5, rtol=0)
    assert mesh.vertices.tolist() == [list(map(float, row)) for row in CORNERS]


@pytest.mark.parametrize("form", FORMATS)
def test_colours_of_faces_are_those_of_their_triangles(form: str, tmp_path: Path) -> None:
    mesh = meshes.read_mesh(triangle(tmp_path, form, "uchar", NAMES[0], shades("uchar"), "face"))
    assert mesh.colors is not None and mesh.faces.tolist() == [[0, 1, 2]]
    torch.testing.assert_close(mesh.colors, torch.tensor([[RED, GREEN, BLUE]] * 3), atol=1e-6, rtol=0)


@pytest.mark.parametrize(
    ("kind", "names", "colors", "sentence"),
    [
        ("float", NAMES[0], (200.0, 30.0, 10.0), r"expected colours of floats in \[0, 1\], got 200 in vertex 0"),
        ("int", NAMES[0], (200, 30, 10), "expected colours of one type, uchar, ushort, float or double, got int32"),
        ("uchar", "red green", (200, 30), "expected red, green and blue of a vertex or none of them, got only 'red'"),
        ("uchar", NAMES[0], (300, 30, 10), "expected whole numbers from 0 to 255 in 'red', as its type says, got 300"),
        ("uchar", NAMES[0], (0.5, 0, 0), r"expected whole numbers from 0 to 255 in 'red', as its type says, got 0\.5"),
    ],
)
def test_colours_without_a_range_are_refused(
    kind: str, names: str, colors: tuple[float, ...], sentence: str, tmp_path: Path
) -> None:
    with pytest.raises(UserError, match=sentence):
        meshes.read_mesh(triangle(tmp_path, "ascii", kind, names, colors))


def test_numbers_of_an_obj_above_one_are_no_colours(tmp_path: Path) -> None:
    (tmp_path / "a.obj").write_text("v 0 0 0 200 30 10\nv 1 0 0 200 30 10\nv 0 1 0 200 30 10\nf 1 2 3\n")
    with pytest.raises(UserError, match=r"a\.obj: expected colours in \[0, 1\], got 200 in vertex 0"):
        meshes.read_mesh(tmp_path / "a.obj")


def gaussian(folder: Path, extra: dict[str, float], without: tuple[str, ...] = ()) -> Path:
    """One Gaussian with scales 1, 2 and 3 and an opacity of one half."""
    places = {"x": 0, "y": 0, "z": 0, "f_dc_0": 0, "f_dc_1": 0, "f_dc_2": 0, "opacity": 0}
    shape = {
        "scale_0": 0,
        "scale_1": math.log(2),
        "scale_2": math.log(3),
        "rot_0": 1,
        "rot_1": 0,
        "rot_2": 0,
        "rot_3": 0,
    }
    values = {**places, **shape}
    values = {name: value for name, value in (values | extra).items() if name not in without}
    header = "".join(f"property float {name}\n" for name in values)
    body = struct.pack(f"<{len(values)}f", *values.values())
    path = folder / "a.ply"
    path.write_bytes(f"ply\nformat binary_little_endian 1.0\nelement vertex 1\n{header}end_header\n".encode() + body)
    return path


def test_the_filter_of_mip_splatting_is_applied(tmp_path: Path) -> None:
    found = read_splats(gaussian(tmp_path, {"filter_3D": 4.0}))
    wide = [math.sqrt(1 + 16), math.sqrt(4 + 16), math.sqrt(9 + 16)]
    torch.testing.assert_close(found.scales, torch.tensor([wide]))
    share = math.sqrt((1 * 4 * 9) / ((1 + 16) * (4 + 16) * (9 + 16)))
    assert float(found.opacities[0]) == pytest.approx(0.5 * share)
    still = read_splats(gaussian(tmp_path, {"filter_3D": 0.0}))
    assert still.scales[0].tolist() == pytest.approx([1, 2, 3]) and float(still.opacities[0]) == 0.5


@pytest.mark.parametrize(
    ("extra", "without", "sentence"),
    [
        ({}, ("scale_2",), r"expected 3D Gaussians, got flat ones without scale_2 \(2DGS\), which are not read"),
        ({"filter_3D": -1.0}, (), "expected filter_3D of zero or more, got -1 in vertex 0"),
        ({"filter_3D": math.nan}, (), "expected finite filter_3D, got a NaN or an infinite value in vertex 0"),
        ({"motion_0": 1.0}, (), "expected Gaussians of 3DGS or Mip-Splatting, got 'motion_0', which is not read"),
        ({"f_offset_0": 1.0}, (), "expected Gaussians of 3DGS or Mip-Splatting, got 'f_offset_0', which is not read"),
        ({"scale_3": 1.0}, (), "expected Gaussians of 3DGS or Mip-Splatting, got 'scale_3', which is not read"),
        ({f"f_rest_{i}": 0.0 for i in range(40)}, (), r"expected 0, 9, 24 or 45 properties f_rest_\*, got 40"),
        ({f"f_rest_{i + (i > 3)}": 0.0 for i in range(9)}, (), "got none of the name f_rest_4"),
        ({}, ("opacity",), "got none of the name opacity"),
    ],
)
def test_other_gaussians_are_refused_by_name(
    extra: dict[str, float], without: tuple[str, ...], sentence: str, tmp_path: Path
) -> None:
    path = gaussian(tmp_path, extra, without)
    for read in (read_splats, lambda path: read_surface(path, 10, 0)):
        with pytest.raises(UserError, match=sentence):
            read(path)
    assert not is_mesh(path)
