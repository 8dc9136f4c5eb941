"""Real videos as clips: what masks mean, which frames are used, and crops that map back."""

import json
from pathlib import Path

import moving
import numpy as np
import pytest
import torch
from films import SELECTION, iou, restored

from rewild4d.datasets.keypoints.keypoints import read_badja
from rewild4d.datasets.masking.facts import FRAMED, mask_facts
from rewild4d.datasets.masking.masks import match_masks, open_masks
from rewild4d.datasets.video.aptv2 import AptV2
from rewild4d.datasets.video.crops import cut, follow
from rewild4d.datasets.video.davis import Davis, known_sequences
from rewild4d.datasets.video.online import Online
from rewild4d.datasets.video.wild import split_frames
from rewild4d.errors import UserError
from rewild4d.evaluation.protocol import find_protocol
from rewild4d.types import Camera, Crop

pytestmark = pytest.mark.usefixtures("cache")


def test_the_split_is_four_to_one_and_never_at_the_ends() -> None:
    assert [i for i, test in enumerate(split_frames(12, 5)) if test] == [2, 7]
    assert [i for i, test in enumerate(split_frames(13, 5)) if test] == [2, 7]
    assert sum(split_frames(100, 5)) == 100 / 5
    for count in range(4, 60):
        tested = split_frames(count, 5)
        assert any(tested) and not tested[0] and not tested[-1]


def test_a_davis_clip_maps_back_to_its_frames(tmp_path: Path) -> None:
    clip, truth = Davis(moving.davis(tmp_path)).load("camel", SELECTION)
    assert (len(clip.frames), len(truth.held_out), clip.fps) == (10, 2, 24)
    assert [frame.time for frame in truth.held_out] == [2 / 24, 7 / 24]
    assert all(frame.camera is None for frame in (*clip.frames, *truth.held_out))
    for frame in (*clip.frames, *truth.held_out):
        index = round(frame.time * 24)
        assert frame.crop is not None and (frame.crop.width, frame.crop.height) == moving.SIZE
        assert iou(restored(frame, moving.SIZE), moving.mask(index) > 0) > 0.93
        inside = frame.mask[0] > 0.99
        red = frame.rgb[:, inside].mean(1)
        assert torch.allclose(red, torch.tensor((200.0, 40.0, 30.0)) / 255, atol=0.1)
        assert (frame.rgb <= frame.mask + 1 / 255).all()
        assert not inside[0].any() and not inside[:, 0].any()


def test_reading_twice_gives_the_same_digests(tmp_path: Path) -> None:
    root = moving.davis(tmp_path)
    first, second = (Davis(root).load("camel", SELECTION) for _ in range(2))
    assert [part.digest for part in first] == [part.digest for part in second]
    moving.save(root / "Annotations" / "480p" / "camel" / "00004.png", moving.mask(5))
    assert Davis(root).load("camel", SELECTION)[0].digest != first[0].digest


@pytest.mark.parametrize(
    ("values", "mode", "cases"),
    [((0, 255), "L", ["camel"]), ((0, 1), "P", ["camel"]), ((0, 1), "L", ["camel"]), ((0, 255), "P", ["camel"]),
     ((2, 1), "P", ["camel", "camel@1", "camel@2"]), ((2, 1), "L", ["camel", "camel@1", "camel@2"])],
)  # fmt: skip
def test_what_a_mask_means(tmp_path: Path, values: tuple[int, int], mode: str, cases: list[str]) -> None:
    reader = Davis(moving.davis(tmp_path, values=values, mode=mode))
    assert reader.cases(SELECTION) == cases
    found = next(iter(reader.video(cases[len(cases) // 2]).masks()))
    assert found is not None and (found == moving.mask(0)).all()


@pytest.mark.parametrize("mode", ["P", "L"])
def test_void_is_no_animal_in_2017(tmp_path: Path, mode: str) -> None:
    file = tmp_path / "00000.png"
    values = moving.mask(0) // 255
    values[:4] = 255
    masks = open_masks([moving.save(file, values, mode)])
    assert masks.ids == (1,)
    read = masks.read(0, None, moving.SIZE)
    assert read is not None and (read == moving.mask(0)).all()


def test_other_masks_train_and_the_data_sets_own_judge(tmp_path: Path) -> None:
    root = moving.davis(tmp_path / "data")
    for i in range(12):
        moving.save(tmp_path / "mine" / "camel" / f"{i:05d}.png", moving.mask(i, left=24) // 255, "P")
    reader = Davis(root, masks=tmp_path / "mine")
    clip, truth = reader.load("camel", SELECTION)
    assert iou(restored(clip.frames[0], moving.SIZE), moving.mask(0, left=24) > 0) > 0.93
    assert iou(restored(truth.held_out[0], moving.SIZE), moving.mask(2) > 0) > 0.93
    assert "masks of the input from" in clip.notes[0]
    assert reader.settings == {"masks": str((tmp_path / "mine").resolve())}


def test_frames_without_the_animal_and_cut_ones_are_left_out_and_told(tmp_path: Path) -> None:
    root = moving.davis(tmp_path, count=20)
    folder = root / "Annotations" / "480p" / "camel"
    moving.save(folder / "00003.png", moving.mask(0) * 0)
    (folder / "00005.png").unlink()
    for i in (18, 19):
        moving.save(folder / f"{i:05d}.png", moving.mask(i, left=70))
    clip, truth = Davis(root).load("camel", SELECTION)
    used = sorted(round(frame.time * 24) for frame in (*clip.frames, *truth.held_out))
    assert used == [i for i in range(20) if i not in (3, 5, 18, 19)]
    assert clip.notes == (
        "1 of 20 frames without a mask left out: 00005.jpg",
        "1 of 20 frames without the animal left out: 00003.jpg",
        "2 of 20 frames where the image's border cuts the animal left out: 00018.jpg to 00019.jpg",
    )


def test_cut_frames_stay_where_most_are_cut(tmp_path: Path) -> None:
    source, folder = moving.frames(tmp_path / "f", left=90), moving.masks(tmp_path / "m", left=90)
    clip, truth = Online(source, masks=folder).load("f", SELECTION)
    assert len(clip.frames) + len(truth.held_out) == 12
    assert "because most are like that" in clip.notes[-1]


def test_known_animals() -> None:
    known = known_sequences()
    eight = [name for name, facts in known.items() if facts.get("eight")]
    assert len(eight) == 8 and all(known[name].get("quadruped", True) for name in eight)
    assert known["blackswan"]["quadruped"] is False


def test_quadrupeds_are_the_default_and_a_swan_is_told(tmp_path: Path) -> None:
    moving.davis(tmp_path)
    moving.davis(tmp_path, "blackswan")
    reader = Davis(tmp_path)
    assert reader.cases(SELECTION) == ["blackswan", "camel"]
    assert reader.default_cases(SELECTION) == ["camel"]
    assert "a swan is no quadruped" in reader.load("blackswan", SELECTION)[0].notes[0]


def test_crops_follow_without_trembling_and_hold_every_box() -> None:
    times = [i / 10 for i in range(40)]
    shake = np.random.default_rng(0).integers(-3, 4, (40, 2))
    boxes = [(100 + 2 * i + int(a), 50 + int(b), 180 + 2 * i + int(a), 110 + int(b)) for i, (a, b) in enumerate(shake)]
    crops = follow(times, boxes, times, (640, 360))
    for crop, (left, top, right, bottom) in zip(crops, boxes, strict=True):
        assert crop.left < left and crop.top < top
        assert crop.left + crop.side > right and crop.top + crop.side > bottom
    middles = np.array([crop.left + crop.side / 2 for crop in crops])
    boxed = np.array([(left + right) / 2 for left, _, right, _ in boxes])
    assert np.diff(middles, 2).std() < 0.2 * np.diff(boxed, 2).std()


def test_a_held_out_crop_lies_between_its_neighbours() -> None:
    boxes = [(10, 10, 30, 30), (14, 10, 34, 30), (18, 10, 38, 30)]
    a, b, c = follow([0.0, 1.0, 3.0], boxes, [1.0, 2.0, 3.0], (64, 48))
    assert b.left == pytest.approx((a.left + c.left) / 2) and b.side == pytest.approx((a.side + c.side) / 2)


@pytest.mark.parametrize("side", [20.0, 37.5, 130.0])
def test_a_crop_keeps_positions(side: float) -> None:
    """The middle of a blob lands where `from_original` says, enlarged and reduced."""
    rows, columns = np.mgrid[:120, :160]
    blob = 255 * np.exp(-((columns + 0.5 - 80) ** 2 + (rows + 0.5 - 60) ** 2) / (2 * 3.0**2))
    crop = Crop(80 - side / 2 + 1.25, 60 - side / 2 - 0.5, side, 160, 120)
    placed = cut(np.zeros((120, 160, 3), np.uint8), blob.round().astype(np.uint8), crop, 48)[..., 3].astype(float)
    y, x = np.mgrid[:48, :48] + 0.5
    middle = torch.tensor(((placed * x).sum() / placed.sum(), (placed * y).sum() / placed.sum()))
    expected = crop.from_original(torch.tensor((80.0, 60.0), dtype=torch.float64), 48)
    assert torch.allclose(middle, expected, atol=0.1)
    assert torch.allclose(crop.to_original(expected, 48), torch.tensor((80.0, 60.0), dtype=torch.float64))


def test_the_camera_of_a_crop_as_one_of_the_whole_frame() -> None:
    intrinsics = torch.tensor(((100.0, 0, 32), (0, 100, 32), (0, 0, 1)), dtype=torch.float64)
    camera = Camera(torch.eye(4, dtype=torch.float64), intrinsics, 64, 64)
    crop, point = Crop(10.5, -3.25, 48.0, 96, 60), torch.tensor((0.1, -0.2, 2.0), dtype=torch.float64)
    whole = crop.original_camera(camera)
    assert (whole.width, whole.height) == (96, 60)
    assert torch.allclose(whole.project(point)[0], crop.to_original(camera.project(point)[0], 64))


def test_mask_facts() -> None:
    canvas = np.zeros((40, 60), np.uint8)
    canvas[10:30, 10:30] = 255
    canvas[15:20, 15:20] = 0
    canvas[12:17, 40:45] = 255
    facts = mask_facts(canvas)
    assert facts.parts == (20 * 20 - 25, 25)
    assert facts.box == (10, 10, 45, 30)
    assert facts.holes == pytest.approx(25 / 400)
    assert not facts.is_cut
    canvas[10:30, 45:] = 255
    assert mask_facts(canvas).is_cut
    assert mask_facts(canvas * 0).box is None
    assert mask_facts(canvas).framed < 0.5 < FRAMED < mask_facts(255 - 0 * canvas).framed == 1.0


def test_masks_are_matched_by_name_number_or_order(tmp_path: Path) -> None:
    stems = ["frame_0", "frame_1", "frame_2"]

    def match(*names: str) -> tuple[list[str | None], str]:
        found, note = match_masks([tmp_path / name for name in names], stems, tmp_path)
        return [path.name if path else None for path in found], note

    assert match("frame_0.png", "frame_2.png") == (["frame_0.png", None, "frame_2.png"], "")
    assert match("m_0.png", "m_1.png", "m_2.png")[0] == ["m_0.png", "m_1.png", "m_2.png"]
    assert match("1.png", "2.png", "3.png") == (["1.png", "2.png", "3.png"], "masks are numbered from 1, frames from 0")
    assert match("1.png", "3.png") == (["1.png", None, "3.png"], "masks are numbered from 1, frames from 0")
    assert match("1.png", "2.png") == ([None, "1.png", "2.png"], ""), "frame 0 has none"
    assert match("1.png", "2.png", "9.png") == ([None, "1.png", "2.png"], "1 of 3 masks fit no frame: 9.png")
    assert match("a.png", "b.png", "c.png")[1].startswith("masks and frames share no names: matched in order")
    with pytest.raises(UserError, match="expected masks named like the frames \\(frame_0, ...\\) or one for each of"):
        match("a.png", "b.png")


def test_an_apt_clip(tmp_path: Path) -> None:
    reader = AptV2(moving.apt(tmp_path))
    assert reader.cases(SELECTION) == reader.default_cases(SELECTION) == ["easy/29wolf/v1C1@3"]
    clip, truth = reader.load("easy/29wolf/v1C1@3", SELECTION)
    assert (clip.species, len(clip.frames), len(truth.held_out)) == ("wolf", 10, 2)
    points = clip.frames[3].keypoints
    assert points is not None and points.visible.tolist() == [False] * 16 + [True]
    index = round(clip.frames[3].time * 10)
    crop = clip.frames[3].crop
    assert crop is not None
    assert torch.allclose(crop.to_original(points.points[16], 64), torch.tensor((20.5 + index, 30.5)), atol=1e-3)


def test_apt_36k_paths(tmp_path: Path) -> None:
    moving.apt(tmp_path)
    file = tmp_path / "annotations" / "train_annotations.json"
    table = json.loads(file.read_text())
    for picture in table["images"]:
        number = int(Path(picture["file_name"]).stem)
        picture["file_name"] = f"D:\\Animal_pose\\AP-36k-patr1\\29wölf\\v3c2\\frame{number + 1}.jpg"
    file.unlink()
    (tmp_path / "data").rename(tmp_path / "old")
    (tmp_path / "apt36k_annotations.json").write_text(json.dumps(table))
    for i in range(12):
        moving.save(tmp_path / "29wlf" / "v3c2" / f"frame{i + 1}.jpg", moving.image(i))
        moving.save(tmp_path / "masks" / "29wlf" / "v3c2@3" / f"frame{i + 1}.png", moving.mask(i))
    clip, truth = AptV2(tmp_path).load("29wlf/v3c2@3", SELECTION)
    assert len(clip.frames) + len(truth.held_out) == 12


def test_badja_is_row_then_column(tmp_path: Path) -> None:
    joints = [[0, 0]] * 33 + [[540 - 0.5, 1440 - 0.5]] + [[0, 0]] * 3
    entry = {"image_path": "x/00002.png", "joints": joints, "visibility": [i == 33 for i in range(37)]}
    (tmp_path / "camel.json").write_text(json.dumps([entry]))
    (found,), _ = read_badja(tmp_path / "camel.json", ["00002"], (960, 540))
    assert found is not None
    nose = found.names.index("nose")
    assert found.points[nose].tolist() == [1440 / 1920 * 960, 540 / 1080 * 540]
    assert found.visible.nonzero().flatten().tolist() == [nose]


@pytest.mark.parametrize("dataset", ["davis", "aptv2", "online"])
def test_protocols_of_videos(dataset: str) -> None:
    default = find_protocol(dataset, None)
    assert default.name == f"{dataset}-512-v2"
    small = find_protocol(dataset, f"{dataset}-256-v2")
    assert (default.selection.size, small.selection.size) == (512, 256)
    assert default.selection.split == 5 and default.selection.framing == "crop"


def test_real_camel(davis: Path) -> None:
    reader = Davis(davis)
    clip, truth = reader.load("camel", SELECTION)
    assert (len(clip.frames), len(truth.held_out)) == (90 * 4 / 5, 90 / 5)
    assert not clip.notes
    seen = [frame for frame in clip.frames if frame.keypoints is not None]
    assert len(seen) > 10
    inside = total = 0
    for frame in seen:
        assert frame.keypoints is not None
        at = frame.keypoints.points[frame.keypoints.visible].floor().long().clamp(0, 63)
        grown = torch.nn.functional.max_pool2d(frame.mask[None], 3, 1, 1)[0, 0]
        inside += int((grown[at[:, 1], at[:, 0]] > 0.5).sum())
        total += len(at)
    assert inside / total > 0.98
