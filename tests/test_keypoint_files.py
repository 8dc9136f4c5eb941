"""Keypoint files of several programs: which point of which frame a number is about."""

import json
from pathlib import Path

import pytest

from rewild4d.datasets.keypoint_files import read_keypoints, told_outside
from rewild4d.errors import UserError

STEMS = ("00000", "00005", "00010")


def test_badja_is_row_column_at_its_own_size(tmp_path: Path) -> None:
    entry = {"image_path": "DAVIS/x/00005.jpg", "joints": [[540, 960], [0, 0], [5000, 3]], "visibility": [1, 0, 1]}
    (tmp_path / "a.json").write_text(json.dumps([entry]))
    found = read_keypoints(tmp_path / "a.json", STEMS, (960, 540))
    assert found[0] is None and found[2] is None and found[1] is not None
    assert found[1].points[0].tolist() == [960.5 / 2, 540.5 / 2]
    # the third joint lies below the frame
    assert found[1].visible.tolist() == [True, False, False]
    assert told_outside(found, (960, 540)) == "1 keypoints outside their frame taken as not visible"


def test_of_several_coco_animals_the_largest_box_counts(tmp_path: Path) -> None:
    content = {
        "images": [{"id": 7, "file_name": "easy/cat/00010.jpg"}],
        "categories": [{"id": 1, "keypoints": ["nose", "neck"]}],
        "annotations": [
            {"image_id": 7, "category_id": 1, "bbox": [0, 0, 5, 5], "keypoints": [1, 1, 2, 2, 2, 2]},
            {"image_id": 7, "category_id": 1, "bbox": [0, 0, 9, 9], "keypoints": [3, 4, 2, 0, 0, 0]},
        ],
    }
    (tmp_path / "a.json").write_text(json.dumps(content))
    found = read_keypoints(tmp_path / "a.json", STEMS, (20, 20))[2]
    assert found is not None and found.names == ("nose", "neck")
    assert found.points[0].tolist() == [3.5, 4.5] and found.visible.tolist() == [True, False]


def test_deeplabcut_rows_count_frames_or_name_images(tmp_path: Path) -> None:
    (tmp_path / "a.csv").write_text(
        "scorer,net,net,net,net,net,net\nbodyparts,nose,nose,nose,paw,paw,paw\n"
        "coords,x,y,likelihood,x,y,likelihood\n0,1,2,0.9,3,4,0.2\n2,5,6,0.7,7,8,0.99\n"
    )
    found = read_keypoints(tmp_path / "a.csv", STEMS, (20, 20))
    assert found[1] is None and found[0] is not None and found[2] is not None
    assert found[0].visible.tolist() == [True, False] and found[2].points[1].tolist() == [7.5, 8.5]
    (tmp_path / "b.csv").write_text(
        "scorer,,,me,me\nbodyparts,,,nose,nose\ncoords,,,x,y\nlabeled-data,clip,00005.png,1,2\n"
    )
    labelled = read_keypoints(tmp_path / "b.csv", STEMS, (20, 20))[1]
    assert labelled is not None and labelled.points.tolist() == [[1.5, 2.5]]


def test_sleap_takes_the_best_instance_of_a_frame(tmp_path: Path) -> None:
    (tmp_path / "a.csv").write_text(
        "track,frame_idx,instance.score,nose.x,nose.y,nose.score\n"
        "t0,1,0.3,1,1,0.9\nt1,1,0.8,2,2,0.9\nt0,2,0.5,,,\n"
    )  # fmt: skip
    found = read_keypoints(tmp_path / "a.csv", STEMS, (20, 20))
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
        found = read_keypoints(tmp_path / name, stems, (20, 20))
        assert [points and points.points[0, 0].item() for points in found] == [10.5, 11.5, 12.5]


def test_a_number_with_an_ending_or_a_folder_is_a_name(tmp_path: Path) -> None:
    head = "scorer,,,me,me\nbodyparts,,,nose,nose\ncoords,,,x,y\n"
    (tmp_path / "d.csv").write_text(head + "labeled-data,clip,2.png,10,0\nlabeled-data,clip,3,11,0\n")
    found = read_keypoints(tmp_path / "d.csv", ("1", "2", "3"), (20, 20))
    assert [points and points.points[0, 0].item() for points in found] == [None, 10.5, 11.5]


def test_a_number_beyond_the_frames_is_no_name(tmp_path: Path) -> None:
    (tmp_path / "s.csv").write_text("frame_idx,instance.score,nose.x,nose.y\n3,1,10,0\n")
    with pytest.raises(UserError, match="expected keypoints of the frames 1 to 3, got those of number 3"):
        read_keypoints(tmp_path / "s.csv", ("1", "2", "3"), (20, 20))
