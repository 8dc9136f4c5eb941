"""Masks in several parts: which one is the animal, what is kept of it, and who is asked."""

from pathlib import Path

import moving
import numpy as np
import pytest
from films import SELECTION, iou, restored

from rewild4d import cli
from rewild4d.datasets.video.davis import Davis
from rewild4d.datasets.video.online import Online
from rewild4d.datasets.video.parts import NOTE, main_parts, standing_apart
from rewild4d.errors import UserError

pytestmark = pytest.mark.usefixtures("cache")


def blobs(*boxes: tuple[int, int]) -> np.ndarray:
    """Squares from a left edge to a right one, uint8 [30, 80], with a soft rim of two columns on their right."""
    mask = np.zeros((30, 80), dtype=np.uint8)
    for left, right in boxes:
        mask[5 : 5 + right - left, left:right] = 255
        mask[5 : 5 + right - left, right : right + 2] = 90
    return mask


def test_the_part_that_goes_on_is_kept_with_its_rim() -> None:
    lone, other = blobs((10, 20)), blobs((12, 22))
    given = [lone, blobs((12, 22), (50, 70)), None, np.zeros_like(lone), blobs((14, 24), (48, 68))]
    kept = list(main_parts(lambda: iter(given)))
    assert (kept[0] == lone).all()
    assert (kept[1] == other).all(), "the larger part is another animal: it was not there before"
    assert kept[2] is None and not kept[3].any()
    assert (kept[4] == blobs((14, 24))).all(), "a frame without the animal does not lose it"


def test_the_largest_part_starts_and_takes_over() -> None:
    kept = list(main_parts(lambda: iter([blobs((2, 8), (20, 32)), blobs((2, 8), (50, 60))])))
    assert (kept[0] == blobs((20, 32))).all()
    assert (kept[1] == blobs((50, 60))).all(), "nothing goes on from the frame before"


def test_what_stands_apart_is_counted_by_the_animals_length() -> None:
    lone, pole, other = blobs((10, 20)), blobs((10, 14), (15, 20)), blobs((10, 20), (25, 35))
    speck = blobs((10, 20), (40, 41))  # 1 pixel of 100, and 4 of them count
    assert standing_apart(lambda: iter([lone, pole, other, speck, None, np.zeros_like(lone)])) == (1, 4)
    # Cut in two by a trunk: the 3 pixels between are more than a fifth of a half, 8, but not of the animal, 16.
    whole, trunk = blobs((10, 26)), blobs((10, 16), (18, 26))
    assert standing_apart(lambda: iter([whole, trunk, whole])) == (0, 3)
    assert standing_apart(lambda: iter([])) == (0, 0)


def two_animals(folder: Path, count: int = 12) -> None:
    """Overwrite masks so that another animal, two thirds as high, stands to the right of it."""
    for i in range(count):
        second = moving.mask(i, left=60)
        second[: second.shape[0] // 2] = 0
        moving.save(folder / f"{i:05d}.png", moving.mask(i, left=20) | second)


def test_a_video_of_two_animals_is_that_of_one(tmp_path: Path) -> None:
    moving.frames(tmp_path / "clip" / "frames")
    moving.masks(tmp_path / "clip" / "masks")
    two_animals(tmp_path / "clip" / "masks")
    reader = Online(tmp_path / "clip", parts="main")
    clip, truth = reader.load("clip", SELECTION)
    for frame in (*clip.frames, *truth.held_out):
        index = round(frame.time * 25)
        assert iou(restored(frame, moving.SIZE), moving.mask(index, left=20) > 0) > 0.93
    assert f"{NOTE} (--parts main)" in clip.notes and reader.settings["parts"] == "main"
    both = Online(tmp_path / "clip", parts="all")
    assert both.load("clip", SELECTION)[0].digest != clip.digest and both.settings == {"parts": "all"}
    advice = "--parts main keeps to its own"
    assert [advice in "".join(f.message for f in each.check()) for each in (both, reader)] == [True, False]


@pytest.mark.parametrize(("count", "parts"), [(12, "main"), (2, "main"), (1, "all")])
def test_nobody_has_to_ask_where_another_animal_stands_apart(tmp_path: Path, count: int, parts: str) -> None:
    """From a tenth of the masks on."""
    moving.frames(tmp_path / "clip" / "frames")
    moving.masks(tmp_path / "clip" / "masks")
    two_animals(tmp_path / "clip" / "masks", count)
    auto, asked = Online(tmp_path / "clip"), Online(tmp_path / "clip", parts=parts)
    clip = auto.load("clip", SELECTION)[0]
    assert clip.digest == asked.load("clip", SELECTION)[0].digest and auto.settings == {}
    told = f"{count} of 12 masks have a part far from the rest (a second animal?): {NOTE} (--parts all: all)"
    assert (told in clip.notes) == (parts == "main")


def test_what_davis_calls_one_object_is_one_and_so_are_all_objects_together(tmp_path: Path) -> None:
    root = moving.davis(tmp_path)
    annotations = next((root / "Annotations").rglob("camel"))
    two_animals(annotations)
    assert Davis(root).load("camel", SELECTION)[0].digest == Davis(root, parts="all").load("camel", SELECTION)[0].digest
    two_animals(tmp_path / "other" / "camel")
    given = {"masks": tmp_path / "other"}
    one, both = (Davis(root, **given, **more).load("camel", SELECTION)[0] for more in ({}, {"parts": "all"}))
    assert one.digest != both.digest
    for i in range(12):
        ids = moving.mask(i, left=20) // 255 + 2 * (moving.mask(i, left=60) // 255)
        moving.save(tmp_path / "other" / "camel" / f"{i:05d}.png", ids.astype(np.uint8), "P")
    one, both = (Davis(root, **given, **more).load("camel", SELECTION)[0] for more in ({}, {"parts": "all"}))
    assert one.digest == both.digest


def test_held_out_frames_of_davis_are_judged_by_its_own_masks(tmp_path: Path) -> None:
    root = moving.davis(tmp_path)
    own = Davis(root).load("camel", SELECTION)[1]
    two_animals(tmp_path / "other" / "camel")
    for options in ({}, {"masks": tmp_path / "other"}):
        clip, truth = Davis(root, parts="main", **options).load("camel", SELECTION)
        assert f"{NOTE} (--parts main)" in clip.notes
        for mine, theirs in zip(truth.held_out, own.held_out, strict=True):
            assert iou(restored(mine, moving.SIZE), restored(theirs, moving.SIZE)) > 0.93


def test_another_word_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    moving.frames(tmp_path / "clip" / "frames")
    moving.masks(tmp_path / "clip" / "masks")
    with pytest.raises(UserError, match="unknown choice of --parts 'largest'.* all, auto, main"):
        Online(tmp_path / "clip", parts="largest").load("clip", SELECTION)
    with pytest.raises(SystemExit) as stop:
        cli.main(["check", "--dataset", "artemis", "--parts", "main"])
    assert stop.value.code == 2
    assert "--parts: the data set 'artemis' does not take it" in capsys.readouterr().err


@pytest.mark.parametrize("parts", ["main", "auto"])
def test_a_held_out_mask_decides_nothing_for_others(tmp_path: Path, parts: str) -> None:
    """The animal that is followed is missing in the mask of one held-out frame alone."""
    digests = []
    for name in ("whole", "without"):
        moving.frames(tmp_path / name / "clip" / "frames")
        moving.masks(tmp_path / name / "clip" / "masks")
        two_animals(tmp_path / name / "clip" / "masks")
        if name == "without":
            other = moving.mask(7, left=60)
            other[: other.shape[0] // 2] = 0
            moving.save(tmp_path / name / "clip" / "masks" / "00007.png", other)
        clip, truth = Online(tmp_path / name / "clip", parts=parts).load("clip", SELECTION)
        assert 7 in [round(frame.time * 25) for frame in truth.held_out]
        digests.append(clip.digest)
    assert digests[0] == digests[1]
