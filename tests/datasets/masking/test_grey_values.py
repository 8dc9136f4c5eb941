"""What grey values of masks mean: one value is the animal, several are objects, a soft matte stays one."""

from pathlib import Path

import cv2
import moving
import numpy as np
import pytest
from films import SELECTION

from rewild4d.datasets.masking.masks import MaskFiles, open_masks
from rewild4d.datasets.video.davis import Davis
from rewild4d.datasets.video.online import Online

pytestmark = pytest.mark.usefixtures("cache")

INSIDE = moving.mask(0)
OTHER = np.roll(INSIDE, 40, axis=1)
"""A second animal, 40 pixels to the right of the first."""


def values(first: int, second: int = 0, dtype: type = np.uint8) -> np.ndarray:
    return np.where(INSIDE > 0, first, np.where(OTHER > 0, second, 0)).astype(dtype)


def opened(folder: Path, *images: np.ndarray, suffix: str = "png") -> MaskFiles:
    return open_masks([moving.save(folder / f"{i}.{suffix}", image) for i, image in enumerate(images)])


def read(masks: MaskFiles, object_id: int | None = None, index: int = 0) -> np.ndarray:
    found = masks.read(index, object_id, moving.SIZE)
    assert found is not None and found.dtype == np.uint8
    return found


@pytest.mark.parametrize(
    ("value", "dtype"),
    [(128, np.uint8), (38, np.uint8), (100, np.uint8), (40, np.uint8), (200, np.uint8), (254, np.uint8),
     (100, np.uint16), (2001, np.uint16), (24001, np.uint16), (40000, np.uint16)],
)  # fmt: skip
def test_the_one_value_of_a_folder_is_the_animal(value: int, dtype: type, tmp_path: Path) -> None:
    masks = opened(tmp_path, values(value, dtype=dtype), values(0, dtype=dtype))
    assert (read(masks) == INSIDE).all() and not read(masks, index=1).any()
    assert masks.ids == (value,)
    assert masks.meaning.note == f"masks hold one value, {value}: taken as the animal"


@pytest.mark.parametrize(("value", "dtype"), [(255, np.uint8), (1, np.uint8), (255, np.uint16), (65535, np.uint16)])
def test_usual_values_need_no_note(value: int, dtype: type, tmp_path: Path) -> None:
    masks = opened(tmp_path, values(value, dtype=dtype))
    assert (read(masks) == INSIDE).all() and masks.meaning.note == ""


@pytest.mark.parametrize(
    ("first", "second", "dtype"),
    [(38, 75, np.uint8), (75, 38, np.uint8), (40, 41, np.uint8), (128, 255, np.uint8), (24001, 25003, np.uint16),
     (24001, 24002, np.uint16), (300, 65535, np.uint16)],
)  # fmt: skip
def test_several_values_are_objects(first: int, second: int, dtype: type, tmp_path: Path) -> None:
    masks = opened(tmp_path, values(first, second, dtype))
    assert masks.ids == (min(first, second), max(first, second))
    assert (read(masks, first) == INSIDE).all()
    assert (read(masks, second) == np.where(INSIDE > 0, 0, OTHER)).all()
    assert (read(masks) == np.maximum(INSIDE, OTHER)).all()
    told = f"masks hold 2 values ({min(first, second)}, {max(first, second)}): taken as numbers of objects"
    assert masks.meaning.note == told


def test_objects_with_blurred_edges_stay_objects(tmp_path: Path) -> None:
    blurred = cv2.GaussianBlur(values(38, 75), (3, 3), 0)
    masks = opened(tmp_path, blurred)
    assert len(np.unique(blurred)) > 10 and masks.ids == (38, 75)
    assert (read(masks, 38) == np.where(blurred == 38, 255, 0)).all()


def test_what_mots_ignores_is_no_animal(tmp_path: Path) -> None:
    masks = opened(tmp_path, values(2001, 10000, np.uint16))
    assert masks.ids == (2001,) and (read(masks) == INSIDE).all()
    assert "masks hold 10000, which MOTS ignores: taken for no animal" in masks.meaning.note
    # of a folder that is not MOTS's, it is a value like any other
    assert opened(tmp_path, values(12, 10000, np.uint16)).ids == (12, 10000)


def test_soft_mattes_are_as_they_are(tmp_path: Path) -> None:
    soft = cv2.GaussianBlur(INSIDE, (0, 0), 2)
    masks = opened(tmp_path, soft)
    assert masks.ids == () and masks.meaning.note == "" and (read(masks) == soft).all()
    deep = soft.astype(np.uint16) * 257  # 65535 = 255 * 257
    masks = opened(tmp_path, deep)
    assert masks.ids == () and masks.meaning.note == "" and (read(masks) == soft).all()


def test_a_soft_matte_of_another_white_reaches_it(tmp_path: Path) -> None:
    half = cv2.GaussianBlur(values(100), (3, 3), 0)
    masks = opened(tmp_path, half)
    assert masks.ids == () and (read(masks) == np.rint(half / 100 * 255)).all()
    assert masks.meaning.note == "masks reach 100 of 255: taken as the inside of the animal"


@pytest.mark.parametrize("white", [255, 128, 100, 38])
def test_compression_is_no_object(white: int, tmp_path: Path) -> None:
    masks = opened(tmp_path, values(white), suffix="jpg")
    assert masks.ids == () and ((read(masks) > 127) == (INSIDE > 0)).mean() > 0.99
    noise = np.random.default_rng(0).integers(-3, 4, INSIDE.shape)
    masks = opened(tmp_path / "film", np.clip(values(white).astype(int) + noise, 0, 255).astype(np.uint8))
    assert masks.ids == () and ((read(masks) > 127) == (INSIDE > 0)).all()


def test_a_video_says_what_its_masks_were_taken_for(tmp_path: Path) -> None:
    frames = moving.frames(tmp_path / "f", count=5)
    for i in range(5):
        moving.save(tmp_path / "one" / f"{i:05d}.png", moving.mask(i) // 255 * 38)
        moving.save(tmp_path / "two" / f"{i:05d}.png", values(38, 75))
    video = Online(frames, masks=tmp_path / "one").video("f")
    assert "masks hold one value, 38: taken as the animal" in video.notes
    found = list(video.masks())[2]
    assert found is not None and (found == moving.mask(2)).all()
    reader = Online(frames, masks=tmp_path / "two")
    assert reader.cases(SELECTION) == ["f", "f@38", "f@75"]
    told = "masks hold 2 values (38, 75): taken as numbers of objects, of which this case takes"
    assert f"{told} object 75 (--case)" in reader.video("f@75").notes
    assert f"{told} all of them (--case)" in reader.video("f").notes
    found = list(reader.video("f@75").masks())[0]
    assert found is not None and (found == np.where(INSIDE > 0, 0, OTHER)).all()


@pytest.mark.parametrize("white", [255, 128])
def test_a_film_of_masks_reaches_its_white(white: int, tmp_path: Path) -> None:
    frames = moving.frames(tmp_path / "f", count=5)
    for i in range(5):
        moving.save(tmp_path / "m" / f"{i:05d}.png", np.repeat((moving.mask(i) // 255 * white)[..., None], 3, axis=2))
    film = moving.film(tmp_path / "m.mp4", tmp_path / "m", "-crf", 10, "-pix_fmt", "yuv420p")
    video = Online(frames, masks=film).video("f")
    for index, found in enumerate(video.masks()):
        assert found is not None and ((found > 127) == (moving.mask(index) > 0)).mean() > 0.99
    assert any("taken as the inside of the animal" in note for note in video.notes) == (white == 128)


def test_frames_whose_animal_is_half_transparent(tmp_path: Path) -> None:
    for i in range(5):
        moving.save(tmp_path / "rgba" / f"{i}.png", np.dstack((moving.image(i), moving.mask(i) // 255 * 100)))
    video = Online(tmp_path / "rgba").video("rgba")
    found = list(video.masks())[3]
    assert found is not None and (found == moving.mask(3)).all()
    told = "masks are the frames' alpha channel; masks reach 100 of 255: taken as the inside of the animal"
    assert told in video.notes


def test_davis_of_grey_128(tmp_path: Path) -> None:
    reader = Davis(moving.davis(tmp_path, values=(0, 128), mode="L"))
    assert reader.cases(SELECTION) == ["camel"]
    video = reader.video("camel")
    found = next(iter(video.masks()))
    assert found is not None and (found == moving.mask(0)).all()
    assert "masks hold one value, 128: taken as the animal" in video.notes
