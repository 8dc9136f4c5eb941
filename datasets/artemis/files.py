"""The text files and folders of one animal in the Artemis / DFA format, read and written.

Every matrix row (CamPose.inf, Bones_*.inf) holds 12 numbers: the columns of a 3x4 matrix in the order third, first,
second, fourth. Camera rows are camera-to-world with OpenCV axes, bone rows are global bone-to-world. Intrinsics are in
pixels of the full image with integer pixel centres; the package's cameras have centres at +0.5 (design: formats, 1).
"""

import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from rewild4d.datasets.images import ImagePair
from rewild4d.errors import UserError, shown
from rewild4d.foreign.reading import read_array

IMAGE_SUFFIXES = (".png", ".jpg", ".jpeg")
PARENTS_FILES = ("bone_parents.npy", "bones_parents.npy")
LICENCE_FILES = ("LICENSE", "LICENCE", "LICENSE.txt", "LICENCE.txt", "license.txt", "licence.txt")
NO_LICENCE = "no licence file with the data; do not redistribute"
_COLUMNS = (2, 0, 1, 3)
LARGEST = 1e15
"""Of numbers in text files: differences of larger ones are lost in rounding, and their products overflow."""
MOST_DIGITS = 9
"""Of a number of frames."""


def read_matrices(path: Path, what: str) -> np.ndarray:
    """Return matrices of a CamPose or Bones file, float64, [n, 4, 4].

    Args:
        path: the file.
        what: what a row stands for ("camera", "bone"), for messages.

    Raises:
        UserError: no such file, no rows, or a row that is not 12 finite numbers.
    """
    rows = [line for line in _lines(path) if line.strip()]
    if not rows:
        raise UserError(f"{path}: expected one row of 12 numbers for each {what}, got an empty file.")
    matrices = np.tile(np.eye(4), (len(rows), 1, 1))
    for index, line in enumerate(rows):
        values = _numbers(line, f"{path}, row {index + 1} ({what} {index})")
        if len(values) != 12:
            raise UserError(f"{path}: expected 12 numbers in row {index + 1} ({what} {index}), got {len(values)}.")
        matrices[index][:3, _COLUMNS] = np.reshape(values, (4, 3)).T
    return matrices


def write_matrices(path: Path, matrices: np.ndarray) -> None:
    """Write [n, 4, 4] matrices as rows of 12 numbers, third-first-second-fourth column."""
    rows = np.asarray(matrices, dtype=np.float64)[:, :3, _COLUMNS].transpose(0, 2, 1).reshape(-1, 12)
    path.write_text("".join(" ".join(f"{value:.12g}" for value in row) + "\n" for row in rows), encoding="utf-8")


def read_cameras(path: Path) -> np.ndarray:
    """Return camera-to-world matrices of CamPose.inf, [V, 4, 4].

    Raises:
        UserError: as `read_matrices`, or a rotation that is not one (orthonormal to 1e-3 with determinant +1).
    """
    cameras = read_matrices(path, "camera")
    for index, rotation in enumerate(cameras[:, :3, :3]):
        error = np.abs(rotation @ rotation.T - np.eye(3)).max()
        determinant = np.linalg.det(rotation)
        if error > 1e-3 or determinant < 0:
            raise UserError(
                f"{path}: expected a rotation in row {index + 1} (camera {index}), "
                f"got a matrix with determinant {determinant:.4g} that is {error:.2g} away from orthonormal."
            )
    return cameras


def read_intrinsics(path: Path, views: int) -> np.ndarray:
    """Return intrinsics of every view with pixel centres at +0.5, float64, [V, 3, 3].

    Raises:
        UserError: no such file, a block that is not a pinhole matrix, or not one block a view.
    """
    rows = []
    for number, line in enumerate(_lines(path), start=1):
        values = _numbers(line, f"{path}, line {number}")
        if len(values) == 3:
            rows.append(values)
        elif len(values) > 1:
            raise UserError(f"{path}: expected an index or 3 numbers in line {number}, got {len(values)} numbers.")
    if len(rows) != 3 * views:
        raise UserError(
            f"{path}: expected intrinsics of {views} views (the rows of CamPose.inf), got {len(rows) / 3:.3g}."
        )
    intrinsics = np.reshape(rows, (views, 3, 3))
    for index, matrix in enumerate(intrinsics):
        pinhole = np.array([[matrix[0, 0], 0, matrix[0, 2]], [0, matrix[1, 1], matrix[1, 2]], [0, 0, 1]])
        if matrix[0, 0] <= 0 or matrix[1, 1] <= 0 or np.abs(matrix - pinhole).max() > 1e-6:
            raise UserError(
                f"{path}: expected 'fx 0 cx / 0 fy cy / 0 0 1' with positive focal lengths for view {index}, "
                f"got {' / '.join(' '.join(f'{value:g}' for value in row) for row in matrix)}."
            )
    intrinsics[:, :2, 2] += 0.5
    return intrinsics


def write_intrinsics(path: Path, intrinsics: np.ndarray) -> None:
    """Write [V, 3, 3] intrinsics that have pixel centres at +0.5."""
    centred = np.array(intrinsics, dtype=np.float64)
    centred[:, :2, 2] -= 0.5
    blocks = []
    for index, matrix in enumerate(centred):
        blocks.append(f"{index}\n" + "".join(" ".join(f"{value:.12g}" for value in row) + "\n" for row in matrix))
    path.write_text("\n".join(blocks) + "\n", encoding="utf-8")


def read_parents(folder: Path) -> np.ndarray:
    """Return the parent of each bone, the root's as it stands (readers ignore it), int64, [J], from either file name.

    Raises:
        UserError: no such file, or not a vector of integers.
    """
    path = next((folder / name for name in PARENTS_FILES if (folder / name).is_file()), None)
    if path is None:
        raise UserError(f"{folder}: expected {' or '.join(PARENTS_FILES)}, got neither.")
    parents = read_array(path, "a NumPy file of integers")
    if parents.ndim != 1 or not np.issubdtype(parents.dtype, np.integer):
        raise UserError(f"{path}: expected a vector of integers, got {parents.dtype} of shape {parents.shape}.")
    _expect_tree(path, parents)
    return parents.astype(np.int64)


def _expect_tree(path: Path, parents: np.ndarray) -> None:
    """Fail on a missing parent or on a cycle; row 0 is a root whatever it says, others have -1 or their own number."""
    for bone in range(1, len(parents)):
        if not -1 <= parents[bone] < len(parents):
            raise UserError(
                f"{path}: expected parents from -1 to {len(parents) - 1}, got {parents[bone]} of bone {bone}."
            )
        line = [bone]
        while line[-1] > 0 and (above := int(parents[line[-1]])) not in (-1, line[-1]):
            if above in line:
                raise UserError(f"{path}: expected a tree of bones, but bone {above} is its own ancestor.")
            line.append(above)


def read_sequences(path: Path) -> dict[str, int]:
    """Return motions and their frame counts, from lines "<motion> <n_frames>"; `UserError` for another line."""
    motions: dict[str, int] = {}
    for number, line in enumerate(_lines(path), start=1):
        if not line.strip():
            continue
        words = line.strip().rsplit(maxsplit=1)
        if len(words) != 2 or not words[1].isdecimal() or len(words[1]) > MOST_DIGITS:
            raise UserError(
                f"{path}: expected '<motion> <number of frames>' in line {number}, got '{shown(line.strip())}'."
            )
        motions[words[0]] = int(words[1])
    return motions


def list_motions(animal: Path) -> dict[str, int]:
    """Return an animal's motions and their frame counts: the folders under img/, checked against `sequences` if there.

    Raises:
        UserError: no motions, a gap in the numbering of the frames, or folders and `sequences` that disagree.
    """
    images = animal / "img"
    if not images.is_dir():
        raise UserError(f"{images}: expected a folder with one folder for each motion, got none.")
    found = {motion.name: len(list_frames(motion)) for motion in motion_folders(animal)}
    if not found:
        raise UserError(f"{images}: expected one folder for each motion, got none.")
    listing = animal / "sequences"
    if not listing.is_file():
        return found
    listed = read_sequences(listing)
    if set(listed) != set(found):
        raise UserError(
            f"{listing}: expected the motions that have a folder in {images} ({', '.join(found)}), "
            f"got {', '.join(listed) or 'none'}."
        )
    for motion, count in listed.items():
        if count != found[motion]:
            raise UserError(
                f"{listing}: expected {found[motion]} frames of '{motion}' as {images / motion} has, got {count}."
            )
    return listed


def motion_folders(animal: Path) -> list[Path]:
    """Return folders under img/ but those that a program hid there with a dot; none where there is no img/."""
    images = animal / "img"
    found = images.iterdir() if images.is_dir() else ()
    return sorted(path for path in found if path.is_dir() and not path.name.startswith("."))


def list_frames(motion: Path) -> list[Path]:
    """Return the frame folders of a motion in the order of their numbers 0, 1, 2, ...

    Raises:
        UserError: no frame folders, one is missing, or two have one number.
    """
    frames: dict[int, Path] = {}
    for path in sorted(motion.iterdir()):
        if path.name.isdecimal() and path.is_dir():
            if (number := int(path.name)) in frames:
                raise UserError(
                    f"{path}: expected one folder of frame {number}, but there is {frames[number].name} too."
                )
            frames[number] = path
    if not frames:
        raise UserError(f"{motion}: expected frame folders 0, 1, 2, ..., got none.")
    missing = next(number for number in range(len(frames) + 1) if number not in frames)
    if missing < len(frames):
        last = shown(max(frames))
        raise UserError(f"{motion}: expected frame folders 0 to {last} without a gap, but folder {missing} is missing.")
    return [frames[number] for number in range(len(frames))]


def list_images(frame: Path, views: int) -> list[ImagePair]:
    """Return the image and matte files of every view of one frame folder.

    Raises:
        UserError: a view or a matte is missing, or there are images of more views than cameras.
    """
    names = {path.name.lower(): path for path in frame.iterdir()}
    pairs = []
    for view in range(views):
        stem = f"img_{view:04d}"
        rgb = next((names[stem + suffix] for suffix in IMAGE_SUFFIXES if stem + suffix in names), None)
        if rgb is None:
            raise UserError(f"{frame / stem}.png: expected an image (png or jpg) of view {view}, got none.")
        alpha = names.get(f"{stem}_alpha.png")
        if alpha is None:
            raise UserError(f"{frame / stem}_alpha.png: expected the matte of {rgb.name}, got none.")
        pairs.append(ImagePair(rgb, alpha))
    extra = sorted(int(match[1]) for name in names if (match := re.fullmatch(r"img_(\d+)\.\w+", name)))
    if extra[-1] >= views:
        raise UserError(f"{frame}: expected images of {views} views (the rows of CamPose.inf), got view {extra[-1]}.")
    return pairs


def frames_per_second(motion: str) -> float:
    """Return the frame rate that a name such as "s1_24fps" says, else 30."""
    match = re.search(r"_(\d+(?:\.\d+)?)fps$", motion, re.IGNORECASE)
    return float(match[1]) if match and float(match[1]) > 0 else 30.0


def read_licence(animal: Path) -> str:
    """Return the first line of the animal's licence file, or a sentence that says there is none."""
    for name in LICENCE_FILES:
        if (animal / name).is_file():
            lines = (line.strip() for line in _lines(animal / name))
            return next((line for line in lines if line), NO_LICENCE)
    return NO_LICENCE


def _lines(path: Path) -> Sequence[str]:
    try:
        return path.read_text(encoding="utf-8-sig", errors="replace").splitlines()
    except OSError as error:
        raise UserError(f"{path}: expected a file that can be read, but: {error.strerror}.") from error


def _numbers(line: str, where: str) -> list[float]:
    """Return the finite numbers of a line."""
    values = []
    for token in line.split():
        try:
            value = float(token)
        except ValueError:
            raise UserError(f"{where}: expected numbers, got '{shown(token)}'.") from None
        if not np.isfinite(value):
            raise UserError(f"{where}: expected finite numbers, got '{shown(token)}'.")
        if abs(value) > LARGEST:
            raise UserError(f"{where}: expected numbers up to {LARGEST:g}, got '{shown(token)}'.")
        values.append(value)
    return values
