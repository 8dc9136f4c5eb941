"""APTv2-like annotations that are wrong or lack something: one sentence or a stated fallback."""

import json
from pathlib import Path

import moving
import pytest
from test_wild import SELECTION, cache  # noqa: F401

from rewild4d.datasets.aptv2 import AptV2
from rewild4d.errors import UserError


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        ({"image_id": 5000}, "12 of 12 annotations name an image that is not listed"),
        ({"bbox": [200, 200, 5, 5]}, "12 of 12 annotations have no box inside their image"),
        ({"keypoints": [1, 2]}, "expected COCO-like annotations, but an entry does not fit"),
        ({"bbox": [float("nan"), 0, 5, 5]}, "12 of 12 annotations have no box inside their image"),
        ({"bbox": None}, "expected COCO-like annotations, but an entry does not fit"),
    ],
)
def test_wrong_annotations(change: dict[str, object], sentence: str, tmp_path: Path) -> None:
    reader = AptV2(moving.apt(tmp_path, **change))
    with pytest.raises(UserError) as error:
        reader.cases(SELECTION)
    assert sentence in str(error.value)


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


def test_an_image_of_infinite_width(tmp_path: Path) -> None:
    with pytest.raises(UserError, match="expected COCO-like annotations, but an entry does not fit .OverflowError"):
        resized(tmp_path, float("inf"), 64).cases(SELECTION)


def test_keypoints_outside_the_frame_are_not_visible(tmp_path: Path) -> None:
    points = [500, 30, 2] + [0, 0, 0] * 15 + [20, 30, 2]
    clip, _ = AptV2(moving.apt(tmp_path, keypoints=points)).load("easy/29wolf/v1C1@3", SELECTION)
    assert clip.frames[0].keypoints is not None and clip.frames[0].keypoints.visible.sum() == 1
    assert "12 keypoints outside their image taken as not visible" in clip.notes


def test_an_apt_clip_without_masks(tmp_path: Path) -> None:
    with pytest.raises(UserError, match="expected masks of easy/29wolf/v1C1@3 .*`rewild4d-bench masks` makes some"):
        AptV2(moving.apt(tmp_path, with_masks=False)).load("easy/29wolf/v1C1@3", SELECTION)
