"""APTv2-like annotations that are wrong or lack something: one sentence or a stated fallback."""

import json
from pathlib import Path

import moving
import pytest
from films import SELECTION

from rewild4d.datasets.video.aptv2 import AptV2
from rewild4d.errors import UserError

pytestmark = pytest.mark.usefixtures("cache")

FAULTS: list[tuple[dict[str, object], str, str]] = [
    ({"image_id": 5000}, "name an image that is not listed", "image_id 5000"),
    ({"image_id": [1]}, "name an image that is not listed", "image_id [1]"),
    ({"bbox": [200, 200, 5, 5]}, "have no box inside their image", "bbox [200, 200, 5, 5]"),
    ({"bbox": [float("nan"), 0, 5, 5]}, "have no box inside their image", "bbox [NaN, 0, 5, 5]"),
    ({"bbox": None}, "have no bbox of four numbers", "bbox null"),
    ({"bbox": [10**400, 0, 5, 5]}, "have no bbox of four numbers", "bbox [100000"),
    ({"keypoints": [1, 2]}, "have other keypoints than 51 numbers", "keypoints [1, 2]"),
    ({"track_id": None}, "have no whole number as track_id", "track_id null"),
    ({"track_id": 3.5}, "have no whole number as track_id", "track_id 3.5"),
    ({"track_id": 1e300}, "have no whole number as track_id", "track_id 1e+300"),
]


@pytest.mark.parametrize(("change", "what", "got"), FAULTS)
def test_annotations_that_are_all_wrong(change: dict[str, object], what: str, got: str, tmp_path: Path) -> None:
    reader = AptV2(moving.apt(tmp_path, **change))
    with pytest.raises(UserError) as error:
        reader.cases(SELECTION)
    told = f"train_annotations.json: 12 of 12 annotations {what} and are left out; the first (id 100) has {got}"
    assert told in str(error.value)


def one_entry_changed(root: Path, change: dict[str, object], remove: str = "") -> AptV2:
    """A reader of annotations whose entry with id 104 is another; a key of it can be taken away."""
    file = moving.apt(root) / "annotations" / "train_annotations.json"
    table = json.loads(file.read_text())
    table["annotations"][4] |= change
    table["annotations"][4].pop(remove, None)
    file.write_text(json.dumps(table))
    return AptV2(root)


@pytest.mark.parametrize(("change", "what", "got"), FAULTS)
def test_one_wrong_annotation_is_left_out_and_told(
    change: dict[str, object], what: str, got: str, tmp_path: Path
) -> None:
    reader = one_entry_changed(tmp_path, change)
    assert reader.cases(SELECTION) == ["easy/29wolf/v1C1@3"]
    clip, truth = reader.load("easy/29wolf/v1C1@3", SELECTION)
    assert len(clip.frames) + len(truth.held_out) == 11
    group = "of 12 annotations" if "image_id" in change else "annotations of easy/29wolf/v1C1"
    told = f"train_annotations.json: 1 {group} {what} and are left out; the first (id 104) has {got}"
    assert any(note.startswith(told) for note in clip.notes)
    assert any(
        finding.message.startswith(f"train_annotations.json: 1 of 12 annotations {what}") for finding in reader.check()
    )


@pytest.mark.parametrize("key", ["track_id", "bbox", "image_id"])
def test_an_annotation_that_lacks_something_is_filed_nowhere(key: str, tmp_path: Path) -> None:
    reader = one_entry_changed(tmp_path, {}, remove=key)
    assert reader.cases(SELECTION) == ["easy/29wolf/v1C1@3"]
    assert any(f"the first (id 104) has no {key}" in note for note in reader.video("easy/29wolf/v1C1@3").notes)


def test_annotations_that_are_no_objects(tmp_path: Path) -> None:
    file = moving.apt(tmp_path) / "annotations" / "train_annotations.json"
    table = json.loads(file.read_text())
    file.write_text(json.dumps(table | {"annotations": [None, *table["annotations"]]}))
    told = "1 of 13 annotations are no objects with named values and are left out; the first (number 0) has null"
    assert any(told in note for note in AptV2(tmp_path).video("easy/29wolf/v1C1@3").notes)
    for change in ({"images": 5}, {"annotations": None}, {"categories": 5}):
        file.write_text(json.dumps(table | change))
        with pytest.raises(UserError, match=f"expected COCO-like annotations, got no list called {next(iter(change))}"):
            AptV2(tmp_path).cases(SELECTION)


def test_annotations_without_tracks(tmp_path: Path) -> None:
    """AP-10K looks the same but has no videos."""
    moving.apt(tmp_path)
    file = tmp_path / "annotations" / "train_annotations.json"
    table = json.loads(file.read_text())
    for entry in table["annotations"]:
        del entry["track_id"]
    file.write_text(json.dumps(table))
    with pytest.raises(UserError, match="expected annotations with video_id and track_id, got none with track_id"):
        AptV2(tmp_path).cases(SELECTION)
    for text in (file.read_text()[:100], 100000 * "["):
        file.write_text(text)
        with pytest.raises(UserError, match="expected JSON, but it cannot be parsed"):
            AptV2(tmp_path).cases(SELECTION)


def resized(root: Path, width: float, height: float) -> AptV2:
    """A reader of annotations that state another size of their images."""
    file = moving.apt(root) / "annotations" / "train_annotations.json"
    table = json.loads(file.read_text())
    for image in table["images"]:
        image |= {"width": width, "height": height}
    file.write_text(json.dumps(table))
    return AptV2(root)


def test_images_of_another_size_than_their_annotations_state(tmp_path: Path) -> None:
    reader = resized(tmp_path, 192, 128)
    sentence = "0000.jpg: expected 192x128 pixels, for which its boxes and keypoints are, got 96x64"
    with pytest.raises(UserError, match=sentence):
        reader.load("easy/29wolf/v1C1@3", SELECTION)
    with pytest.raises(UserError, match=sentence):
        reader.unmasked("easy/29wolf/v1C1@3")


@pytest.mark.parametrize(
    ("width", "got"), [(float("inf"), "Infinity"), (1e300, r"1e\+300"), (0, "0"), (-96, "-96"), (float("nan"), "NaN")]
)
def test_an_image_of_no_possible_width(width: float, got: str, tmp_path: Path) -> None:
    sentence = f"12 of 12 annotations name an image without width and height .* has image_id 0 with width {got} "
    with pytest.raises(UserError, match=sentence):
        resized(tmp_path, width, 64).cases(SELECTION)


@pytest.mark.parametrize("name", [f"clip/{300 * 'x'}.jpg", "../../clip/0.jpg", "clip/0\0.jpg"])
def test_an_image_that_no_data_set_can_hold(name: str, tmp_path: Path) -> None:
    """Such names would be asked of the file system, and a case's name is a folder of the results."""
    file = moving.apt(tmp_path) / "annotations" / "train_annotations.json"
    table = json.loads(file.read_text())
    table["images"][4]["file_name"] = name
    file.write_text(json.dumps(table))
    told = "name an image that no data set can hold and are left out; the first (id 104) has file_name"
    reader = AptV2(tmp_path)
    assert reader.cases(SELECTION) == ["easy/29wolf/v1C1@3"]
    assert any(told in finding.message for finding in reader.check())


def test_keypoints_of_enormous_numbers_are_outside(tmp_path: Path) -> None:
    points = [1e300, 30, 2] + [0, 0, 0] * 15 + [20, 30, 2]
    clip, _ = AptV2(moving.apt(tmp_path, keypoints=points)).load("easy/29wolf/v1C1@3", SELECTION)
    first = clip.frames[0].keypoints
    assert first is not None and first.visible.sum() == 1 and first.points.isfinite().all()


def test_keypoints_outside_the_frame_are_not_visible(tmp_path: Path) -> None:
    points = [500, 30, 2] + [0, 0, 0] * 15 + [20, 30, 2]
    clip, _ = AptV2(moving.apt(tmp_path, keypoints=points)).load("easy/29wolf/v1C1@3", SELECTION)
    assert clip.frames[0].keypoints is not None and clip.frames[0].keypoints.visible.sum() == 1
    assert "12 keypoints outside their image taken as not visible" in clip.notes


def test_an_animal_of_no_listed_category_is_told(tmp_path: Path) -> None:
    told = "its category is not listed: taken for a quadruped"
    clip, _ = AptV2(moving.apt(tmp_path / "all", category_id=99)).load("easy/29wolf/v1C1@3", SELECTION)
    assert told in clip.notes and clip.species == "animal of no listed category"
    (first, _), (one, _) = (
        AptV2(moving.apt(tmp_path / "none")).load("easy/29wolf/v1C1@3", SELECTION),
        one_entry_changed(tmp_path / "one", {"category_id": 99}).load("easy/29wolf/v1C1@3", SELECTION),
    )
    assert told not in first.notes and told not in one.notes, "its other annotations say what it is"
    assert first.species == one.species


def test_an_apt_clip_without_masks(tmp_path: Path) -> None:
    with pytest.raises(UserError, match="expected masks of easy/29wolf/v1C1@3 .*`rewild4d-bench masks` makes some"):
        AptV2(moving.apt(tmp_path, with_masks=False)).load("easy/29wolf/v1C1@3", SELECTION)


def test_masks_of_other_tracks_are_told(tmp_path: Path) -> None:
    reader = AptV2(moving.apt(tmp_path))
    for i in range(12):
        values = moving.mask(i) // 255 + 2 * (moving.mask(i, left=65) // 255)
        moving.save(tmp_path / "masks" / "easy/29wolf/v1C1" / f"{i:04d}_3.png", values.clip(0, 2), "P")
    told = "masks hold objects 1, 2, none of them track 3: taken together"
    assert told in reader.video("easy/29wolf/v1C1@3").notes
