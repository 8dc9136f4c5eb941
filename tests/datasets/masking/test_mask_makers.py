"""Masks where there are none: programs through folders, the rough way, and the networks' plumbing."""

import sys
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace

import moving
import numpy as np
import pytest
import torch
from films import SELECTION, iou

from rewild4d import cli
from rewild4d.datasets.masking.grabcut import rough_masks
from rewild4d.datasets.masking.grounded_sam import Networks, fill_box, find_box, grounded_masks, overlap, prepared
from rewild4d.datasets.masking.makers import Unmasked, parse_boxes, run_program, write_masks
from rewild4d.datasets.video.aptv2 import AptV2
from rewild4d.datasets.video.online import Online
from rewild4d.errors import UserError

pytestmark = pytest.mark.usefixtures("cache")

CPU = torch.device("cpu")
COPY = """
import sys, cv2, pathlib
for file in sorted(pathlib.Path(sys.argv[1]).iterdir()):
    red = cv2.imread(str(file))[..., 2]
    cv2.imwrite(str(pathlib.Path(sys.argv[2]) / file.name), ((red > 150) * 255).astype("uint8"))
"""


def source(
    frames: int = 12, size: tuple[int, int] = moving.SIZE, **boxes: tuple[float, float, float, float]
) -> Unmasked:
    known = {int(name.removeprefix("at")): box for name, box in boxes.items()}
    stems = tuple(f"{i:05d}" for i in range(frames))
    return Unmasked("film", stems, size, lambda: (moving.image(i, size) for i in range(frames)), known)


def test_the_rough_way_follows_a_plain_animal(tmp_path: Path) -> None:
    size = (384, 256)
    found = list(rough_masks(source(8, size, at0=(20, 80, 140, 124))))
    for i, mask in enumerate(found):
        assert mask.shape == (256, 384)
        assert iou(mask > 127, moving.mask(i, size) > 0) > 0.9


def test_the_rough_way_starts_at_its_box_and_needs_one() -> None:
    found = list(rough_masks(source(4, at2=(6, 20, 32, 28))))
    assert not found[0].any() and not found[1].any() and found[2].any()
    with pytest.raises(UserError, match="the rough masks need a box around the animal"):
        list(rough_masks(source()))
    with pytest.raises(UserError, match="expected a box inside the frame of 96 pixels width"):
        list(rough_masks(source(4, at0=(200, 20, 32, 28))))


def test_an_animal_that_is_gone_has_empty_masks() -> None:
    pictures = [moving.image(i) for i in range(3)] + [moving.image(0, left=-60)] * 3
    film = Unmasked("film", tuple("abcdef"), moving.SIZE, lambda: iter(pictures), {0: (6, 20, 32, 28)})
    found = list(rough_masks(film))
    assert found[2].any() and not found[4].any() and not found[5].any()


def test_any_program_through_folders(tmp_path: Path) -> None:
    script = tmp_path / "red parts.py"
    script.write_text(COPY)
    maker = run_program(f"{sys.executable} '{script}' {{frames}} {{masks}}")
    told: list[int] = []
    paths, empty = write_masks(source(), maker, tmp_path / "out", lambda done, _: told.append(done))
    assert told == [0, 1, 1, 2, 2, 3, 3, 4, 4, 5, 5, 6, *[6] * 6, *range(7, 13)], "half is done when frames are written"
    assert [path.name for path in paths] == [f"{i:05d}.png" for i in range(12)] and empty == 0
    assert (next(iter(maker(source()))) == moving.mask(0)).all()


def test_a_maker_whose_masks_come_late_tells_how_much_is_done(tmp_path: Path) -> None:
    told: list[tuple[int, int]] = []

    def late(film: Unmasked) -> Iterator[np.ndarray]:
        masks = []
        for number, image in enumerate(film.images(), 1):
            masks.append(np.zeros(image.shape[:2], np.uint8))
            film.log(0.6 * number / 4)
        yield from masks

    def blind(film: Unmasked) -> Iterator[np.ndarray]:
        yield from (np.zeros((8, 8), np.uint8) for _ in film.stems)

    write_masks(source(4), late, tmp_path, lambda *counts: told.append(counts))
    assert told == [(done, 4) for done in (0, 1, 1, 2, 2, 2, 3, 4)], "0.15 of 4 each, then four are written"
    told.clear()
    write_masks(source(3), blind, tmp_path, lambda *counts: told.append(counts))
    assert told == [(1, 3), (2, 3), (3, 3)]
    told.clear()
    write_masks(source(49), blind, tmp_path, lambda *counts: told.append(counts))
    assert told == [(done, 49) for done in range(1, 50)], "1 / 49 * 49 is less than 1"


@pytest.mark.parametrize(
    ("command", "sentence"),
    [
        ("mytool {frames}", "expected a command line with {frames} and {masks} in it, got 'mytool {frames}'"),
        ("mytool {frames} {masks} {frames.y}", "expected a command line with {frames}, {masks}, {boxes} in it"),
        ("mytool {frames} {masks} {boxes[0]}", "expected a command line with {frames}, {masks}, {boxes} in it"),
        ("mytool {frames} {out}", "expected a command line with {frames}, {masks}, {boxes} in it"),
        (
            "/no/such/tool {frames} {masks}",
            "--command: expected a program that can be started, but '/no/such/tool': No such file",
        ),
        ("sh -c 'echo no GPU >&2; exit 3' {frames} {masks}", "ended with status 3 and said: no GPU"),
        ("sh -c 'true' {frames} {masks}", "sh: expected a mask for each of 12 frames, but it wrote none"),
        ("sh -c 'cp $0/00000.png $1/' {frames} {masks}", "expected a mask for each of 12 frames, but 11 are missing"),
    ],
)
def test_programs_that_do_not_work(command: str, sentence: str) -> None:
    with pytest.raises(UserError) as error:
        list(run_program(command)(source()))
    assert sentence in str(error.value)


def test_a_program_that_does_not_end_is_ended(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(UserError, match="^sh: expected an end within 0.2 s, but it was still running; --timeout"):
        list(run_program("sh -c 'sleep 60' {frames} {masks}", timeout=0.2)(source()))
    words = ["masks", "--video", str(tmp_path), "--out", str(tmp_path / "m"), "--tool", "program", "--command"]
    with pytest.raises(SystemExit) as stop:
        cli.main([*words, "x {frames} {masks}", "--timeout", "0"])
    assert stop.value.code == 2
    assert "--timeout: expected more than 0 seconds, got 0." in capsys.readouterr().err


def test_boxes_of_the_command_line() -> None:
    stems = tuple(f"{number:05d}" for number in range(120, 129))
    found = parse_boxes(("1,2,3,4", "127:5,6,7,8.5", "00121:1,1,1,1"), stems)
    assert found == {0: (1, 2, 3, 4), 7: (5, 6, 7, 8.5), 1: (1, 1, 1, 1)}, "frames have the film's numbers"
    assert parse_boxes(("2:1,2,3,4",), ("shot1_000", "shot1_002")) == {1: (1, 2, 3, 4)}
    for text in ("1,2,3", "1,2,3,y"):
        with pytest.raises(UserError, match="--box: expected left,top,width,height or frame:left"):
            parse_boxes((text,), stems)
    for text in ("1,2,0,4", "7:1,2,3,4", "x:1,2,3,4", "nan,2,3,4", "1,-inf,3,4", "1,2,inf,4"):
        with pytest.raises(UserError, match="expected a box with a size, in a frame from 00120 to 00128, got "):
            parse_boxes((text,), stems)


def test_the_command_makes_masks_that_run_reads(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    moving.frames(tmp_path / "clip", size=(192, 128))
    words = ["masks", "--video", str(tmp_path / "clip"), "--out", str(tmp_path / "m"), "--box", "10,40,70,64"]
    words += ["--tool", "rough"]
    with pytest.raises(SystemExit) as stop:
        cli.main(words)
    assert stop.value.code == 0
    assert "12 masks by 'rough', 0 of them without the animal" in capsys.readouterr().out
    clip, truth = Online(tmp_path / "clip", masks=tmp_path / "m").load("clip", SELECTION)
    assert len(clip.frames) + len(truth.held_out) == 12
    with pytest.raises(SystemExit):
        cli.main([*words, "--end", "0.2"])  # six frames at 25 a second
    assert "it holds 6 other masks, which readers take too: remove them?" in capsys.readouterr().err
    for words, sentence in (
        (["--tool", "rogh"], "unknown tool 'rogh'. Did you mean 'rough'?"),
        (["--tool", "program"], "--command: expected a command line with {frames} and {masks} in it, got none"),
    ):
        with pytest.raises(SystemExit) as stop:
            cli.main(["masks", "--video", str(tmp_path / "clip"), "--out", str(tmp_path / "m"), *words])
        assert stop.value.code == 2
        assert sentence in capsys.readouterr().err


def test_apt_boxes_start_the_masks(tmp_path: Path) -> None:
    root = moving.apt(tmp_path, with_masks=False)
    case = "easy/29wolf/v1C1@3"
    film = AptV2(root).unmasked(case)
    assert film.boxes[3] == (8, 22, 30, 26)
    write_masks(film, rough_masks, tmp_path / "masks" / case)
    clip, truth = AptV2(root).load(case, SELECTION)
    assert len(clip.frames) + len(truth.held_out) == 12


class Found:
    """A detector that finds two boxes whatever it sees."""

    def __init__(self, scores: tuple[float, float]) -> None:
        self.scores = torch.tensor(scores)

    def __call__(self, pixel_values: torch.Tensor, **_: object) -> SimpleNamespace:
        self.shape = tuple(pixel_values.shape)
        logits = torch.full((1, 2, 5), -20.0)
        logits[0, :, 2] = self.scores.logit()
        return SimpleNamespace(logits=logits, pred_boxes=torch.tensor([[[0.25, 0.5, 0.2, 0.4], [0.75, 0.5, 0.2, 0.4]]]))


class Filled:
    """A segmenter that fills its box."""

    config = SimpleNamespace(prompt_encoder_config=SimpleNamespace(image_size=64))

    def __call__(self, pixel_values: torch.Tensor, input_boxes: torch.Tensor, **_: object) -> SimpleNamespace:
        left, top, right, bottom = input_boxes[0, 0].tolist()
        y, x = torch.meshgrid(torch.arange(64) + 0.5, torch.arange(64) + 0.5, indexing="ij")
        inside = (x > left) & (x < right) & (y > top) & (y < bottom)
        return SimpleNamespace(pred_masks=torch.where(inside, 9.0, -9.0)[None, None, None])


class Words(dict):  # type: ignore[type-arg]
    def to(self, _: torch.device) -> "Words":
        return self


def networks(*scores: float) -> Networks:
    return Networks(Found((scores[0], scores[1])), lambda text, return_tensors: Words(), Filled(), CPU)


def test_boxes_are_chosen_by_score_and_by_the_frame_before() -> None:
    image = moving.image(0)
    first = find_box(networks(0.5, 0.6), image, "wolf.", None)
    assert first is not None and first.tolist() == pytest.approx([0.65 * 96, 0.3 * 64, 0.85 * 96, 0.7 * 64])
    kept = find_box(networks(0.5, 0.6), image, "wolf.", torch.tensor((14.0, 19.0, 34.0, 45.0)))
    assert kept is not None and kept.tolist() == pytest.approx([0.15 * 96, 0.3 * 64, 0.35 * 96, 0.7 * 64])
    assert find_box(networks(0.1, 0.2), image, "wolf.", None) is None
    other = networks(0.5, 0.6)
    find_box(other, np.zeros((720, 1280, 3), np.uint8), "wolf.", None)
    assert other.detector.shape == (1, 3, 750, 1333)  # 800 would make the longer side 1422


def test_a_box_is_filled_in_the_frames_own_pixels() -> None:
    mask = fill_box(networks(0, 0), moving.image(0), torch.tensor((24.0, 16.0, 72.0, 48.0)))
    expected = np.zeros((64, 96), bool)
    expected[16:48, 24:72] = True
    assert iou(mask > 0, expected) > 0.97


def test_overlap_and_preparation() -> None:
    boxes = torch.tensor(((0.0, 0, 2, 2), (1, 1, 3, 3), (5, 5, 6, 6)))
    assert overlap(boxes, boxes[0]).tolist() == pytest.approx([1, 1 / 7, 0])
    grey = prepared(np.full((4, 6, 3), 255, np.uint8), (3, 2), CPU)
    assert grey.shape == (1, 3, 2, 3)
    assert grey[0, :, 0, 0].tolist() == pytest.approx([(1 - 0.485) / 0.229, (1 - 0.456) / 0.224, (1 - 0.406) / 0.225])


def test_without_transformers_it_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "transformers", None)
    with pytest.raises(UserError, match=r"expected the package transformers .* pip install -e '\.\[masks\]'"):
        grounded_masks("wolf")


def test_tiny_networks_of_transformers(tmp_path: Path) -> None:
    """Random weights, so only the plumbing is tested: saved, loaded by name, run, masks of the right size."""
    transformers = pytest.importorskip("transformers", reason="the extra 'masks' is not installed")
    from tiny_networks import save_tiny

    save_tiny(tmp_path, transformers)
    maker = grounded_masks("wolf", str(tmp_path / "dino"), str(tmp_path / "sam"))
    film = source(2, at0=(6, 20, 32, 28))
    masks = list(maker(film))
    assert [mask.shape for mask in masks] == [(64, 96), (64, 96)]
    assert all(set(np.unique(mask)) <= {0, 255} for mask in masks)
    with pytest.raises(UserError, match="expected a model that loads from the folder, but"):
        grounded_masks("wolf", str(tmp_path), str(tmp_path / "sam"))
