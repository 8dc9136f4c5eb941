"""3D-Fauna's files and the command `prior import`: what is written is read back, and a fault is one sentence."""

import math
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
from calling import call, refusal

from rewild4d.errors import UserError
from rewild4d.priors.bodies.quadruped import QUADRUPED
from rewild4d.priors.fauna import read_fauna
from rewild4d.priors.fauna_bones import estimate_bones, joint_transforms, skinning_weights
from rewild4d.priors.fauna_files import read_obj
from rewild4d.priors.io import load_prior
from rewild4d.transforms import skin_points

STILL = np.concatenate((np.eye(3).ravel(), np.zeros(3)))


def write_fauna(folder: Path, rest: torch.Tensor, faces: torch.Tensor, angles: torch.Tensor, pose: np.ndarray) -> None:
    folder.mkdir()
    bones, parents = estimate_bones(rest)
    weights = skinning_weights(rest, bones)
    for frame, each in enumerate(angles):
        posed = skin_points(rest, weights, joint_transforms(bones, parents, each))
        stem = folder / f"0001000_{frame:>10}"
        lines = [f"v {x:.8f} {y:.8f} {z:.8f}" for x, y, z in posed.tolist()]
        lines += [f"f {a + 1}//{a + 1} {b + 1}//{b + 1} {c + 1}//{c + 1}" for a, b, c in faces.tolist()]
        Path(f"{stem}_mesh.obj").write_text("\n".join(lines))
        np.savetxt(f"{stem}_pose.txt", pose, fmt="%.6f")
        np.savetxt(f"{stem}_arti_params.txt", each.numpy())


def test_fauna_files_become_a_prior(tmp_path: Path) -> None:
    template = QUADRUPED.build()
    rest = 0.8 * template.vertices.double()
    angles = 0.15 * torch.randn(2, 20, 3, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    angles[1] *= 0.2  # the strongly bent first frame is not the one whose rest mesh is kept
    # looking along the animal's -x: object +z (its head) points to the camera's left
    rotation = np.array(((0.0, 0, -1), (0, 1, 0), (1, 0, 0)))
    write_fauna(tmp_path / "f", rest, template.faces, angles, np.concatenate((rotation.T.ravel(), (0.1, 0.2, 0.3))))
    prior = read_fauna(tmp_path / "f", flip=None, boxes=None, size=512, fps=10.0)
    assert prior.times.tolist() == [0.0, 0.1] and prior.cameras[0].width == 512
    assert prior.cameras[0].intrinsics[0, 0] == pytest.approx(256 / math.tan(math.radians(12.5)))
    assert float((prior.vertices - template.vertices).norm(dim=1).mean()) < 0.05
    assert prior.quality["unposed_residual"] < 0.01 and prior.quality["rest_asymmetry"] < 0.01
    assert prior.provenance.endswith("of frame 1.")
    # FORMATS 4.7: x right, y up, the camera 10 units from the origin; u grows with x, v against y
    eye = torch.from_numpy(rotation) @ rest[5] + torch.tensor((0.1, 0.2, 0.3 - 10.0), dtype=torch.float64)
    focal = 256 / math.tan(math.radians(12.5))
    wanted = torch.stack((256 + focal * eye[0] / -eye[2], 256 - focal * eye[1] / -eye[2]))
    scale = 5.0 / float((rest.amax(0) - rest.amin(0)).norm())
    assert torch.allclose(prior.cameras[1].project(scale * rest[5])[0], wanted, atol=1e-3)


def test_fauna_boxes_place_the_crop(tmp_path: Path) -> None:
    template = QUADRUPED.build()
    write_fauna(tmp_path / "f", template.vertices.double(), template.faces, torch.zeros(2, 20, 3).double(), STILL)
    (tmp_path / "b").mkdir()
    for frame in range(2):
        (tmp_path / "b" / f"{frame}_box.txt").write_text(f"{frame} 30 40 100 100 320 240 1.0")
    prior = read_fauna(tmp_path / "f", flip=tmp_path / "f", boxes=tmp_path / "b", size=256, fps=24.0)
    origin = torch.zeros(3).double()
    assert (prior.cameras[0].width, prior.cameras[0].height) == (320, 240)
    assert prior.cameras[0].project(origin)[0].tolist() == pytest.approx([30 + 50, 40 + 50])
    assert prior.cameras_flip[0].project(origin)[0].tolist() == pytest.approx([320 - 30 - 50, 40 + 50])


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the files of two frames and their boxes, without a fault."""
    folder = tmp_path_factory.mktemp("fauna") / "f"
    template = QUADRUPED.build()
    write_fauna(folder, template.vertices.double(), template.faces, torch.zeros(2, 20, 3).double(), STILL)
    for frame in range(2):
        (folder / f"{frame}_box.txt").write_text(f"{frame} 30 40 100 100 320 240 1.0")
    return folder


def refused(folder: Path, out: Path, flags: list[str], capsys: pytest.CaptureFixture[str]) -> str:
    """The one sentence that `prior import` leaves, and nothing else."""
    said = refusal(capsys, "prior", "import", "--files", folder, "--out", out / "p.npz", *flags)
    assert said.count("\n") == 1 and not out.exists()
    return said


def test_what_the_command_writes_is_read_back(whole: Path, tmp_path: Path) -> None:
    code = call("prior", "import", "--files", whole, "--out", tmp_path / "p.npz")
    made = read_fauna(whole, flip=None, boxes=None, size=256, fps=24.0)
    assert code == 0 and load_prior(tmp_path / "p.npz").digest == made.digest


MESH, POSE, BOX = "*0_mesh.obj", "*0_pose.txt", "0_box.txt"
CUBE = "".join(f"v {i & 1} {i >> 1 & 1} {i >> 2}\n" for i in range(8)) + "f 1 2 3"
TRIANGLE = "expected a triangle of three vertices (numbered from 1) in line 4235, got"
ROOM = "expected a mesh with room for bones, posed and at rest"
ROTATION = "expected a rotation (to 0.01) in the first nine numbers"
SIDES = "expected a crop and a frame of 1 to 65536 pixels a side"


def slanted(line: str) -> str:
    """A vertex moved into a plane that no axis is normal to."""
    kind, *rest = line.split()
    return f"v {float(rest[1]) + float(rest[2])} {rest[1]} {rest[2]}" if kind == "v" else line


@pytest.mark.parametrize(
    ("file", "change", "message"),
    [
        (MESH, lambda text: text[: text.index("f ") - 14], "expected three finite coordinates in line 1418, got 'v -"),
        (MESH, lambda text: "v nan 0 0\n" + text, "expected three finite coordinates in line 1, got 'v nan 0 0'"),
        (MESH, lambda text: "v 0 inf 0\n" + text, "expected three finite coordinates in line 1, got 'v 0 inf 0'"),
        (MESH, lambda text: text[: text.index("f ")], "expected a mesh of triangles, got 1418 vertices and 0 faces"),
        (MESH, lambda text: text + "\nf 1//1 2//2", f"{TRIANGLE} 'f 1//1 2//2'"),
        (MESH, lambda text: text + "\nf 1//1 2//2 3", f"{TRIANGLE} 'f 1//1 2//2 3'"),
        (MESH, lambda text: text + "\nf 1 2 3 4", f"{TRIANGLE} 'f 1 2 3 4'"),
        (MESH, lambda text: text + "\nf 0 1 2", f"{TRIANGLE} 'f 0 1 2'"),
        (MESH, lambda text: text + "\nf -1 -2 -1419", f"{TRIANGLE} 'f -1 -2 -1419'"),
        (MESH, lambda text: text + f"\nf 1 2 {10**20}", f"vertices 1 to 1418, got one of vertex {10**20}"),
        (MESH, lambda _: "v 0 0 0\nv 1 1 1\nv 1 0 2\nf 1 2 3", "got 3 vertices in a box of 1 x 1 x 2, too few"),
        (MESH, lambda _: "v 0 0 0\n" * 3 + "f 1 2 3", "got 3 vertices in a box of 0 x 0 x 0, too few"),
        (MESH, lambda _: CUBE, f"{ROOM}, got 8 vertices in a box of 1 x 1 x 1, too few or too flat."),
        (MESH, lambda text: "\n".join(map(slanted, text.splitlines())), f"{ROOM}, got 1418 vertices"),
        # the lowest vertex is the foremost too, so that the bones of its leg lie along x
        (MESH, lambda text: text + "\nv 0.3 -5 5", "where a bone has no length or lies along x"),
        (MESH, lambda text: text.replace("v 0.", "v 1e200 "), "too few or too flat"),
        (POSE, lambda _: "1 2 3", "expected 12 finite numbers, got 3"),
        (POSE, lambda _: "nan " * 12, "expected 12 finite numbers, got 12 that are not"),
        (POSE, lambda _: "0 " * 12, f"{ROTATION}, got 0 0 0 0 0 0 0 0 0."),
        (POSE, lambda _: "-1 0 0 0 1 0 0 0 1 0 0 0", f"{ROTATION}, got -1 0 0"),
        (POSE, lambda _: "1.01 0 0 0 1 0 0 0 1 0 0 0", f"{ROTATION}, got 1.01 0 0"),
        (BOX, lambda _: "0 30 40 0 100 320 240 1", f"{SIDES}, got 0x100 in 320x240."),
        (BOX, lambda _: "0 30 40 100 -9 320 240 1", f"{SIDES}, got 100x-9 in 320x240."),
        (BOX, lambda _: "0 30 40 100 100 0.5 1e300 1", f"{SIDES}, got 100x100 in 0.5x1e+300."),
    ],
)  # fmt: skip
def test_a_broken_file_is_one_sentence_and_nothing_is_written(
    whole: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    file: str,
    change: Callable[[str], str],
    message: str,
) -> None:
    folder = tmp_path / "f"
    shutil.copytree(whole, folder)
    path = next(folder.glob(file))
    path.write_text(change(path.read_text()))
    said = refused(folder, tmp_path / "out", ["--boxes", str(folder)] if file == BOX else [], capsys)
    assert f"{path}: expected" in said and message in said


@pytest.mark.parametrize(
    ("flags", "message"),
    [
        *((["--fps", value], f"--fps: expected a number above 0, got {value}.") for value in ("0", "-5")),
        *((["--fps", value], f"--fps: expected a finite number, got {value};") for value in ("nan", "inf")),
        *((["--size", value], f"--size: expected 1 to 65536 pixels, got {value}.") for value in ("0", "-4", "9" * 30)),
        # what no check of its own foresees, the checks of `load_prior` find before anything is written
        (["--fps", "1e-320"], "f: expected finite numbers in 'times', got 1 that are not."),
        (["--flip", "nowhere"], "nowhere: expected 3D-Fauna's result folder, but there is none."),
    ],
)
def test_a_flag_that_no_prior_can_have_is_one_sentence(
    whole: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], flags: list[str], message: str
) -> None:
    assert message in refused(whole, tmp_path / "out", flags, capsys)


def test_a_folder_without_meshes_and_a_broken_flipped_half_are_told(whole: Path, tmp_path: Path) -> None:
    flip = tmp_path / "flip"
    shutil.copytree(whole, flip)
    next(flip.glob("*1_pose.txt")).write_text("0 " * 12)
    with pytest.raises(UserError, match="flip/.*1_pose.txt: expected a rotation"):
        read_fauna(whole, flip=flip, boxes=None, size=256, fps=24.0)
    for mesh in flip.glob("*.obj"):
        mesh.unlink()
    with pytest.raises(UserError, match="flip: expected files named <step>_<frame>_mesh.obj"):
        read_fauna(flip, flip=None, boxes=None, size=256, fps=24.0)


def test_vertices_may_be_counted_backwards(tmp_path: Path) -> None:
    vertices = "v 0 0 0\nv 1 0 0 1 1 1\nv 0 1 0\n"
    (tmp_path / "a.obj").write_text(f"{vertices}f -3 -2 -1\nv 5 5 5\nf -1/1 -3/2 -4/3")
    points, faces = read_obj(tmp_path / "a.obj")
    assert points.shape == (4, 3) and faces.tolist() == [[0, 1, 2], [3, 1, 0]]
