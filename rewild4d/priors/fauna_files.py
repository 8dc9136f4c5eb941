"""Read and check the files of 3D-Fauna's test run (design notes, FORMATS 4.6 to 4.8)."""

import math
import re
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from rewild4d.errors import UserError
from rewild4d.priors.io import OFF_ROTATION, off_similarity
from rewild4d.transforms import rigid
from rewild4d.types import Camera

FIELD_OF_VIEW, OFFSET = math.radians(25.0), 10.0
NATIVE = 256
LARGEST = 65536
"""Most pixels along a side of a crop or frame."""
EXPECTED = {"v": "three finite coordinates", "f": "a triangle of three vertices (numbered from 1)"}
_NAME = re.compile(r"(?P<step>\d+)_\s*(?P<frame>\S+)_mesh\.obj")


def stems(folder: Path) -> dict[str, str]:
    """Return file stems by frame name, of the latest step, in order of the frames.

    Raises:
        UserError: no folder, or no meshes in it.
    """
    if not folder.is_dir():
        raise UserError(f"{folder}: expected 3D-Fauna's result folder, but there is none.")
    found: dict[str, tuple[int, str]] = {}
    for file in folder.iterdir():
        if match := _NAME.fullmatch(file.name):
            step = int(match["step"])
            if step >= found.get(match["frame"], (-1, ""))[0]:
                found[match["frame"]] = (step, file.name.removesuffix("_mesh.obj"))
    if not found:
        raise UserError(f"{folder}: expected files named <step>_<frame>_mesh.obj as 3D-Fauna's test run writes them.")
    ordered = sorted(found, key=lambda name: (int(name) if name.isdecimal() else 0, name))
    return {frame: found[frame][1] for frame in ordered}


def frames(
    folder: Path, stem_of: dict[str, str], boxes: Path | None, size: int, *, flipped: bool
) -> tuple[list[Tensor], list[Camera]]:
    """Return the joint angles, float64, [20, 3], and the camera of every frame; for the arguments see `read_fauna`.

    Raises:
        UserError: a file is missing, or its numbers are no angles, no pose or no box.
    """
    angles, cameras = [], []
    for frame, stem in stem_of.items():
        angles.append(_numbers(folder / f"{stem}_arti_params.txt", 60).reshape(20, 3))
        camera = _camera(folder / f"{stem}_pose.txt")
        cameras.append(_placed(camera, boxes / f"{frame}_box.txt" if boxes else None, size, flipped))
    return angles, cameras


def _camera(path: Path) -> Camera:
    """Read Fauna's twelve numbers: rows right, up, forward (the transposed rotation), a translation; OpenGL axes."""
    pose = _numbers(path, 12)
    open_gl = rigid(pose[:9].reshape(3, 3).T, pose[9:] + pose.new_tensor((0.0, 0.0, -OFFSET)))
    if off_similarity(open_gl, rigid=True) > OFF_ROTATION:
        came = " ".join(f"{number:g}" for number in pose[:9].tolist())
        raise UserError(f"{path}: expected a rotation (to {OFF_ROTATION:g}) in the first nine numbers, got {came}.")
    world_to_camera = torch.diag(pose.new_tensor((1.0, -1.0, -1.0, 1.0))) @ open_gl
    focal, half = NATIVE / 2 / math.tan(FIELD_OF_VIEW / 2), NATIVE / 2
    intrinsics = pose.new_tensor(((focal, 0.0, half), (0.0, focal, half), (0.0, 0.0, 1.0)))
    return Camera(world_to_camera, intrinsics, NATIVE, NATIVE)


def _placed(camera: Camera, box: Path | None, size: int, flipped: bool) -> Camera:
    """Return the camera of the crop at another size, or with a box file that of the whole frame."""
    if box is None:
        return camera.resized(size, size)
    numbers = _numbers(box, 8)[1:7].tolist()
    if not all(1 <= side <= LARGEST for side in numbers[2:]):
        came = "{:g}x{:g} in {:g}x{:g}".format(*numbers[2:])
        raise UserError(f"{box}: expected a crop and a frame of 1 to {LARGEST} pixels a side, got {came}.")
    left, top, width, height, full_width, full_height = (int(number) for number in numbers)
    if flipped:
        left = full_width - left - width
    return camera.resized(width, height).shifted(-left, -top, full_width, full_height)


def _numbers(path: Path, count: int) -> Tensor:
    """Read whitespace-separated numbers, float64, [count].

    Raises:
        UserError: no such file, or other than ``count`` finite numbers.
    """
    try:
        values = np.array(path.read_text(encoding="utf-8").split(), dtype=np.float64)
    except OSError as error:
        raise UserError(f"{path}: expected a file of 3D-Fauna, but: {error.strerror}.") from error
    except ValueError as error:
        raise UserError(f"{path}: expected {count} numbers, got text ({error}).") from error
    finite = int(np.isfinite(values).sum())
    if len(values) != count or finite != count:
        came = f"{len(values)}" if finite == len(values) else f"{len(values) - finite} that are not"
        raise UserError(f"{path}: expected {count} finite numbers, got {came}.")
    return torch.from_numpy(values)


def read_obj(path: Path) -> tuple[Tensor, Tensor]:
    """Read vertices, float64, [n, 3], and triangles, int64, [f, 3].

    Raises:
        UserError: the file cannot be read, a line is cut off or no triangle, or a vertex is missing or not finite.
    """
    try:
        lines = path.read_text(encoding="utf-8").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        came = getattr(error, "strerror", None) or error
        raise UserError(f"{path}: expected a mesh as 3D-Fauna writes it, but: {came}.") from error
    vertices: list[tuple[float, ...]] = []
    faces: list[tuple[int, ...]] = []
    for number, line in enumerate(lines, 1):
        kind, *words = line.split() or [""]
        try:
            if kind == "v":
                vertices.append(_vertex(words))
            elif kind == "f":
                faces.append(_face(words, len(vertices)))
        except ValueError as error:
            raise UserError(
                f"{path}: expected {EXPECTED[kind]} in line {number}, got '{line.strip()[:60]}'."
            ) from error
    if not faces:
        raise UserError(f"{path}: expected a mesh of triangles, got {len(vertices)} vertices and 0 faces.")
    last = max(max(face) for face in faces) + 1
    if last > len(vertices):
        raise UserError(f"{path}: expected faces of vertices 1 to {len(vertices)}, got one of vertex {last}.")
    return torch.tensor(vertices, dtype=torch.float64), torch.tensor(faces)


def _vertex(words: list[str]) -> tuple[float, ...]:
    """Read three coordinates; further numbers are a colour or a weight."""
    x, y, z = (float(word) for word in words[:3])
    if not all(math.isfinite(value) for value in (x, y, z)):
        raise ValueError("not finite")
    return x, y, z


def _face(words: list[str], count: int) -> tuple[int, ...]:
    """Return a triangle's vertices from 0; OBJ counts from 1, or from -1 backwards from the last of ``count``."""
    a, b, c = (int(word.split("/")[0]) for word in words)
    if len({word.count("/") for word in words}) > 1:
        raise ValueError("a corner is cut off")  # OBJ has all corners of a face in the same form
    if not all(corner > 0 or -count <= corner < 0 for corner in (a, b, c)):
        raise ValueError("no such vertex")
    return tuple(corner - 1 if corner > 0 else count + corner for corner in (a, b, c))
