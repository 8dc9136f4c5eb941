"""Protocols that show every frame and score it too, and settings that say which frames are shown."""

import json
from pathlib import Path

import moving
import msgspec
import pytest
from films import SELECTION

from rewild4d.contracts import Selection
from rewild4d.datasets.video.aptv2 import AptV2
from rewild4d.datasets.video.davis import Davis
from rewild4d.errors import UserError
from rewild4d.evaluation.protocol import find_protocol, load_protocols

pytestmark = pytest.mark.usefixtures("cache")


def apt36k(root: Path, count: int = 6) -> Path:
    """A folder of APT-36K: annotations beside the species, paths of Windows, frames from 1, a species misspelt."""
    clip, images, entries = "8horse/v1c1", [], []
    for i in range(1, count + 1):
        moving.save(root / clip / f"frame{i}.jpg", moving.image(i))
        moving.save(root / "masks" / clip / f"frame{i}_2.png", moving.mask(i))
        name = f"D:\\Animal_pose\\AP-36k-patr1\\{clip}\\frame{i}.jpg".replace("/", "\\")
        images.append({"id": i, "file_name": name, "width": 96, "height": 64, "video_id": 5})
        entries.append({
            "id": i, "image_id": i, "category_id": 4, "video_id": 5, "track_id": 2, "bbox": [5 + i, 22, 30, 26],
            "keypoints": [20 + i, 30, 2] + [0, 0, 0] * 16,
        })  # fmt: skip
    table = {"images": images, "annotations": entries, "categories": [{"id": 4, "name": "hourse"}]}
    (root / "apt36k_annotations.json").write_text(json.dumps(table))
    return root


def test_apt_36k_is_read_and_every_frame_shown_and_scored(tmp_path: Path) -> None:
    selection = msgspec.structs.replace(find_protocol("aptv2", "apt36k-v1").selection, size=64)
    reader = AptV2(apt36k(tmp_path))
    assert reader.cases(selection) == ["8horse/v1c1@2"]
    clip, truth = reader.load("8horse/v1c1@2", selection)
    assert clip.species == "horse" and len(clip.frames) == 6
    assert list(clip.times) == [frame.time for frame in truth.held_out]
    held_out = AptV2(tmp_path).load("8horse/v1c1@2", SELECTION)
    assert len(held_out[0].frames) + len(held_out[1].held_out) == 6, "the other protocol holds frames out"


def test_several_of_so_many_frames_may_be_held_out(tmp_path: Path) -> None:
    pair = msgspec.structs.replace(SELECTION, split=(3, 1))
    clip, truth = Davis(moving.davis(tmp_path)).load("camel", pair)
    assert [round(24 * frame.time) for frame in truth.held_out] == [3, 7, 11]
    assert len(clip.frames) == 12 - 3


def test_settings_of_frames_that_are_not_cut_are_refused_elsewhere(tmp_path: Path) -> None:
    reader = Davis(moving.davis(tmp_path))
    for changes in ({"frames": 5}, {"mask_threshold": 0.5}):
        with pytest.raises(UserError, match="expected a protocol without 'frames' and 'mask_threshold'"):
            reader.load("camel", msgspec.structs.replace(SELECTION, **changes))


@pytest.mark.parametrize(
    ("settings", "sentence"),
    [
        ({"split": (0, 5)}, "'split' needs at least one shown frame"),
        ({"split": (5, -1)}, "'split' needs at least one shown frame"),
        ({"mask_threshold": 1.0}, "'mask_threshold' is at least 0 and below 1"),
        ({"frames": 0}, "'frames' is at least 1"),
    ],
)
def test_a_selection_that_means_nothing_is_refused(settings: dict[str, object], sentence: str) -> None:
    with pytest.raises(ValueError, match=sentence):
        Selection(cameras="known", size=64, **settings)  # type: ignore[arg-type]


def test_protocols_of_other_benchmarks_are_theirs() -> None:
    found = load_protocols()
    aim, avatars, held_out = (found[name].selection for name in ("aim-v1", "cop3d-all-v1", "cop3d-v1"))
    assert (aim.cameras, aim.size, aim.framing, aim.split, aim.mask_threshold) == ("unknown", 512, "full", (1, 0), 0.5)
    assert 127 / 255 < 0.5 < 128 / 255, "AiM's evaluator takes masks above 127 of 255"
    assert (avatars.split, avatars.frames, held_out.split, held_out.frames) == ((15, 0), 1000, (15, 5), 200)
    assert {one.mask_threshold for one in (avatars, held_out)} == {0.7}
    assert {found[name].background for name in ("cop3d-v1", "cop3d-all-v1")} == {0.0}
    assert find_protocol("aim", None).name == "aim-v1" and find_protocol("cop3d", None).name == "cop3d-v1"
    assert find_protocol("aptv2", None).name == "aptv2-512-v2", "the data set's default stays"
