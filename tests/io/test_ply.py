"""PLY files: every layout that occurs gives the same Gaussians, and what is broken says how in one sentence."""

import struct
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh
from torch import Tensor

from rewild4d.errors import UserError
from rewild4d.harmonics import C0
from rewild4d.io.ply import read_mesh, read_splats, read_surface, write_splats
from rewild4d.types import Splats

XYZ = "property float x\nproperty float y\nproperty float z\n"
POINTS = [[0.0, 1.0, 2.0], [3.5, -4.0, 5.25]]


def file(folder: Path, header: str, body: bytes = b"") -> Path:
    path = folder / "a.ply"
    path.write_bytes(f"ply\n{header}end_header\n".encode() + body)
    return path


def splats(degree: int, count: int = 7) -> Splats:
    generator = torch.Generator().manual_seed(degree)

    def draw(*shape: int) -> Tensor:
        return torch.rand(*shape, generator=generator)

    colors = draw(count, 1, 3) if degree == 0 else draw(count, (degree + 1) ** 2, 3) - 0.5
    quats = torch.nn.functional.normalize(draw(count, 4) - 0.5, dim=1)
    return Splats(draw(count, 3) - 0.5, quats, 0.01 + draw(count, 3), 0.01 + 0.98 * draw(count), colors)


def assert_same(one: Splats, other: Splats) -> None:
    for name in ("means", "quats", "scales", "opacities", "colors"):
        torch.testing.assert_close(getattr(one, name), getattr(other, name), atol=1e-6, rtol=1e-5)


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_gaussians_come_back(degree: int, tmp_path: Path) -> None:
    write_splats(tmp_path / "a.ply", splats(degree))
    assert_same(read_splats(tmp_path / "a.ply"), splats(degree))
    assert [entry.name for entry in tmp_path.iterdir()] == ["a.ply"]


def test_the_layout_is_the_reference_one(tmp_path: Path) -> None:
    """Written here by hand: log scales, logit opacity, the channel as the slower index, the offset of one half."""
    one = Splats(
        means=torch.tensor(((1.0, 2.0, 3.0),)),
        quats=torch.tensor(((1.0, 0.0, 0.0, 0.0),)),
        scales=torch.tensor(((1.0, np.e, np.e**2),), dtype=torch.float32),
        opacities=torch.tensor((0.75,)),
        colors=torch.arange(12.0).reshape(1, 4, 3),
    )
    write_splats(tmp_path / "a.ply", one)
    header, body = (tmp_path / "a.ply").read_bytes().split(b"end_header\n")
    names = [line.split()[-1] for line in header.decode().splitlines() if line.startswith("property float")]
    values = dict(zip(names, struct.unpack(f"<{len(names)}f", body), strict=True))
    assert names[:9] == ["x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2"]
    assert names[9:] == [*(f"f_rest_{i}" for i in range(9)), "opacity", *(f"scale_{i}" for i in range(3)), *(
        f"rot_{i}" for i in range(4)
    )]  # fmt: skip
    assert [values[f"f_dc_{i}"] for i in range(3)] == [0, 1, 2]
    # Coefficients 3..11 are [k][channel]; the file has [channel][k].
    assert [values[f"f_rest_{i}"] for i in range(9)] == [3, 6, 9, 4, 7, 10, 5, 8, 11]
    assert values["opacity"] == pytest.approx(np.log(0.75 / 0.25), rel=1e-6)
    assert [values[f"scale_{i}"] for i in range(3)] == pytest.approx([0, 1, 2])
    plain = replace(one, colors=torch.tensor((((0.5, 1.0, 0.0),),)))
    write_splats(tmp_path / "b.ply", plain)
    body = (tmp_path / "b.ply").read_bytes().split(b"end_header\n")[1]
    assert struct.unpack("<17f", body)[6:9] == pytest.approx((0, 0.5 / C0, -0.5 / C0))


@pytest.mark.parametrize("order", ["ascii", "binary_little_endian", "binary_big_endian"])
@pytest.mark.parametrize("kind", ["float", "double"])
def test_any_order_of_properties_and_bytes(order: str, kind: str, tmp_path: Path) -> None:
    write_splats(tmp_path / "plain.ply", splats(1))
    header, body = (tmp_path / "plain.ply").read_bytes().split(b"end_header\n")
    names = [line.split()[-1] for line in header.decode().splitlines() if line.startswith("property")]
    values = np.frombuffer(body, "<f4").reshape(7, len(names)).astype(np.float64)
    shuffled = np.random.default_rng(0).permutation(len(names))
    lines = [f"format {order} 1.0", "comment of anything", "obj_info too", "element vertex 7", "property uchar red"]
    lines += [f"property {kind} {names[i]}" for i in shuffled]
    rows = [(200, *row) for row in values[:, shuffled]]
    if order == "ascii":
        made = "\n".join(" ".join(repr(float(value)) for value in row) for row in rows).encode()
    else:
        code = ("<" if "little" in order else ">") + "B" + (kind[0] * len(names))
        made = b"".join(struct.pack(code, *row) for row in rows)
    assert_same(read_splats(file(tmp_path, "\n".join(lines) + "\n", made)), splats(1))


def test_quaternions_of_any_length_are_made_unit(tmp_path: Path) -> None:
    one = splats(0)
    write_splats(tmp_path / "a.ply", replace(one, quats=3 * one.quats))
    assert_same(read_splats(tmp_path / "a.ply"), one)


def test_opacities_of_zero_and_one_stay_finite(tmp_path: Path) -> None:
    one = splats(0, 2)
    write_splats(tmp_path / "a.ply", replace(one, opacities=torch.tensor((0.0, 1.0))))
    torch.testing.assert_close(read_splats(tmp_path / "a.ply").opacities, torch.tensor((0.0, 1.0)), atol=1e-6, rtol=0)


@pytest.mark.parametrize(("change", "value"), [("means", np.nan), ("scales", 0.0), ("opacities", 1.5)])
def test_what_cannot_be_written_leaves_nothing(change: str, value: float, tmp_path: Path) -> None:
    broken = splats(0)
    getattr(broken, change)[0] = value
    with pytest.raises(ValueError, match=r"expected finite Gaussians, scales above zero, opacities in \[0, 1\]"):
        write_splats(tmp_path / "a.ply", broken)
    with pytest.raises(ValueError, match="expected 1, 4, 9 or 16 colour coefficients per Gaussian, got 2"):
        write_splats(tmp_path / "a.ply", replace(splats(0), colors=torch.zeros(7, 2, 3)))
    with pytest.raises(ValueError, match=r"expected means up to 1e\+09, .* got 2e\+09"):
        write_splats(tmp_path / "a.ply", replace(splats(0), means=torch.full((7, 3), 2e9)))
    with pytest.raises(ValueError, match="any length but zero"):
        write_splats(tmp_path / "a.ply", replace(splats(0), quats=torch.zeros(7, 4)))
    assert not list(tmp_path.iterdir())


def check_points(path: Path) -> None:
    assert read_mesh(path)[0].tolist() == POINTS
    assert read_surface(path, 50, 0).tolist() == POINTS
    assert len(read_mesh(path)[1]) == 0


@pytest.mark.parametrize("encoding", ["ascii", "binary"])
def test_points_of_trimesh_files(encoding: str, tmp_path: Path) -> None:
    cloud = trimesh.PointCloud(np.array(POINTS), colors=np.full((2, 4), 255, np.uint8))
    cloud.export(tmp_path / "t.ply", encoding=encoding)
    check_points(tmp_path / "t.ply")


@pytest.mark.parametrize("ascii_file", [True, False])
def test_points_of_open3d_files(ascii_file: bool, tmp_path: Path) -> None:
    o3d = pytest.importorskip("open3d")
    cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(POINTS))
    cloud.colors = o3d.utility.Vector3dVector(np.ones((2, 3)))
    o3d.io.write_point_cloud(str(tmp_path / "o.ply"), cloud, write_ascii=ascii_file)
    check_points(tmp_path / "o.ply")


def check_box(path: Path, truth_vertices: np.ndarray, truth_faces: np.ndarray) -> None:
    """A box of 1 by 2 by 3 whose highest corners have z = 3."""
    vertices, faces = read_mesh(path)
    np.testing.assert_allclose(vertices, truth_vertices)
    np.testing.assert_array_equal(faces, truth_faces)
    points = read_surface(path, 22_000, 0)
    assert points.shape == (22_000, 3) and points.dtype == torch.float64
    on_top = float((points[:, 2] > 3 - 1e-9).double().mean())
    assert on_top == pytest.approx(1 * 2 / (2 * (1 * 2 + 1 * 3 + 2 * 3)), abs=0.01)
    assert torch.equal(points, read_surface(path, 22_000, 0))


@pytest.mark.parametrize("encoding", ["ascii", "binary"])
def test_meshes_of_trimesh_files(encoding: str, tmp_path: Path) -> None:
    box = trimesh.creation.box(bounds=((0, 0, 0), (1, 2, 3)))
    box.export(tmp_path / "t.ply", encoding=encoding)
    check_box(tmp_path / "t.ply", box.vertices, box.faces)


@pytest.mark.parametrize("ascii_file", [True, False])
def test_meshes_of_open3d_files(ascii_file: bool, tmp_path: Path) -> None:
    o3d = pytest.importorskip("open3d")
    box = o3d.geometry.TriangleMesh.create_box(1.0, 2.0, 3.0)
    o3d.io.write_triangle_mesh(str(tmp_path / "o.ply"), box, write_ascii=ascii_file)
    check_box(tmp_path / "o.ply", np.asarray(box.vertices), np.asarray(box.triangles))


@pytest.mark.parametrize("order", ["<", ">"])
def test_polygons_are_cut_into_fans(order: str, tmp_path: Path) -> None:
    name = "binary_little_endian" if order == "<" else "binary_big_endian"
    header = f"format {name} 1.0\nelement vertex 5\n{XYZ}element face 3\n"
    header += "property uchar flag\nproperty list uchar int vertex_index\n"
    body = struct.pack(f"{order}15f", *range(15))
    for corners in ((0, 1, 2), (4, 3, 2, 1), (0, 1)):
        body += struct.pack(f"{order}BB{len(corners)}i", 9, len(corners), *corners)
    assert read_mesh(file(tmp_path, header, body))[1].tolist() == [[0, 1, 2], [4, 3, 2], [4, 2, 1]]


def test_gaussians_stand_with_their_centres(tmp_path: Path) -> None:
    one = splats(0)
    one.opacities[:] = torch.tensor((0.05,) * 4 + (1.0,) * 3)
    write_splats(tmp_path / "a.ply", one)
    torch.testing.assert_close(read_surface(tmp_path / "a.ply", 500, 0), one.means[4:].double())
    assert len(read_surface(tmp_path / "a.ply", 2, 0)) == 2
    assert len(read_mesh(tmp_path / "a.ply")[0]) == 7
    header = f"{ASCII}element vertex 2\n{XYZ}{WHOLE}"
    vast = file(tmp_path, header, b"1 2 3 0 0 0 9 888 88 88 1 0 0 0 4 5 6 0 0 0 -888 0 0 0 1 0 0 0")
    assert read_surface(vast, 9, 0).tolist() == [[1, 2, 3]], "sizes do not count, a faint one does not"


def test_a_file_without_points_is_no_error(tmp_path: Path) -> None:
    for order in ("ascii", "binary_little_endian"):
        assert read_mesh(file(tmp_path, f"format {order} 1.0\nelement vertex 0\n{XYZ}"))[0].shape == (0, 3)


ASCII = "format ascii 1.0\n"
BINARY = "format binary_little_endian 1.0\n"
FACE = "element face 1\nproperty list uchar int vertex_indices\n"
SPLAT = "".join(f"property float {n}\n" for n in ("f_dc_0", "f_dc_1", "f_dc_2", "opacity", "scale_0", "scale_1"))
WHOLE = SPLAT + "".join(f"property float {n}\n" for n in ("scale_2", "rot_0", "rot_1", "rot_2", "rot_3"))

BROKEN = {
    "cut off": (
        f"{BINARY}element vertex 3\n{XYZ}",
        b"\0" * 35,
        "expected 3 rows of 'vertex', but the file ends before",
    ),
    "cut off ascii": (
        f"{ASCII}element vertex 2\n{XYZ}",
        b"0 1 2 3 4",
        "expected 2 rows of 'vertex', but the file ends",
    ),
    "too many claimed": (f"{BINARY}element vertex 99999999999999\n{XYZ}", b"\0" * 36, "expected 99999999999999 rows"),
    "unknown type": (
        f"{ASCII}element vertex 1\nproperty quad x\n",
        b"",
        "a PLY type such as float or uchar, got 'quad'",
    ),
    "unknown format": (f"format morse 1.0\nelement vertex 1\n{XYZ}", b"", "a PLY 1.0 header, got 'format morse 1.0'"),
    "no format": (f"element vertex 1\n{XYZ}", b"0 0 0", "expected a line 'format' in the PLY header, got none"),
    "bad line": (f"{ASCII}element vertex many\n", b"", "a line of a PLY 1.0 header, got 'element vertex many'"),
    "twice": (
        f"{ASCII}element vertex 1\n{XYZ}property int x\n",
        b"0 0 0 0",
        "with different names, got one name twice",
    ),
    "words": (f"{ASCII}element vertex 1\n{XYZ}", b"0 zero 0", "expected numbers in the body of an ASCII PLY file"),
    "no z": (
        f"{ASCII}element vertex 1\nproperty float x\nproperty float y\n",
        b"0 0",
        "x, y, z, got none of the name z",
    ),
    "no vertices": (f"{ASCII}element tree 1\nproperty int x\n", b"0", "expected an element 'vertex', got tree"),
    "nan": (
        f"{ASCII}element vertex 2\n{XYZ}",
        b"0 0 0 0 nan 0",
        "finite x to z, got a NaN or an infinite value in vertex 1",
    ),
    "far face": (f"{ASCII}element vertex 1\n{XYZ}{FACE}", b"0 0 0 3 0 0 7", "faces of vertices 0 to 0, got vertex 7"),
    "faces": (f"{ASCII}element vertex 1\n{XYZ}element face 1\nproperty int a\n", b"0 0 0 1", "a list 'vertex_indices'"),
    "list length": (
        f"{ASCII}element vertex 1\n{XYZ}{FACE}",
        b"0 0 0 -3 0 0 0",
        "lists of zero or more entries, got one of -3",
    ),
    "flat": (
        f"{ASCII}element vertex 1\n{XYZ}{FACE}",
        b"0 0 0 3 0 0 0",
        "triangles with an area, got 1 triangles without",
    ),
    "long list": (
        f"{BINARY}element vertex 1\n{XYZ}{FACE}",
        b"\0" * 12 + b"\3\0\0",
        "expected 1 rows of 'face', but the file ends",
    ),
}


@pytest.mark.parametrize("name", BROKEN)
def test_broken_files_say_so_in_one_sentence(name: str, tmp_path: Path) -> None:
    header, body, text = BROKEN[name]
    path = file(tmp_path, header, body)
    with pytest.raises(UserError) as caught:
        read_surface(path, 10, 0)
    assert str(caught.value).startswith(f"{path}: expected ") and text in str(caught.value)
    assert str(caught.value).endswith(".") and "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("header", "body", "text"),
    [
        (f"{XYZ}{SPLAT}", b"0 " * 9, "got none of the name rot_0"),
        (f"{XYZ}{WHOLE}", b"0 " * 14, "expected quaternions that are not zero, got one in vertex 0"),
        (
            f"{XYZ}{WHOLE}",
            b"0 " * 6 + b"inf " + b"1 " * 7,
            "finite opacity, got a NaN or an infinite value in vertex 0",
        ),
        (f"{XYZ}{WHOLE}property float f_rest_0\n", b"1 " * 15, "expected 0, 9, 24 or 45 properties f_rest_*, got 1"),
        (f"{XYZ}{WHOLE}", b"1 " * 8 + b"88 " + b"1 " * 5, "scale_2) of at most 1e+06, got 1.65e+38 in vertex 0"),
        (f"{XYZ}{WHOLE}", b"1 " * 8 + b"888 " + b"1 " * 5, "scale_0 to scale_2) of at most 1e+06, got inf in vertex 0"),
        (f"{XYZ}{WHOLE}", b"-1e300 " + b"1 " * 13, "expected coordinates of at most 1e+09, got inf in vertex 0"),
        (f"{XYZ}{WHOLE}", b"1 " * 3 + b"1e38 " + b"1 " * 10, "coefficients of colour of at most 1e+06, got 2.82e+37"),
    ],
)
def test_broken_gaussians_say_so(header: str, body: bytes, text: str, tmp_path: Path) -> None:
    path = file(tmp_path, f"{ASCII}element vertex 1\n{header}", body)
    with pytest.raises(UserError) as caught:
        read_splats(path)
    assert str(caught.value).startswith(f"{path}: expected ") and text in str(caught.value)


@pytest.mark.parametrize(
    ("content", "text"),
    [
        (b"solid stl", "expected a PLY file, which begins with the line 'ply', got another kind of file."),
        (b"", "expected a PLY file, which begins with the line 'ply', got another kind of file."),
        (b"ply\nformat ascii 1.0\n", "expected a PLY header that ends with 'end_header', got none."),
        (None, "expected a PLY file that can be read, but: No such file or directory."),
    ],
)
def test_other_files_are_no_ply(content: bytes | None, text: str, tmp_path: Path) -> None:
    path = tmp_path / "a.ply"
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(UserError) as caught:
        read_mesh(path)
    assert str(caught.value) == f"{path}: {text}"


def test_windows_line_ends(tmp_path: Path) -> None:
    path = tmp_path / "a.ply"
    text = f"ply\nformat binary_little_endian 1.0\nelement vertex 2\n{XYZ}end_header\n".replace("\n", "\r\n")
    path.write_bytes(text.encode() + struct.pack("<6f", *sum(POINTS, [])))
    assert read_mesh(path)[0].tolist() == POINTS
