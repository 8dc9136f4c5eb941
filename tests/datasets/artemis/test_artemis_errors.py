"""Artemis folders that cannot be used: each fault one sentence with the path, what was expected and what came."""

import re
import shutil
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from rewild4d.contracts import Selection
from rewild4d.datasets.artemis.reader import Artemis, ArtemisWriter
from rewild4d.errors import UserError
from rewild4d.transforms import look_at
from rewild4d.types import Camera

pytestmark = pytest.mark.usefixtures("cache")

VIEWS, FRAMES, WIDTH, HEIGHT = 3, 3, 32, 18
SWEEP = Selection(cameras="sweep", size=32)


def writer(folder: Path) -> ArtemisWriter:
    """A writer of a one-boned cube."""
    intrinsics = torch.tensor(((30.0, 0.0, 16.0), (0.0, 30.0, 9.0), (0.0, 0.0, 1.0))).double()
    up, origin = torch.tensor((0.0, 1.0, 0.0)).double(), torch.zeros(3).double()
    eyes = [torch.tensor((3 * np.sin(angle), 1.0, 3 * np.cos(angle))).double() for angle in range(VIEWS)]
    cameras = [Camera(look_at(eye, origin, up), intrinsics, WIDTH, HEIGHT) for eye in eyes]
    cube = np.stack(np.meshgrid((0, 1), (0, 1), (0, 1)), axis=-1).reshape(-1, 3)
    return ArtemisWriter(
        folder, cameras, np.eye(4)[None], np.array((-1,)), cube, np.zeros((8, 1)), np.ones((8, 1)), np.ones(3)
    )


def write_animal(folder: Path) -> Path:
    rgb = np.full((HEIGHT, WIDTH, 3), 90, np.uint8)
    alpha = np.zeros((HEIGHT, WIDTH), np.uint8)
    alpha[4:12, 8:20] = 255
    with writer(folder) as animal:
        animal.motion("walk", np.tile(np.eye(4), (FRAMES, 1, 1, 1)))
        for frame in range(FRAMES):
            for view in range(VIEWS):
                animal.image("walk", frame, view, rgb, alpha)
    return folder


def replace_row(path: Path, row: int, change: Callable[[list[str]], list[str]]) -> None:
    lines = path.read_text().splitlines()
    lines[row] = " ".join(change(lines[row].split()))
    path.write_text("\n".join(lines) + "\n")


def shrink(path: Path) -> None:
    cv2.imwrite(str(path), cv2.resize(cv2.imread(str(path), cv2.IMREAD_UNCHANGED), (16, 9)))


def cut(path: Path) -> None:
    path.write_bytes(path.read_bytes()[:-20])


def damage(path: Path) -> None:
    data = bytearray(path.read_bytes())
    data[data.index(b"IDAT") + 6] ^= 255
    path.write_bytes(bytes(data))


def save(path: Path, value: object) -> None:
    torch.save(value, path)


IMAGE = "img/walk/1/img_0002"
FAULTS: dict[str, tuple[Callable[[Path], object], str]] = {
    "no cameras": (lambda a: (a / "CamPose.inf").unlink(), r"CamPose\.inf: expected a file .* No such file"),
    "empty cameras": (lambda a: (a / "CamPose.inf").write_text("\n"), r"CamPose\.inf: expected one row .* empty file"),
    "shrunken truth": (
        lambda a: torch.save(0.3 * torch.ones(8, 1), a / "volumes" / "volume_weights.pth"),
        r"volume_weights\.pth: expected weights that sum to 1, got 0\.3 at voxel 0\.",
    ),
    "sparse weights": (
        lambda a: torch.save(torch.ones(8, 1).to_sparse(), a / "volumes" / "volume_weights.pth"),
        r"volume_weights\.pth: expected a dense tensor of integers or floats, got torch\.sparse_coo of torch\.float32",
    ),
    "half weights": (
        lambda a: torch.save(torch.ones(8, 1).bfloat16(), a / "volumes" / "volume_weights.pth"),
        r"volume_weights\.pth: expected a dense tensor of integers or floats, got torch\.strided of torch\.bfloat16",
    ),
    "11 numbers": (
        lambda a: replace_row(a / "CamPose.inf", 1, lambda row: row[:-1]),
        r"CamPose\.inf: expected 12 numbers in row 2 \(camera 1\), got 11\.",
    ),
    "nan": (
        lambda a: replace_row(a / "CamPose.inf", 2, lambda row: ["nan", *row[1:]]),
        r"CamPose\.inf, row 3 \(camera 2\): expected finite numbers, got 'nan'\.",
    ),
    "infinite": (
        lambda a: replace_row(a / "CamPose.inf", 0, lambda row: [*row[:11], "inf"]),
        r"CamPose\.inf, row 1 \(camera 0\): expected finite numbers, got 'inf'\.",
    ),
    "a word": (
        lambda a: replace_row(a / "CamPose.inf", 0, lambda row: ["x", *row[1:]]),
        r"row 1 \(camera 0\): expected numbers, got 'x'\.",
    ),
    "scaled rotation": (
        lambda a: replace_row(a / "CamPose.inf", 1, lambda row: [str(1.01 * float(value)) for value in row]),
        r"CamPose\.inf: expected a rotation in row 2 \(camera 1\), got .* determinant 1\.03",
    ),
    "mirrored rotation": (
        lambda a: replace_row(a / "CamPose.inf", 1, lambda row: [str(-float(value)) for value in row]),
        r"expected a rotation in row 2 \(camera 1\), got a matrix with determinant -1",
    ),
    "no intrinsics": (lambda a: (a / "Intrinsic.inf").unlink(), r"Intrinsic\.inf: expected a file .* No such file"),
    "fewer intrinsics": (
        lambda a: (a / "Intrinsic.inf").write_text("".join((a / "Intrinsic.inf").open().readlines()[:10])),
        r"Intrinsic\.inf: expected intrinsics of 3 views .*, got 2\.",
    ),
    "negative focal length": (
        lambda a: replace_row(a / "Intrinsic.inf", 1, lambda row: ["-30", *row[1:]]),
        r"Intrinsic\.inf: expected .* positive focal lengths for view 0, got -30 0 15\.5",
    ),
    "singular intrinsics": (
        lambda a: replace_row(a / "Intrinsic.inf", 3, lambda row: ["0", "0", "0"]),
        r"Intrinsic\.inf: expected 'fx 0 cx / 0 fy cy / 0 0 1' .* view 0",
    ),
    "torn intrinsics": (
        lambda a: replace_row(a / "Intrinsic.inf", 2, lambda row: row[:2]),
        r"Intrinsic\.inf: expected an index or 3 numbers in line 3, got 2 numbers\.",
    ),
    "more views than cameras": (
        lambda a: shutil.copy(a / f"{IMAGE}.png", a / "img/walk/1/img_0003.png"),
        r"img/walk/1: expected images of 3 views .*, got view 3\.",
    ),
    "frame folder missing": (
        lambda a: shutil.rmtree(a / "img/walk/1"),
        r"img/walk: expected frame folders 0 to 2 without a gap, but folder 1 is missing\.",
    ),
    "no frames": (
        lambda a: [shutil.rmtree(path) for path in (a / "img/walk").iterdir()],
        r"img/walk: expected frame folders 0, 1, 2, \.\.\., got none\.",
    ),
    "no motions": (lambda a: shutil.rmtree(a / "img/walk"), r"/img: expected one folder for each motion, got none\."),
    "no images": (lambda a: shutil.rmtree(a / "img"), r"/img: expected a folder .* for each motion, got none\."),
    "sequences count": (
        lambda a: (a / "sequences").write_text("walk 7\n"),
        r"sequences: expected 3 frames of 'walk' as .*img/walk has, got 7\.",
    ),
    "sequences names": (
        lambda a: (a / "sequences").write_text("walk 3\nrun 3\n"),
        r"sequences: expected the motions that have a folder in .*img \(walk\), got walk, run\.",
    ),
    "sequences form": (
        lambda a: (a / "sequences").write_text("walk\n"),
        r"sequences: expected '<motion> <number of frames>' in line 1, got 'walk'\.",
    ),
    "sequences superscript": (
        lambda a: (a / "sequences").write_text("walk ³\n"),
        r"sequences: expected '<motion> <number of frames>' in line 1, got 'walk ³'\.",
    ),
    "frame superscript": (
        lambda a: (a / "img/walk/1").rename(a / "img/walk/¹"),
        r"img/walk: expected frame folders 0 to 2 without a gap, but folder 1 is missing\.",
    ),
    "link to nothing": (
        lambda a: [(a / f"{IMAGE}_alpha.png").unlink(), (a / f"{IMAGE}_alpha.png").symlink_to(a / "none")],
        r"img/walk/1/img_0002_alpha\.png: expected an? (file|image) that can be read, but: No such file or directory\.",
    ),
    "view missing": (
        lambda a: (a / f"{IMAGE}.png").unlink(),
        r"img/walk/1/img_0002\.png: expected an image \(png or jpg\) of view 2, got none\.",
    ),
    "matte missing": (
        lambda a: (a / f"{IMAGE}_alpha.png").unlink(),
        r"img_0002_alpha\.png: expected the matte of img_0002\.png, got none\.",
    ),
    "truncated png": (
        lambda a: cut(a / f"{IMAGE}.png"),
        r"img_0002\.png: expected a whole image, got a PNG that is cut off after \d+ bytes\.",
    ),
    "truncated matte": (lambda a: cut(a / f"{IMAGE}_alpha.png"), r"img_0002_alpha\.png: .* cut off after"),
    "damaged png": (lambda a: damage(a / f"{IMAGE}.png"), r"img_0002\.png: .* a PNG with a damaged IDAT chunk\."),
    "empty image": (lambda a: (a / f"{IMAGE}.png").write_bytes(b""), r"img_0002\.png: .* got an empty file\."),
    "text as image": (
        lambda a: (a / f"{IMAGE}.png").write_bytes(b"hello"),
        r"img_0002\.png: .* got a file that is neither PNG nor JPEG\.",
    ),
    "matte of another size": (
        lambda a: shrink(a / f"{IMAGE}_alpha.png"),
        r"img_0002_alpha\.png: expected 32x18 pixels like img_0002\.png, got 16x9\.",
    ),
    "image of another size": (
        lambda a: shrink(a / f"{IMAGE}.png"),
        r"img_0002\.png: expected 32x18 pixels like the other images, got 16x9\.",
    ),
    "bones of a frame missing": (
        lambda a: (a / "bones/walk/Bones_0001.inf").unlink(),
        r"bones/walk/Bones_0001\.inf: expected a file .* No such file",
    ),
    "rest bones missing": (
        lambda a: (a / "bones/Bones_0000.inf").unlink(),
        r"bones/Bones_0000\.inf: expected a file .* No such file",
    ),
    "bones of a frame too many": (
        lambda a: replace_row(a / "bones/walk/Bones_0001.inf", 0, lambda row: [*row, "\n", *row]),
        r"bones/walk/Bones_0001\.inf: expected 1 bones as in the rest pose, got 2\.",
    ),
    "bones and parents": (
        lambda a: np.save(a / "bones/bone_parents.npy", np.array((-1, 0))),
        r"Bones_0000\.inf: expected 2 bones \(one for each parent listed\), got 1\.",
    ),
    "parents missing": (
        lambda a: (a / "bones/bone_parents.npy").unlink(),
        r"/bones: expected bone_parents\.npy or bones_parents\.npy, got neither\.",
    ),
    "parents of floats": (
        lambda a: np.save(a / "bones/bone_parents.npy", np.zeros(1)),
        r"bone_parents\.npy: expected a vector of integers, got float64 of shape \(1,\)\.",
    ),
    "singular bone": (
        lambda a: replace_row(a / "bones/Bones_0000.inf", 0, lambda row: ["0"] * 12),
        r"Bones_0000\.inf: expected matrices that can be inverted, got a singular one in row 1\.",
    ),
    "weights out of range": (
        lambda a: save(a / "volumes/volume_indices.pth", torch.full((8, 1), 5)),
        r"volume_indices\.pth: expected bones 0 to 0, got index 5\.",
    ),
    "weights of another shape": (
        lambda a: save(a / "volumes/volume_weights.pth", torch.ones(8, 2)),
        r"volume_weights\.pth: expected finite weights \(8, 1\), got shape \(8, 2\)\.",
    ),
    "voxels off the lattice": (
        lambda a: save(
            a / "volumes/coords_init.pth", torch.tensor([[0, 0, 0], [1, 0, 0], [2.3, 0, 0]] + [[3, 1, 1]] * 5)
        ),
        r"coords_init\.pth: expected voxel centres on a lattice, got one 0\.47 cells off\.",
    ),
    "a torn tensor": (
        lambda a: cut(a / "volumes/coords_init.pth"),
        r"coords_init\.pth: expected a saved torch tensor, but it is cut off or another file\.",
    ),
    "half a volume": (
        lambda a: (a / "volumes/volume_indices.pth").unlink(),
        r"volume_indices\.pth: expected a saved torch tensor, but there is no such file",
    ),
}


@pytest.fixture
def animal(tmp_path: Path) -> Path:
    return write_animal(tmp_path / "cat")


@pytest.mark.parametrize("fault", FAULTS)
def test_a_fault_is_one_sentence_and_check_finds_it(animal: Path, cache: Path, fault: str) -> None:
    spoil, sentence = FAULTS[fault]
    spoil(animal)
    with pytest.raises(UserError, match=sentence) as caught:
        Artemis(animal).load("cat/walk", SWEEP)
    assert str(caught.value).startswith(str(animal)) and "\n" not in str(caught.value)
    assert not list(cache.rglob("rgba.npy")) and not list(cache.rglob(".*"))
    errors = [finding for finding in Artemis(animal).check() if finding.level == "error"]
    assert len({(error.path, error.message) for error in errors}) == len(errors), "each fault once"
    assert any(re.search(sentence.removesuffix(r"\."), f"{error.path}: {error.message}") for error in errors)


def test_empty_matte_of_an_input_image(animal: Path) -> None:
    """View 1 is the input at frame 1; an empty matte elsewhere is held out and only worth a warning."""
    for frame, view in ((1, 1), (1, 2)):
        cv2.imwrite(str(animal / f"img/walk/{frame}/img_{view:04d}_alpha.png"), np.zeros((HEIGHT, WIDTH), np.uint8))
    with pytest.raises(UserError, match=r"1/img_0001_alpha\.png: expected a matte with an animal in it, got an empty"):
        Artemis(animal).load("cat/walk", SWEEP)
    warned = [finding.path for finding in Artemis(animal).check() if "matte is empty" in finding.message]
    assert warned == [str(animal / f"img/walk/1/img_{view:04d}_alpha.png") for view in (1, 2)]
    fixed = Selection("fixed", 32, framing="crop")
    assert not Artemis(animal).load("cat/walk", fixed)[1].held_out[3].mask.any()


def test_a_motion_without_any_animal_is_an_error(animal: Path) -> None:
    for path in animal.glob("img/walk/*/*_alpha.png"):
        cv2.imwrite(str(path), np.zeros((HEIGHT, WIDTH), np.uint8))
    errors = [(finding.path, finding.message) for finding in Artemis(animal).check() if finding.level == "error"]
    assert errors == [(str(animal / "img" / "walk"), "no matte shows an animal that could be an input")]


def test_no_such_folder_and_not_an_animal(tmp_path: Path) -> None:
    with pytest.raises(UserError, match=r"nowhere: expected an animal's folder or a folder of animals, got no such"):
        Artemis(tmp_path / "nowhere")
    (tmp_path / "zoo" / "notes").mkdir(parents=True)
    with pytest.raises(UserError, match=r"zoo/CamPose\.inf: expected this file of an animal's folder"):
        Artemis(tmp_path / "zoo")


def test_unknown_case_suggests_the_nearest(animal: Path) -> None:
    with pytest.raises(UserError, match=r"unknown case 'cat/wlak'\. Did you mean 'cat/walk'\? Available: cat/walk\."):
        Artemis(animal).load("cat/wlak", SWEEP)


def test_placements_need_the_voxels(animal: Path) -> None:
    shutil.rmtree(animal / "volumes")
    with pytest.raises(UserError, match=r"volumes: expected the animal's voxels, which tell its side, got none\."):
        Artemis(animal).load("cat/walk@side", Selection("fixed", 32, placements=("side",)))


def test_check_names_all_faults_at_once(animal: Path) -> None:
    for fault in ("truncated png", "matte missing", "negative focal length", "bones of a frame missing"):
        FAULTS[fault][0](animal)
    (animal / "img/walk/0/img_0000_alpha.png").write_bytes(b"")
    paths = {Path(finding.path).name for finding in Artemis(animal).check() if finding.level == "error"}
    assert paths == {"Intrinsic.inf", "Bones_0001.inf", "img_0002_alpha.png", "img_0000_alpha.png"}
    assert all(finding.level != "ok" for finding in Artemis(animal).check())


def test_check_warns_of_resized_images(animal: Path) -> None:
    for path in animal.glob("img/walk/*/*.png"):
        shrink(path)
    (warning,) = [finding for finding in Artemis(animal).check() if finding.path.endswith("Intrinsic.inf")]
    assert warning.level == "warning" and "16x9 image: were the images resized?" in warning.message


def test_writer_leaves_nothing_behind(tmp_path: Path) -> None:
    with pytest.raises(RuntimeError, match="stop"), writer(tmp_path / "cat") as animal:
        animal.motion("walk", np.eye(4)[None, None])
        raise RuntimeError("stop")
    with (
        pytest.raises(ValueError, match="no image of motion walk, frame 0, view 0"),
        writer(tmp_path / "cat") as animal,
    ):
        animal.motion("walk", np.eye(4)[None, None])
    assert list(tmp_path.iterdir()) == []


def test_writer_refuses_a_folder_with_files(animal: Path) -> None:
    before = sorted(animal.rglob("*"))
    with pytest.raises(UserError, match=r"cat: expected a new or an empty folder, got one that holds files\."):
        write_animal(animal)
    assert sorted(animal.rglob("*")) == before


def test_writer_refuses_a_place_under_a_file(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(UserError, match=r"file/cat: expected a folder that can be written, but: "):
        write_animal(tmp_path / "file" / "cat")
