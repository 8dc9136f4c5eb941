"""Strokes and whole masks of single frames: their files, what they change, and masks that are followed from them."""

from pathlib import Path

import cv2
import moving
import numpy as np
import pytest
from calling import call, refusal
from films import iou
from PIL import Image

from rewild4d.datasets.masking import tracking
from rewild4d.datasets.masking.correcting import corrected
from rewild4d.datasets.masking.makers import Unmasked
from rewild4d.datasets.masking.marks import read_marks, resized, write_marks
from rewild4d.datasets.masking.tracking import track_masks
from rewild4d.errors import UserError

SIZE = (192, 128)
STEMS = tuple(f"{100 + number:05d}" for number in range(8))


@pytest.fixture
def network(monkeypatch: pytest.MonkeyPatch) -> None:
    """Red things stand out, and no weights are needed."""
    monkeypatch.setattr(tracking, "is_here", lambda _: True)
    monkeypatch.setattr(tracking, "load_weights", lambda _: None)
    monkeypatch.setattr(tracking, "Saliency", lambda _: red)


def red(image: np.ndarray) -> np.ndarray:
    return cv2.GaussianBlur((image[..., 0] > 150).astype(np.float32), (0, 0), 1.0)


def picture(number: int, *, neighbour: bool = False) -> np.ndarray:
    """A frame of an animal that walks to the right, on textured ground; a neighbour of its colours stands ahead."""
    image = moving.image(number, SIZE).astype(int)
    if neighbour:
        image[60:90, 130:170] = image[moving.mask(number, SIZE) > 0].mean(axis=0)
    noise = np.random.default_rng(0).integers(0, 30, image.shape[:2])[..., None]
    return np.clip(image + noise, 0, 255).astype(np.uint8)


def true(number: int) -> np.ndarray:
    return moving.mask(number, SIZE) > 0


def whole(number: int) -> np.ndarray:
    return np.where(true(number), 1, -1).astype(np.int8)


def strokes(on: tuple[int, int, int, int] | None = None, off: tuple[int, int, int, int] | None = None) -> np.ndarray:
    """Rectangles (left, top, right, bottom) as strokes."""
    said = np.zeros(SIZE[::-1], np.int8)
    for sign, place in ((1, on), (-1, off)):
        if place is not None:
            said[place[1] : place[3], place[0] : place[2]] = sign
    return said


def followed(pictures: list[np.ndarray], marks: dict[int, np.ndarray]) -> list[np.ndarray]:
    source = Unmasked("film", STEMS[: len(pictures)], SIZE, lambda: iter(pictures), {}, marks)
    return [mask > 0 for mask in track_masks(source)]


@pytest.mark.usefixtures("network")
@pytest.mark.parametrize("place", [0, 4, 7])
def test_a_whole_mask_on_any_frame_is_kept_and_followed(place: int) -> None:
    masks = followed([picture(number) for number in range(8)], {place: whole(place)})
    assert iou(masks[place], true(place)) == 1
    assert min(iou(mask, true(number)) for number, mask in enumerate(masks)) > 0.9


@pytest.mark.usefixtures("network")
def test_of_two_marked_frames_each_is_followed_to_the_middle() -> None:
    """The second mask lacks the animal's right half: frames nearer to it lack it, too, the others do not."""
    half = whole(6)
    half[:, int(np.nonzero(true(6))[1].mean()) :] = -1
    masks = followed([picture(number) for number in range(8)], {0: whole(0), 6: half})
    assert min(iou(masks[number], true(number)) for number in (0, 1, 2, 3)) > 0.9
    assert max(masks[number].sum() / true(number).sum() for number in (5, 6)) < 0.75


@pytest.mark.usefixtures("network")
def test_strokes_choose_the_animal_and_take_its_neighbour_away() -> None:
    pictures = [picture(number, neighbour=True) for number in range(8)]
    chosen = followed(pictures, {0: strokes(on=(30, 60, 50, 66))})
    assert iou(chosen[0], true(0)) > 0.85, "what the stroke touches, not what stands out beside it"
    both = whole(0)
    both[60:90, 130:170] = 1
    spoilt = followed(pictures, {0: both})
    assert spoilt[4][60:90, 130:170].mean() > 0.9
    mended = followed(pictures, {0: both, 4: strokes(off=(140, 70, 160, 80))})
    assert mended[7][60:90, 130:170].mean() < 0.1 and mended[3][60:90, 130:170].mean() < 0.1, "on and back from there"
    assert iou(mended[7], true(7)) > 0.85


@pytest.mark.usefixtures("network")
def test_strokes_need_one_on_the_animal_to_begin_with() -> None:
    with pytest.raises(UserError, match="film: the first marked frame, 00101, has no stroke on the animal; draw one, "):
        followed([picture(number) for number in range(3)], {1: strokes(off=(0, 0, 10, 10))})


def test_a_correction_is_carried_to_an_edge_and_no_further() -> None:
    image = np.full((80, 160, 3), 60, np.uint8)
    image[:, 80:] = 180
    chance = np.full((80, 160), 0.3, np.float32)
    found = corrected(image, chance, strokes_of((80, 160), 1, (60, 30, 70, 50)))
    assert found[40, 65] == 1 and found[30:50, 50:79].min() > 0.5
    assert np.abs(found[:, 82:] - 0.3).max() < 0.02, "beyond the edge it stays"
    assert np.array_equal(corrected(image, chance, np.zeros((80, 160), np.int8)), chance)
    assert set(np.unique(corrected(image, chance, np.where(chance > 0, 1, -1)))) == {1.0}


def strokes_of(shape: tuple[int, int], sign: int, place: tuple[int, int, int, int]) -> np.ndarray:
    said = np.zeros(shape, np.int8)
    said[place[1] : place[3], place[0] : place[2]] = sign
    return said


def test_marks_are_the_same_after_writing_and_reading(tmp_path: Path) -> None:
    marks = {0: strokes((10, 10, 20, 12), (50, 50, 60, 53)), 3: whole(3)}
    files = write_marks(marks, STEMS, tmp_path / "marks")
    assert [file.name for file in files] == ["00100.png", "00103.png"]
    again = read_marks(tmp_path / "marks", STEMS, SIZE)
    assert again.keys() == marks.keys() and all(np.array_equal(again[place], marks[place]) for place in marks)
    assert all(said.dtype == np.int8 for said in again.values())


def test_a_mask_may_have_a_palette_and_another_size(tmp_path: Path) -> None:
    image = Image.fromarray(np.repeat(np.repeat(true(0).astype(np.uint8), 2, 0), 2, 1), "P")
    image.putpalette((0, 0, 0, 128, 0, 0))  # as in DAVIS
    image.save(tmp_path / "100.png")
    assert np.array_equal(read_marks(tmp_path, STEMS, SIZE)[0], whole(0))
    thin = strokes_of((256, 384), 1, (100, 100, 200, 102))
    assert (resized(thin, SIZE) == 1).sum() >= 50, "thin strokes stay"


def test_marks_that_say_nothing_or_of_no_frame_are_refused(tmp_path: Path) -> None:
    def reading(name: str, image: np.ndarray) -> str:
        folder = tmp_path / name
        folder.mkdir()
        cv2.imwrite(str(folder / f"{name}.png"), image)
        with pytest.raises(UserError) as caught:
            read_marks(folder, STEMS, SIZE)
        return str(caught.value)

    blue = np.zeros((128, 192, 3), np.uint8)
    blue[:20] = (255, 0, 0)
    assert "expected green strokes on the animal and red ones beside it, or a mask" in reading("100", blue)
    assert "got neither" in reading("101", np.zeros((128, 192), np.uint8))
    assert "expected the name of a frame from 00100 to 00107, got '7'" in reading("7", blue)
    green = np.zeros((50, 200, 3), np.uint8)
    green[:20] = (0, 255, 0)
    assert "expected a mask of 192x128 pixels like its frame (or of that shape), got 200x50" in reading("103", green)
    with pytest.raises(UserError, match="expected images named as the frames"):
        (tmp_path / "none").mkdir()
        read_marks(tmp_path / "none", STEMS, SIZE)


def test_the_command_takes_marks(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Without the network a whole mask gives the rough masks their box."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(tracking, "is_here", lambda _: False)
        moving.frames(tmp_path / "clip", size=SIZE)
        cv2.imwrite(str(tmp_path / "marks.png"), moving.mask(0, SIZE))
        (tmp_path / "marks").mkdir()
        first = sorted((tmp_path / "clip").iterdir())[0].stem
        cv2.imwrite(str(tmp_path / "marks" / f"{first}.png"), moving.mask(0, SIZE))
        words = ("masks", "--video", str(tmp_path / "clip"), "--out", str(tmp_path / "m"))
        assert call(*words, "--marks", str(tmp_path / "marks")) == 0
        assert "12 masks by 'track', 0 of them without the animal" in capsys.readouterr().out
        made = np.asarray(Image.open(tmp_path / "m" / f"{first}.png"))
        assert (made == moving.mask(0, SIZE)).all(), "what is told stays"
        said = refusal(capsys, *words, "--tool", "rough", "--marks", str(tmp_path / "marks"))
        assert "--marks: only --tool track takes marks, got --tool rough." in said
        assert "expected a folder of images" in refusal(capsys, *words, "--marks", str(tmp_path / "nowhere"))


@pytest.mark.usefixtures("network")
def test_a_frame_that_is_all_surroundings_loses_the_animal() -> None:
    none = np.full(SIZE[::-1], -1, np.int8)
    meadow = moving.image(0, SIZE, left=-60)
    masks = followed([picture(0), picture(1), meadow, meadow], {0: whole(0), 2: none})
    assert masks[0].any() and not masks[2].any() and not masks[3].any()
