"""Animal-in-Motion: what the names say, crops that map back, what is missing and what is wrong."""

import json
from pathlib import Path

import benchmark_films
import moving
import msgspec
import numpy as np
import pytest
import torch
from calling import call, output, refusal
from films import iou, restored

from rewild4d.contracts import Selection
from rewild4d.datasets.aim.files import TrackId, benchmark_tracks, parse_track
from rewild4d.datasets.aim.reader import Aim
from rewild4d.datasets.aim.writer import crop_boxes, write_aim
from rewild4d.datasets.builtin import filming
from rewild4d.errors import UserError
from rewild4d.evaluation.protocol import find_protocol

pytestmark = pytest.mark.usefixtures("cache")

SELECTION = Selection(cameras="unknown", size=64, framing="full", split=(1, 0), mask_threshold=0.5)
CASE = benchmark_films.TRACK


def test_the_name_of_a_track_is_taken_apart_from_the_right() -> None:
    assert parse_track("AmWzveUePWU_019_001") == TrackId("AmWzveUePWU", 19, 1)
    assert parse_track("Lhi5USQ1N9I_0481_001") == TrackId("Lhi5USQ1N9I", 481, 1)
    assert parse_track("_nXq7ELKflM_001_001") == TrackId("_nXq7ELKflM", 1, 1)
    assert parse_track("wr_LvPzVi_M_257_002") == TrackId("wr_LvPzVi_M", 257, 2)
    assert parse_track("horse") is None and parse_track("AmWzveUePWU_019") is None


def test_the_benchmark_has_ten_tracks_of_each_of_23_categories() -> None:
    tracks = benchmark_tracks()
    assert len(tracks) == 23 and {*map(len, tracks.values())} == {10} and {"racoon", "cougar"} <= {*tracks}
    names = [name for found in tracks.values() for name in found]
    assert len({*names}) == 230
    assert all((found := parse_track(name)) and len(found.video) == 11 for name in names)


def test_a_track_is_read_as_it_is(tmp_path: Path) -> None:
    benchmark_films.aim(tmp_path)
    reader = Aim(tmp_path)
    clip, truth = reader.load(CASE, SELECTION)
    assert reader.cases(SELECTION) == [CASE] and reader.originals(CASE, SELECTION) is None
    assert (clip.species, clip.fps, clip.start) == ("dog", 10, 3 / 10)
    assert clip.times == pytest.approx([i / 10 for i in range(8)])
    assert list(clip.times) == [frame.time for frame in truth.held_out], "all frames are shown and scored"
    assert "all 8 frames are shown and scored" in clip.notes[-1]
    frame = clip.frames[2]
    wanted = moving.image(5, (64, 64)) * (moving.mask(5, (64, 64))[..., None] > 0)
    assert frame.camera is None and torch.equal(frame.rgb, torch.from_numpy(wanted).permute(2, 0, 1).float() / 255)
    assert frame.crop is not None and (frame.crop.left, frame.crop.top, frame.crop.side) == (-20, -16, 128)
    points = frame.keypoints
    assert points is not None and points.points[4].tolist() == [40.0, 30.0]
    assert points.visible.tolist() == [False] + 16 * [True] and points.confidence is not None
    assert points.confidence[0] == pytest.approx(0.2)
    # crop px -> film px: X = x0 + u (x1 - x0) / width
    assert frame.crop.to_original(points.points[4], 64).tolist() == [-20 + 40 * 128 / 64, -16 + 30 * 128 / 64]


def test_another_size_moves_keypoints_with_the_pixels(tmp_path: Path) -> None:
    benchmark_films.aim(tmp_path)
    half = Selection(cameras="unknown", size=32, framing="full", split=(1, 0))
    frame = Aim(tmp_path).load(CASE, half)[0].frames[0]
    assert frame.mask.shape == (1, 32, 32) and frame.keypoints is not None
    assert frame.keypoints.points[4].tolist() == [40 / 2, 30 / 2]


def test_masks_are_solid_above_the_threshold_alone(tmp_path: Path) -> None:
    folder = benchmark_films.aim(tmp_path)
    values = np.tile(np.where(np.arange(64) < 32, 127, 128).astype(np.uint8), (64, 1))
    for file in folder.glob("*_mask.png"):
        moving.save(file, values)
    frame = Aim(tmp_path).load(CASE, SELECTION)[0].frames[0]
    assert frame.mask[0, 0].tolist() == 32 * [0.0] + 32 * [1.0], "127 is outside, as AiM's evaluator has it"


@pytest.mark.parametrize("level", ["", "test", "dog", CASE])
def test_the_folder_may_have_splits_or_be_a_category_or_a_track(level: str, tmp_path: Path) -> None:
    benchmark_films.aim(tmp_path / "test" if level == "test" else tmp_path)
    assert Aim(tmp_path if level == "test" else tmp_path / level).cases(SELECTION) == [CASE]


def test_tracks_of_the_benchmark_are_the_default(tmp_path: Path) -> None:
    benchmark_films.aim(tmp_path)
    assert Aim(tmp_path).default_cases(SELECTION) == [CASE]
    benchmark_films.aim(tmp_path, track="horse/AUWICsLcxJg_008_001")
    assert Aim(tmp_path).default_cases(SELECTION) == ["horse/AUWICsLcxJg_008_001"]


def test_frames_that_lack_a_file_are_left_out_and_told(tmp_path: Path) -> None:
    folder = benchmark_films.aim(tmp_path, count=12)
    for name in ("00000004_rgb.png", "00000005_rgb.png", "00000007_mask.png", "00000014_metadata.json"):
        (folder / name).unlink()
    (folder / "00000009_keypoint.txt").unlink()
    clip, _ = Aim(tmp_path).load(CASE, SELECTION)
    assert [round(10 * time) for time in clip.times] == [0, 3, 5, 6, 7, 8, 9, 10], "seconds keep their gaps"
    assert clip.notes[:4] == (
        "1 of 12 frames without a mask left out: 00000007",
        "2 of 12 frames without an RGB image left out: 00000004 to 00000005",
        "1 of 12 frames without metadata left out: 00000014",
        "1 of 12 frames without keypoints: 00000009",
    )


def test_frames_without_the_animal_are_left_out_and_told(tmp_path: Path) -> None:
    folder = benchmark_films.aim(tmp_path)
    moving.save(folder / "00000006_mask.png", np.zeros((64, 64), np.uint8))
    clip, _ = Aim(tmp_path).load(CASE, SELECTION)
    assert len(clip.frames) == 7 and clip.notes[0] == "1 of 8 frames without the animal left out: 00000006"


def test_older_metadata_say_the_films_size_otherwise_or_not_at_all(tmp_path: Path) -> None:
    folder = benchmark_films.aim(tmp_path)
    for number, older in ((3, {"frame_size_wh": [640, 480]}), (4, {})):
        said = json.dumps({"crop_box_xyxy": benchmark_films.BOX} | older)
        (folder / f"{number:08d}_metadata.json").write_text(said)
    clip, _ = Aim(tmp_path).load(CASE, SELECTION)
    sizes = [(frame.crop.width, frame.crop.height) for frame in clip.frames[:3] if frame.crop]
    assert sizes == [(640, 480), (1920, 1080), (320, 180)]
    assert clip.notes[0] == "1 of 8 frames whose film's size is not stated, taken as 1920x1080: 00000004"


def test_without_rgb_it_is_said_how_to_restore_it(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = benchmark_films.aim(tmp_path)
    for file in folder.glob("*_rgb.png"):
        file.unlink()
    said = refusal(capsys, "run", "--method", "empty", "--dataset", "aim", "--data", tmp_path, "--out", tmp_path / "o")
    assert "_rgb.png, got none; AiM's own script restores them" in said
    assert "tools/restore_rgb_data.py --data_dir DATA --video_dir NEW_FOLDER" in said and "Traceback" not in said


@pytest.mark.parametrize(
    ("name", "content", "sentence"),
    [
        ("00000004_keypoint.txt", "1 2 0.5\n" * 16, "expected 17 rows of x, y and score, got 16 rows"),
        ("00000004_keypoint.txt", "1 2 0.5\n" * 16 + "1 nan 0.5", "expected finite numbers, got 'nan'"),
        ("00000004_keypoint.txt", "1 2\n" * 17, "expected rows of x, y and score, got '1 2'"),
        ("00000004_metadata.json", "{", "expected metadata of AiM with crop_box_xyxy, but"),
        ("00000004_metadata.json", "{}", "missing required field `crop_box_xyxy`"),
        (
            "00000004_metadata.json",
            '{"crop_box_xyxy": [0, 0, 100, 50]}',
            "expected a square as crop_box_xyxy, got [0.0",
        ),
        ("00000004_mask.png", (32, 32), "expected 64x64 pixels like its image, got 32x32"),
        ("00000004_rgb.png", (32, 32), "expected 64x64 pixels like 00000003_rgb.png, got 32x32"),
        ("00000004_rgb.png", "cut off", "expected a whole image, got a file that is neither PNG nor JPEG"),
        ("-a_b-c_d-e_0012_003_info.json", '{"fps": 0}', "expected frames a second as fps, got 0.0"),
    ],
)
def test_a_file_that_cannot_be_used_is_one_sentence(
    name: str, content: str | tuple[int, int], sentence: str, tmp_path: Path
) -> None:
    path = benchmark_films.aim(tmp_path) / name
    if isinstance(content, str):
        path.write_text(content)
    else:
        moving.save(path, moving.mask(3, content))
    with pytest.raises(UserError) as error:
        Aim(tmp_path).load(CASE, SELECTION)
    assert str(error.value).startswith(f"{path}: ") and sentence in str(error.value)


def test_folders_that_cannot_be_used_are_one_sentence(tmp_path: Path) -> None:
    folder = benchmark_films.aim(tmp_path / "a")
    with pytest.raises(UserError, match=r"expected a folder of AiM, got no such folder"):
        Aim(tmp_path / "b")
    with pytest.raises(UserError, match=r"expected tracks of AiM \(<category>/<track>, .*\), got none"):
        Aim(moving.frames(tmp_path / "c"))
    with pytest.raises(UserError, match=r"unknown case 'cat/x'"):
        Aim(tmp_path / "a").load("cat/x", SELECTION)
    for file in folder.glob("*_metadata.json"):
        file.unlink()
    with pytest.raises(UserError, match=r"expected files <frame>_metadata.json, got none\.$"):
        Aim(tmp_path / "a").load(CASE, SELECTION)
    benchmark_films.aim(tmp_path / "d" / "train")
    benchmark_films.aim(tmp_path / "d" / "test")
    with pytest.raises(UserError, match=r"expected each track once"):
        Aim(tmp_path / "d")


def test_a_protocol_that_cuts_frames_is_refused(tmp_path: Path) -> None:
    benchmark_films.aim(tmp_path)
    with pytest.raises(UserError, match=r"expected a protocol that takes these frames as they are \(cameras = 'unkno"):
        Aim(tmp_path).load(CASE, find_protocol("davis", None).selection)


def test_crop_boxes_are_aims() -> None:
    """Side sqrt(2 w h) about the middle of a mask's box; the mean over 6 frames before and after, not at the ends."""
    mattes = [np.zeros((200, 300), np.uint8) for _ in range(15)]
    for frame, matte in enumerate(mattes):
        matte[40:91, 20 + 4 * frame : 121 + 4 * frame] = 255  # corners 100 and 50 pixels apart: side sqrt(2 * 100 * 50)
    boxes = crop_boxes(mattes)
    assert boxes[0] == (70 - 50, 65 - 50, 70 + 50, 65 + 50)
    assert boxes[4] == (20 + 16, 15, 120 + 16, 115), "the first five stand as they are"
    assert boxes[7] == (20 + 28, 15, 120 + 28, 115)
    assert boxes[5][0] == 20 + int(4 * sum(range(12)) / 12), "frames 0 to 11: the one before the first is missing"


def test_a_written_film_comes_back(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    words = ("make", "aim", "--seeds", "0", "--frames", "14", "--size", "192x128", "--crop", "128")
    (folder,) = map(Path, output(capsys, *words, "--out", tmp_path / "made").split())
    reader = Aim(tmp_path / "made")
    clip, _ = reader.load("dog/zoo_-000000_001_001", msgspec.structs.replace(SELECTION, size=128))
    assert folder.is_dir() and clip.start == 3 / 10 and len(clip.frames) == 14
    for frame, shot in zip(clip.frames, filming.film(0, 14, 192, 128), strict=True):
        assert iou(restored(frame, (192, 128)), shot.alpha > 127) > 0.9
        assert frame.crop is not None and frame.keypoints is not None
        places = frame.crop.to_original(frame.keypoints.points, 128)
        assert torch.allclose(places.double(), torch.from_numpy(shot.joints[:, :2]), atol=0.6)
        inside = frame.mask[0, frame.keypoints.points[5:, 1].long(), frame.keypoints.points[5:, 0].long()]
        assert inside.mean() > 0.8, "most joints of the legs lie on the animal"
    assert call("check", "--dataset", "aim", "--data", tmp_path / "made", "--sheets", tmp_path / "sheets") == 0
    assert "14 frames of 128x128 at 10 a second" in capsys.readouterr().out
    write_aim(tmp_path / "made", (0,), 4, (48, 32), 32)
    assert len(Aim(tmp_path / "made").video("dog/zoo_-000000_001_001").moments) == 4, "an earlier one is replaced"
    (tmp_path / "own").mkdir()
    (tmp_path / "own" / "thesis.txt").touch()
    assert "expected an empty folder or an earlier one of `make aim`" in refusal(
        capsys, "make", "aim", "--out", tmp_path / "own"
    )
