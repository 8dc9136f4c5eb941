"""Artemis folders whose files are of the right form and yet do not fit together, or not the format's habits."""

import shutil
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from artemis_animals import HEIGHT, WIDTH, dot_image, ring, write_animal

from rewild4d.contracts import Finding, Selection
from rewild4d.datasets.artemis.files import read_cameras, read_intrinsics, write_intrinsics, write_matrices
from rewild4d.datasets.artemis.reader import Artemis
from rewild4d.datasets.artemis.views import look, strayed
from rewild4d.datasets.images import read_alpha
from rewild4d.errors import UserError
from rewild4d.evaluation.coverage import coverage

pytestmark = pytest.mark.usefixtures("cache")

SWEEP = Selection(cameras="sweep", size=WIDTH)
MATTES = "img/walk/*/img_????_alpha.png"


def change(animal: Path, pattern: str, edit: Callable[[np.ndarray], np.ndarray]) -> None:
    for path in animal.glob(pattern):
        cv2.imwrite(str(path), edit(cv2.imread(str(path), cv2.IMREAD_UNCHANGED)))


def move_cameras(animal: Path, edit: Callable[[np.ndarray], np.ndarray]) -> None:
    write_matrices(animal / "CamPose.inf", edit(read_cameras(animal / "CamPose.inf")))


def enlarge_intrinsics(animal: Path) -> None:
    matrices = read_intrinsics(animal / "Intrinsic.inf", 4)
    matrices[:, :2] *= 10
    write_intrinsics(animal / "Intrinsic.inf", matrices)


def said(animal: Path, level: str) -> list[Finding]:
    return [finding for finding in Artemis(animal).check() if finding.level == level]


OTHER_WORLDS: dict[str, Callable[[Path], None]] = {
    "world to camera": lambda a: move_cameras(a, np.linalg.inv),
    "OpenGL axes": lambda a: move_cameras(a, lambda poses: poses @ np.diag((1.0, -1.0, -1.0, 1.0))),
    "intrinsics of a larger image": enlarge_intrinsics,
}


@pytest.mark.parametrize("fault", OTHER_WORLDS)
def test_cameras_that_look_elsewhere(animal: Path, fault: str) -> None:
    Artemis(animal).load("cat/walk", SWEEP)
    OTHER_WORLDS[fault](animal)
    sentence = (
        r"CamPose\.inf: expected camera-to-world matrices .* \('walk', first frame\) is behind .* in \d of 4 views\."
    )
    with pytest.raises(UserError, match=sentence):
        Artemis(animal).load("cat/walk", SWEEP)
    (error,) = said(animal, "error")
    assert error.path.endswith("CamPose.inf") and "lines of sight" in error.message


def test_one_camera_that_looks_elsewhere_is_named(tmp_path: Path) -> None:
    cameras = ring(9)
    animal = write_animal(tmp_path / "cat", cameras)
    turned = np.array([np.diag((1.0, -1.0, -1.0, 1.0)) if view == 4 else np.eye(4) for view in range(9)])
    move_cameras(animal, lambda poses: poses @ turned)
    Artemis(animal).load("cat/walk", SWEEP)
    assert any("views 4 do not look at the animal" in finding.message for finding in said(animal, "warning"))


def test_lines_of_sight_that_meet_nowhere_tell_nothing() -> None:
    cameras = ring(4)
    looks = [look(dot_image(camera)[1]) for camera in cameras]
    assert strayed(cameras, looks) == []
    assert strayed(cameras, [looks[0], None, None, None]) == []
    assert strayed([cameras[0]] * 4, [looks[0]] * 4) == [], "one camera seen four times"


def test_a_look_is_the_middle_the_box_and_the_border() -> None:
    alpha = np.zeros((4, 6), np.uint8)
    alpha[1:3, 2:5] = 200
    alpha[1, 0] = 1
    found = look(alpha)
    assert found is not None and found.highest == 200 and found.box == (0, 1, 5, 3)
    np.testing.assert_allclose(found.center, ((6 * 200 * 3.5 + 0.5) / 1201, (6 * 200 * 2.0 + 1.5) / 1201))
    assert found.framed == 0 and look(np.zeros((4, 6), np.uint8)) is None
    alpha[0] = 255
    assert getattr(look(alpha), "framed", None) == (6 + 2) / (2 * 6 + 2 * 4)


def test_a_matte_in_the_alpha_channel_is_read_there(animal: Path) -> None:
    before = Artemis(animal).load("cat/walk", SWEEP)[0]
    change(animal, MATTES, lambda alpha: np.dstack((*[np.full_like(alpha, 255)] * 3, alpha)))
    after = Artemis(animal).load("cat/walk", SWEEP)[0]
    assert all(torch.equal(a.mask, b.mask) for a, b in zip(before.frames, after.frames, strict=True))
    assert before.frames[0].mask.mean() < 0.1


def test_mattes_of_any_mode_are_one(tmp_path: Path) -> None:
    matte = np.arange(256, dtype=np.uint8).reshape(16, 16)
    opaque = np.full_like(matte, 255)
    modes = {
        "grey": matte,
        "grey of 16 bits": matte.astype(np.uint16) * 257,
        "colour": np.dstack((matte,) * 3),
        "colour, opaque": np.dstack((matte, matte, matte, opaque)),
        "black with alpha": np.dstack((opaque * 0, opaque * 0, opaque * 0, matte)),
        "alpha of 16 bits": np.dstack((opaque, opaque, opaque, matte)).astype(np.uint16) * 257,
    }
    for name, image in modes.items():
        cv2.imwrite(str(tmp_path / "matte.png"), image)
        assert np.array_equal(read_alpha(tmp_path / "matte.png"), matte), name


def test_mattes_of_zeros_and_ones(animal: Path) -> None:
    change(animal, MATTES, lambda alpha: (alpha > 127).astype(np.uint8))
    with pytest.raises(
        UserError, match=r"0/img_0000_alpha\.png: expected mattes from 0 to 255, but .* all 3 .* at 1\."
    ):
        Artemis(animal).load("cat/walk", SWEEP)
    assert any(
        "they end at 1; are they 0 and 1 in place of 0 and 255?" in error.message for error in said(animal, "error")
    )


def test_mattes_that_are_inverted_or_empty_of_background(animal: Path) -> None:
    sentence = "12 of 12 mattes are animal all along the image's border: are they inverted?"
    change(animal, MATTES, lambda alpha: 255 - alpha)
    assert any(sentence == finding.message for finding in said(animal, "warning"))
    note = "3 of 3 input mattes are animal all along the image's border: are they inverted?"
    assert Artemis(animal).load("cat/walk", SWEEP)[0].notes == (note,)
    change(animal, MATTES, lambda alpha: np.full_like(alpha, 255))
    assert any(sentence == finding.message for finding in said(animal, "warning"))


def test_a_white_animal_on_white(animal: Path) -> None:
    assert not any("white all over" in finding.message for finding in said(animal, "warning"))
    change(animal, "img/walk/*/img_????.png", lambda image: np.full_like(image, 255))
    assert any("white all over" in finding.message for finding in said(animal, "warning"))


def test_voxels_of_another_animal(animal: Path) -> None:
    place = animal / "volumes" / "coords_init.pth"
    near = 0.1 * torch.load(place) + torch.tensor((0.3, -0.2, 0.25))
    torch.save(near, place)
    assert not any("voxels fall" in finding.message for finding in said(animal, "warning"))
    move_cameras(animal, lambda poses: poses[[1, 0, 3, 2]])
    assert any("voxels fall" in finding.message for finding in said(animal, "warning")), "the order of the views"
    move_cameras(animal, lambda poses: poses[[1, 0, 3, 2]])
    torch.save(near + torch.tensor((0.0, 0.6, 0.0)), place)
    (warning,) = [finding for finding in said(animal, "warning") if "voxels fall" in finding.message]
    assert warning.message.startswith("0% of the voxels fall on the mattes of 'walk'")


def test_one_view_holds_nothing_out(tmp_path: Path) -> None:
    animal = write_animal(tmp_path / "cat", ring(1))
    clip, truth = Artemis(animal).load("cat/walk", SWEEP)
    assert clip.notes == ("one view: none is held out, so that no novel view can be scored",)
    assert coverage(clip, truth) == {} and not truth.held_out
    assert any("one view: none is held out" in finding.message for finding in said(animal, "warning"))


def test_enlarged_images_are_told(animal: Path) -> None:
    (note,) = Artemis(animal).load("cat/walk", Selection(cameras="sweep", size=96))[0].notes
    assert note == f"images of {WIDTH} pixels are enlarged to the protocol's 96"
    assert WIDTH > HEIGHT and Artemis(animal).load("cat/walk", SWEEP)[0].notes == ()


@pytest.mark.parametrize(
    ("parents", "sentence"),
    [
        ((-1, 99), r"expected parents from -1 to 1, got 99 of bone 1\."),
        ((-1, -2), r"expected parents from -1 to 1, got -2 of bone 1\."),
        ((-1, 2, 1), r"expected a tree of bones, but bone 1 is its own ancestor\."),
        ((-1, 3, 1, 2), r"expected a tree of bones, but bone 1 is its own ancestor\."),
    ],
)
def test_parents_that_make_no_tree(animal: Path, parents: tuple[int, ...], sentence: str) -> None:
    np.save(animal / "bones" / "bone_parents.npy", np.array(parents))
    with pytest.raises(UserError, match=rf"bone_parents\.npy: {sentence}"):
        Artemis(animal).load("cat/walk", SWEEP)


@pytest.mark.parametrize("parents", [(0, 0), (-1, -1), (1, 1), (255, 0)])
def test_roots_of_any_spelling(animal: Path, parents: tuple[int, ...]) -> None:
    np.save(animal / "bones" / "bone_parents.npy", np.array(parents))
    assert Artemis(animal).load("cat/walk", SWEEP)[1].surface is not None


def test_voxels_that_are_not_numbers(animal: Path) -> None:
    place = animal / "volumes" / "coords_init.pth"
    points = torch.load(place)
    points[5, 1] = float("nan")
    torch.save(points, place)
    with pytest.raises(
        UserError, match=r"coords_init\.pth: expected finite points, got NaN or infinity in 1 of 63 rows"
    ):
        Artemis(animal).load("cat/walk", SWEEP)


def test_what_other_programs_leave(animal: Path) -> None:
    for name in ("CamPose.inf", "Intrinsic.inf", "sequences"):
        place = animal / name
        place.write_bytes(b"\xef\xbb\xbf" + place.read_text().replace("\n", "\r\n").encode())
    (animal / "sequences").write_text("walk\t3\n")
    (animal / "img" / ".cache").mkdir()
    assert Artemis(animal).cases(SWEEP) == ["cat/walk"]
    Artemis(animal).load("cat/walk", SWEEP)
    assert not said(animal, "error")


def test_two_folders_of_one_frame(animal: Path) -> None:
    shutil.copytree(animal / "img/walk/2", animal / "img/walk/002")
    with pytest.raises(UserError, match=r"walk/2: expected one folder of frame 2, but there is 002 too\."):
        Artemis(animal).load("cat/walk", SWEEP)


def test_a_faulty_animal_does_not_stop_the_others(tmp_path: Path) -> None:
    for name in ("cat", "dog", "elk"):
        write_animal(tmp_path / "zoo" / name)
    (tmp_path / "zoo" / "cat" / "CamPose.inf").write_text("1 2 3\n")
    (tmp_path / "zoo" / "cat" / "sequences").write_text("trot\n")
    shutil.rmtree(tmp_path / "zoo" / "dog" / "img")
    zoo = Artemis(tmp_path / "zoo")
    assert zoo.cases(SWEEP) == ["cat/walk", "dog/(unreadable)", "elk/walk"]
    assert len(zoo.load("elk/walk", SWEEP)[0].frames) == 3
    with pytest.raises(UserError, match=r"sequences: expected '<motion> <number of frames>' in line 1, got 'trot'\."):
        zoo.load("cat/walk", SWEEP)
    with pytest.raises(UserError, match=r"img: expected a folder with one folder for each motion, got none\."):
        zoo.load("dog/(unreadable)", SWEEP)
