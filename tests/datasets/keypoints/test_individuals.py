"""Which animal of a keypoint file is taken, how many of its points count, and that both are told."""

import json
from collections.abc import Iterator
from pathlib import Path

import moving
import numpy as np
import pytest

from rewild4d.datasets.keypoints.files import read_keypoints
from rewild4d.datasets.keypoints.individuals import Looks
from rewild4d.datasets.video.online import Online
from rewild4d.errors import UserError
from rewild4d.types import Keypoints

STEMS, SIZE = ("0", "1", "2"), (100, 60)
HEAD = "\n".join(
    f"{name},{','.join(cells)}"
    for name, cells in (
        ("scorer", ["net"] * 6),
        ("individuals", ["a1"] * 3 + ["a2"] * 3),
        ("bodyparts", ["nose"] * 6),
        ("coords", ["x", "y", "likelihood"] * 2),
    )
)


def deeplabcut(path: Path, *rows: str) -> Path:
    """A table of the noses of two animals, a row for each frame: x, y, likelihood of a1 and of a2."""
    path.write_text("\n".join([HEAD, *(f"{i},{row}" for i, row in enumerate(rows))]))
    return path


def noses(found: list[Keypoints | None]) -> list[list[float] | None]:
    """Where the nose of each frame is; None where it is not seen."""
    return [points.points[0].tolist() if points and points.visible[0] else None for points in found]


def around(column: int, row: int) -> Looks:
    """Masks of all frames: a square of 11 pixels around one."""
    mask = np.zeros((SIZE[1], SIZE[0]), np.uint8)
    mask[row - 5 : row + 6, column - 5 : column + 6] = 255

    def looks() -> Iterator[tuple[int, np.ndarray | None]]:
        return ((index, mask) for index in range(len(STEMS)))

    return looks


@pytest.mark.parametrize("first", [",,", "80,5,0.05"])
def test_a_first_individual_that_is_empty_or_unlikely_is_not_the_animal(first: str, tmp_path: Path) -> None:
    file = deeplabcut(tmp_path / "a.csv", *(f"{first},{30 + i},20,0.99" for i in range(3)))
    found, told = read_keypoints(file, STEMS, SIZE)
    assert noses(found) == [[30.5 + i, 20.5] for i in range(3)]
    assert told == "of 2 animals (a1, a2) a2 taken, which has the most likely keypoints"


def test_masks_say_which_of_two_likely_individuals_is_meant(tmp_path: Path) -> None:
    file = deeplabcut(tmp_path / "a.csv", *(f"80,50,0.99,{30 + i},20,0.7" for i in range(3)))
    found, told = read_keypoints(file, STEMS, SIZE, around(30, 20))
    assert noses(found) == [[30.5 + i, 20.5] for i in range(3)]
    assert told == "of 2 animals (a1, a2) a2 taken, because 3 of its 3 keypoints lie in the masks"
    assert noses(read_keypoints(file, STEMS, SIZE, around(80, 50))[0]) == [[80.5, 50.5]] * 3
    with pytest.raises(UserError, match=r"got those of 2 animals \(a1, a2\), none of which lies in the masks\.$"):
        read_keypoints(file, STEMS, SIZE, around(10, 50))


def sleap(path: Path, *rows: str) -> Path:
    path.write_text("\n".join(["track,frame_idx,instance.score,nose.x,nose.y,nose.score", *rows]))
    return path


TWO = [("0", 0.8, 30, 20), ("0", 0.85, 80, 50), ("1", 0.9, 30, 20), ("1", 0.85, 80, 50), ("2", 0.8, 30, 20),
       ("2", 0.85, 80, 50)]  # fmt: skip
"""Frame, score and place of two animals; the one at (30, 20) has the higher score in the second frame only."""


def test_one_track_is_kept_through_the_video(tmp_path: Path) -> None:
    rows = [f"{'t0' if x == 30 else 't1'},{frame},{score},{x},{y},0.9" for frame, score, x, y in TWO]
    found, told = read_keypoints(sleap(tmp_path / "a.csv", *rows), STEMS, SIZE)
    assert noses(found) == [[80.5, 50.5]] * 3  # 3 x 0.85 against 0.8 + 0.9 + 0.8
    assert told.startswith("of 2 animals (t0, t1) t1 taken")
    assert noses(read_keypoints(tmp_path / "a.csv", STEMS, SIZE, around(30, 20))[0]) == [[30.5, 20.5]] * 3


def test_animals_without_a_track_are_tied_to_the_mask_or_told(tmp_path: Path) -> None:
    file = sleap(tmp_path / "a.csv", *(f",{frame},{score},{x},{y},0.9" for frame, score, x, y in TWO))
    found, told = read_keypoints(file, STEMS, SIZE, around(30, 20))
    assert noses(found) == [[30.5, 20.5]] * 3
    assert told == (
        "of several animals in 3 frames the animal of each frame taken, because 3 of its 3 keypoints lie in the masks"
    )
    found, told = read_keypoints(file, STEMS, SIZE)
    assert noses(found) == [[80.5, 50.5], [30.5, 20.5], [80.5, 50.5]]
    assert told == "several animals in 3 frames without a track: the one of highest score taken, which may jump"


def test_a_track_that_broke_in_two_is_one_animal_in_the_masks(tmp_path: Path) -> None:
    rows = ["t0,0,0.9,30,20,0.9", "t1,1,0.9,80,50,0.9", "t2,1,0.2,31,20,0.9", "t2,2,0.2,32,20,0.9"]
    found, told = read_keypoints(sleap(tmp_path / "a.csv", *rows), STEMS, SIZE, around(30, 20))
    assert noses(found) == [[30.5, 20.5], [31.5, 20.5], [32.5, 20.5]]
    assert told.startswith("of 3 animals (t0, t1, t2) t0, t2 taken, because 3 of its 3 keypoints")


def test_points_below_the_limit_are_counted(tmp_path: Path) -> None:
    file = tmp_path / "a.csv"
    file.write_text(
        "scorer,net,net,net,net,net,net\nbodyparts,nose,nose,nose,tail,tail,tail\n"
        "coords,x,y,likelihood,x,y,likelihood\n0,1,2,0.9,3,4,0.59\n1,5,6,0.61,,,\n2,5,600,0.99,7,8,0.1\n"
    )
    found, told = read_keypoints(file, STEMS, SIZE)
    assert [points.visible.tolist() for points in found if points] == [[True, False], [True, False], [False, False]]
    assert told == (
        "2 of 5 keypoints kept, 2 have a score below 0.6; 1 keypoints outside their frame taken as not visible"
    )
    file.write_text(file.read_text().replace("0.9", "0.5").replace("0.61", "0.2"))
    with pytest.raises(UserError, match=r"a\.csv: expected keypoints with a score of 0\.6 or more, got 0\.59 at most"):
        read_keypoints(file, ("0", "1"), SIZE)


def test_sleaps_scores_have_sleaps_own_limit(tmp_path: Path) -> None:
    rows = ["t,0,0.45,30,20,0.42", "t,1,0.45,31,20,0.21", "t,2,0.45,32,20,0.19"]
    found, told = read_keypoints(sleap(tmp_path / "a.csv", *rows), STEMS, SIZE)
    assert noses(found) == [[30.5, 20.5], [31.5, 20.5], None]
    assert told == "2 of 3 keypoints kept, 1 have a score below 0.2"


def test_separators_encodings_and_left_out_columns(tmp_path: Path) -> None:
    file = deeplabcut(tmp_path / "a.csv", *["30.5,20,0.99,,,"] * 3)
    text, right = file.read_text(), [[31.0, 20.5]] * 3
    for data in (
        text.replace(",", ";").replace(".", ",").encode(),
        text.replace(",", "\t").encode(),
        text.encode("utf-16"),
        text.encode("utf-8-sig"),
    ):
        file.write_bytes(data)
        assert noses(read_keypoints(file, STEMS, SIZE)[0]) == right
    file.write_text("frame_idx,nose.x,nose.y\n0,30.5,20\n1,30.5,20\n2,30.5,20\n")
    assert noses(read_keypoints(file, STEMS, SIZE)[0]) == right


def coco(path: Path, **change: object) -> Path:
    """A COCO-like file with one annotation of the image 0."""
    entry = {"image_id": 1, "category_id": 1, "bbox": [1, 1, 20, 20], "keypoints": [30, 20, 2, 50, 20, 0]} | change
    content = {
        "images": [{"id": 1, "file_name": "0.png"}],
        "categories": [{"id": 1, "keypoints": ["nose", "tail"]}],
        "annotations": [{key: value for key, value in entry.items() if value != "none"}],
    }
    path.write_text(json.dumps(content))
    return path


@pytest.mark.parametrize(
    "change",
    [{"bbox": "none"}, {"image_id": "1", "category_id": "1"}, {"keypoints": [30, 20, 2, None, None, 0]},
     {"keypoints": [30, 20, 2, float("nan"), float("nan"), 0]}, {"keypoints": [30, 20, 2, None, 5, 2]}],
)  # fmt: skip
def test_coco_that_other_programs_write(change: dict[str, object], tmp_path: Path) -> None:
    found, _ = read_keypoints(coco(tmp_path / "a.json", **change), STEMS, SIZE)
    assert noses(found) == [[30.5, 20.5], None, None] and found[0] is not None and not found[0].visible[1]


def test_scores_in_place_of_cocos_visibility(tmp_path: Path) -> None:
    found, told = read_keypoints(coco(tmp_path / "a.json", keypoints=[30, 20, 0.31, 50, 20, 0.29]), STEMS, SIZE)
    assert noses(found) == [[30.5, 20.5], None, None] and found[0] is not None and not found[0].visible[1]
    assert told == "1 of 2 keypoints kept, 1 have a score below 0.3"


def test_a_table_of_another_ending_is_a_table(tmp_path: Path) -> None:
    (tmp_path / "a.tsv").write_text("frame_idx\tnose.x\tnose.y\n0\t30\t20\n")
    assert noses(read_keypoints(tmp_path / "a.tsv", STEMS, SIZE)[0]) == [[30.5, 20.5], None, None]


@pytest.mark.parametrize(
    ("name", "data", "message"),
    [
        ("a.h5", b"\x89HDF\r\n\x1a\n" + bytes(100), r"got HDF5: DeepLabCut writes a \.csv beside it"),
        ("a.csv", b"\x89HDF\r\n\x1a\n" + bytes(100), r"got HDF5: DeepLabCut writes a \.csv beside it"),
        ("a.json", b'[{"image_id": 0, "keypoints": [1, 2, 0.9]}]', "a list of COCO results, which names neither"),
        ("a.csv", b"frame_idx,nose.x,nose.y\n0,1,x\n", r"got others \('x' for a number in row 2, nose\.y\)"),
        ("a.csv", b"frame_idx,nose.x,nose.y\n0.5,1,2\n", r"got others \('0\.5' for the number of a frame in row 2\)"),
        ("a.csv", HEAD.replace("y,", "z,").encode(), "got others .no columns x and y of 'a1 nose'"),
        ("a.csv", b"\xff\xfea", "got others .byte 0x61 at position 2 is no UTF-16.* text"),
        ("a.csv", b"time,speed\n1,2\n", r"got others \(a table that begins with 'time,speed'\)"),
        ("a.json", b'{"a": "' + 9999 * b"\xe9" + b'"}', "got others .byte 0xe9 at position 7 is no UTF-8 text"),
        ("a.json", 9999 * b"[", r"it cannot be parsed \(nested too deeply\)"),
        ("a.json", b"[" + 5000 * b"9" + b"]", "it holds a number of more digits than can be read"),
    ],
)
def test_other_files_are_refused_in_one_short_sentence(name: str, data: bytes, message: str, tmp_path: Path) -> None:
    (tmp_path / name).write_bytes(data)
    with pytest.raises(UserError, match=message) as error:
        read_keypoints(tmp_path / name, STEMS, SIZE)
    assert str(tmp_path / name) in str(error.value) and len(str(error.value)) <= 400


def test_each_object_of_a_video_has_the_keypoints_of_its_own_mask(tmp_path: Path, cache: Path) -> None:
    """Two animals in the masks of a video and in the file of keypoints, in another order."""
    moving.frames(tmp_path / "clip" / "frames", count=4)
    for index in range(4):
        mask = np.zeros(moving.SIZE[::-1], np.uint8)
        mask[10:30, 10:30], mask[10:30, 50:70] = 1, 2
        moving.save(tmp_path / "clip" / "masks" / f"{index:05d}.png", mask)
    file = deeplabcut(tmp_path / "a.csv", *["60,20,0.99,20,20,0.99"] * 4)
    reader = Online(tmp_path / "clip", keypoints=file)
    for case, column in (("clip@1", 20.5), ("clip@2", 60.5)):
        video = reader.video(case)
        assert noses([moment.keypoints for moment in video.moments]) == [[column, 20.5]] * 4
        assert any("4 of its 4 keypoints lie in the masks" in note for note in video.notes)
