"""Keypoint files of several programs: which point of which frame a number is about."""

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import moving
import pytest

from rewild4d.datasets.keypoints.files import read_keypoints
from rewild4d.datasets.keypoints.keypoints import read_badja
from rewild4d.datasets.video.davis import Davis
from rewild4d.errors import UserError

STEMS = ("00000", "00005", "00010")


def write_coco(path: Path, *changes: dict[str, Any], names: Sequence[str] = ("nose", "neck")) -> Path:
    """A COCO-like file with an annotation of the image 00010 for each of some changes to a right one."""
    right = {"image_id": 7, "category_id": 1, "bbox": [0, 0, 9, 9], "keypoints": [1, 1, 2, 2, 2, 2]}
    content = {
        "images": [{"id": 7, "file_name": "easy/cat/00010.jpg"}],
        "categories": [{"id": 1, "keypoints": names}, {"id": 2}],
        "annotations": [{"id": 50 + i} | right | change for i, change in enumerate(changes)],
    }
    path.write_text(json.dumps(content))
    return path


def write_badja(path: Path, *changes: dict[str, Any]) -> Path:
    """A BADJA file of frames 00000, 00005, ... with an entry for each of some changes to a right one."""
    right = {"joints": [[540, 960]] * 37, "visibility": [True] * 37}
    path.write_text(json.dumps([{"image_path": f"{5 * i:05d}.jpg"} | right | c for i, c in enumerate(changes)]))
    return path


def test_badja_is_row_column_at_its_own_size(tmp_path: Path) -> None:
    entry = {"image_path": "DAVIS/x/00005.jpg", "joints": [[540, 960], [0, 0], [5000, 3]], "visibility": [1, 0, 1]}
    (tmp_path / "a.json").write_text(json.dumps([entry]))
    found, told = read_keypoints(tmp_path / "a.json", STEMS, (960, 540))
    assert found[0] is None and found[2] is None and found[1] is not None
    assert found[1].points[0].tolist() == [960.5 / 2, 540.5 / 2]
    # the third joint lies below the frame
    assert found[1].visible.tolist() == [True, False, False]
    assert told == "1 keypoints outside their frame taken as not visible"


def test_of_several_coco_animals_the_largest_box_counts(tmp_path: Path) -> None:
    write_coco(tmp_path / "a.json", {"bbox": [0, 0, 5, 5]}, {"keypoints": [3, 4, 2, 0, 0, 0]})
    found = read_keypoints(tmp_path / "a.json", STEMS, (20, 20))[0][2]
    assert found is not None and found.names == ("nose", "neck")
    assert found.points[0].tolist() == [3.5, 4.5] and found.visible.tolist() == [True, False]


def test_deeplabcut_rows_count_frames_or_name_images(tmp_path: Path) -> None:
    (tmp_path / "a.csv").write_text(
        "scorer,net,net,net,net,net,net\nbodyparts,nose,nose,nose,paw,paw,paw\n"
        "coords,x,y,likelihood,x,y,likelihood\n0,1,2,0.9,3,4,0.2\n2,5,6,0.7,7,8,0.99\n"
    )
    found, _ = read_keypoints(tmp_path / "a.csv", STEMS, (20, 20))
    assert found[1] is None and found[0] is not None and found[2] is not None
    assert found[0].visible.tolist() == [True, False] and found[2].points[1].tolist() == [7.5, 8.5]
    (tmp_path / "b.csv").write_text(
        "scorer,,,me,me\nbodyparts,,,nose,nose\ncoords,,,x,y\nlabeled-data,clip,00005.png,1,2\n"
    )
    labelled = read_keypoints(tmp_path / "b.csv", STEMS, (20, 20))[0][1]
    assert labelled is not None and labelled.points.tolist() == [[1.5, 2.5]]


def test_sleap_takes_the_best_instance_of_a_frame(tmp_path: Path) -> None:
    (tmp_path / "a.csv").write_text(
        "track,frame_idx,instance.score,nose.x,nose.y,nose.score\n"
        "t0,1,0.3,1,1,0.9\nt1,1,0.8,2,2,0.9\nt0,2,0.5,,,\n"
    )  # fmt: skip
    found, _ = read_keypoints(tmp_path / "a.csv", STEMS, (20, 20))
    assert found[1] is not None and found[1].points.tolist() == [[2.5, 2.5]]
    assert found[2] is not None and not found[2].visible.any()


@pytest.mark.parametrize(
    ("name", "text", "message"),
    [
        ("a.json", "{", "expected keypoints as BADJA, COCO, DeepLabCut or SLEAP write them"),
        ("a.json", '{"images": []}', "expected keypoints as BADJA, COCO, DeepLabCut or SLEAP write them"),
        ("a.csv", "scorer," + 200000 * "a" + "\n", "expected keypoints as BADJA, .* got others .*field larger than"),
        ("a.json", 100000 * "[", "expected keypoints as BADJA, COCO, DeepLabCut or SLEAP write them"),
        ("a.csv", "x,y\n1,2\n", "expected keypoints as BADJA, COCO, DeepLabCut or SLEAP write them"),
        ("a.json", '[{"image_path": "q.jpg", "joints": [[1, 1]], "visibility": [1]}]', "got those of q"),
    ],
)
def test_a_broken_keypoint_file_is_one_sentence(tmp_path: Path, name: str, text: str, message: str) -> None:
    (tmp_path / name).write_text(text)
    with pytest.raises(UserError, match=message):
        read_keypoints(tmp_path / name, STEMS, (20, 20))


@pytest.mark.parametrize("stems", [("1", "2", "3"), ("00001", "00002", "00003"), ("a", "b", "c")])
def test_a_bare_number_counts_frames_whatever_they_are_called(stems: tuple[str, ...], tmp_path: Path) -> None:
    (tmp_path / "d.csv").write_text("scorer,net,net\nbodyparts,nose,nose\ncoords,x,y\n0,10,0\n1.0,11,0\n2,12,0\n")
    (tmp_path / "s.csv").write_text("frame_idx,instance.score,nose.x,nose.y\n0,1,10,0\n1,1,11,0\n2,1,12,0\n")
    for name in ("d.csv", "s.csv"):
        found, _ = read_keypoints(tmp_path / name, stems, (20, 20))
        assert [points and points.points[0, 0].item() for points in found] == [10.5, 11.5, 12.5]


def test_a_number_with_an_ending_or_a_folder_is_a_name(tmp_path: Path) -> None:
    head = "scorer,,,me,me\nbodyparts,,,nose,nose\ncoords,,,x,y\n"
    (tmp_path / "d.csv").write_text(head + "labeled-data,clip,2.png,10,0\nlabeled-data,clip,3,11,0\n")
    found, _ = read_keypoints(tmp_path / "d.csv", ("1", "2", "3"), (20, 20))
    assert [points and points.points[0, 0].item() for points in found] == [None, 10.5, 11.5]


def test_a_number_beyond_the_frames_is_no_name(tmp_path: Path) -> None:
    (tmp_path / "s.csv").write_text("frame_idx,instance.score,nose.x,nose.y\n3,1,10,0\n")
    with pytest.raises(UserError, match="expected keypoints of the frames 1 to 3, got those of number 3"):
        read_keypoints(tmp_path / "s.csv", ("1", "2", "3"), (20, 20))


def test_a_file_without_points_is_one_sentence(tmp_path: Path) -> None:
    badja = write_badja(tmp_path / "b.json", {"joints": [], "visibility": []})
    coco = write_coco(tmp_path / "c.json", {"keypoints": []}, names=())
    sleap, empty = tmp_path / "s.csv", tmp_path / "e.json"
    sleap.write_text("frame_idx,instance.score\n0,1\n1,1\n")
    empty.write_text("[]")
    for path, reason in (
        (
            badja,
            ': 1 of 1 annotations have no joints and are left out; the first (image_path "00000.jpg") has joints []',
        ),
        (coco, ": 1 of 1 annotations name a category without names of keypoints and are left out; the first (id 50)"),
        (sleap, "."),
        (empty, "."),
    ):
        with pytest.raises(UserError) as error:
            read_keypoints(path, STEMS, (20, 20))
        assert f"{path}: expected keypoints of the frames 00000 to 00010, got none{reason}" in str(error.value)


COCO_FAULTS: list[tuple[dict[str, Any], str, str]] = [
    ({"image_id": 99}, "name an image that is not listed", "image_id 99"),
    ({"image_id": None}, "name an image that is not listed", "image_id null"),
    ({"category_id": 2}, "name a category without names of keypoints", "category_id 2"),
    ({"bbox": None}, "have no bbox of four numbers", "bbox null"),
    ({"bbox": [1, 1, 0, 5]}, "have an empty bbox", "bbox [1, 1, 0, 5]"),
    ({"keypoints": [1, 2]}, "have other keypoints than 6 numbers", "keypoints [1, 2]"),
    ({"keypoints": [10**400, 2, 2, 1, 1, 1]}, "have other keypoints than 6 numbers", "keypoints [10"),
]


@pytest.mark.parametrize(("change", "what", "got"), COCO_FAULTS)
def test_one_wrong_coco_annotation_is_left_out_and_told(
    change: dict[str, Any], what: str, got: str, tmp_path: Path
) -> None:
    found, told = read_keypoints(write_coco(tmp_path / "a.json", {}, change), STEMS, (20, 20))
    assert found[2] is not None and found[2].visible.all()
    wanted = f"a.json: 1 of 2 annotations {what} and are left out; the first (id 51) has {got}"
    assert told.startswith(wanted)
    with pytest.raises(UserError) as error:
        read_keypoints(write_coco(tmp_path / "b.json", change, change), STEMS, (20, 20))
    assert f"got none: 2 of 2 annotations {what} and are left out; the first (id 50) has {got}" in str(error.value)


BADJA_FAULTS: list[tuple[dict[str, Any], str, str]] = [
    ({"joints": []}, "have no joints", "joints []"),
    ({"visibility": [1]}, "have no visibility for each joint", "visibility [1]"),
    ({"joints": [[1, 1], None] + [[1, 1]] * 35}, "have a joint that is no pair of numbers", "joint 1 null"),
    ({"joints": [[1, 10**400]] * 37}, "have a joint that is no pair of numbers", "joint 0 [1, 10"),
]


@pytest.mark.parametrize(("change", "what", "got"), BADJA_FAULTS)
def test_one_wrong_badja_entry_is_left_out_and_told(
    change: dict[str, Any], what: str, got: str, tmp_path: Path
) -> None:
    """The same whether the file lies beside DAVIS or is named by --keypoints."""
    path = write_badja(tmp_path / "a.json", {}, change)
    for read in (read_keypoints, read_badja):
        found, told = read(path, STEMS, (20, 20))
        assert found[0] is not None and found[1] is None
        wanted = f'a.json: 1 of 2 annotations {what} and are left out; the first (image_path "00005.jpg") has {got}'
        assert told.startswith(wanted)


@pytest.mark.parametrize(
    ("content", "reason"),
    [({}, "no list of such"), ([], "no list of such"), ([{"image_path": "0.jpg"}], "1 of 1 .* have no joints"),
     ([{"image_path": "0.jpg", "joints": [[1, 1]], "visibility": [1]}], "1 of 1 .* have fewer joints than 37")],
)  # fmt: skip
def test_a_file_beside_davis_that_is_not_badjas(content: object, reason: str, tmp_path: Path) -> None:
    (tmp_path / "camel.json").write_text(json.dumps(content))
    with pytest.raises(UserError, match=f"expected BADJA's list of image_path, joints.37. .*, got {reason}"):
        read_badja(tmp_path / "camel.json", STEMS, (20, 20))


def test_joints_outside_the_frame_are_told_in_both_ways(tmp_path: Path) -> None:
    joints = [[540, 960]] * 33 + [[5000, 9000], [9000, 5000], [-4, 9], [540, 960]]
    seen = [True] * 34 + [False, True, True]
    root = moving.davis(tmp_path / "data")
    (root / "badja").mkdir()
    file = write_badja(root / "badja" / "camel.json", {"joints": joints, "visibility": seen})
    for reader in (Davis(root), Davis(root, keypoints=file)):
        video = reader.video("camel")
        points = video.moments[0].keypoints
        assert points is not None
        by_name = dict(zip(points.names, points.visible.tolist(), strict=True))
        assert not by_name.get("nose", by_name.get("33")) and by_name.get("left_ear", by_name.get("36"))
        assert video.notes == ("2 keypoints outside their frame taken as not visible",)
