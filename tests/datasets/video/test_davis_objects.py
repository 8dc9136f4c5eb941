"""DAVIS 2017 with several objects: which of them is the animal, and masks from elsewhere that name others."""

from pathlib import Path

import moving
import numpy as np
import pytest
from films import SELECTION

from rewild4d.datasets.video.davis import Davis
from rewild4d.errors import UserError

pytestmark = pytest.mark.usefixtures("cache")


def two_objects(folder: Path, ids: tuple[int, int] = (1, 2), mode: str | None = "P") -> None:
    """Masks of an animal at the left and another at the right, by their ids."""
    for i in range(12):
        values = np.where(moving.mask(i) > 0, ids[0], np.where(moving.mask(i, left=65) > 0, ids[1], 0))
        moving.save(folder / f"{i:05d}.png", values.astype(np.uint8), mode)


def sequence(root: Path, name: str, annotations: str = "Annotations") -> Path:
    moving.frames(root / "JPEGImages" / "480p" / name, suffix="jpg")
    two_objects(root / annotations / "480p" / name)
    return root


def test_masks_of_other_objects_alone_are_not_taken(tmp_path: Path) -> None:
    two_objects(tmp_path / "mine" / "pigs", (3, 1))
    reader = Davis(sequence(tmp_path / "data", "pigs"), masks=tmp_path / "mine")
    (first, *_), notes = list(reader.video("pigs@1").masks()), reader.video("pigs@1").notes
    assert first is not None and (first == np.where(moving.mask(0) > 0, 0, moving.mask(0, left=65))).all()
    assert notes == (f"masks of the input from {tmp_path / 'mine' / 'pigs'}",)
    with pytest.raises(
        UserError, match="mine/pigs: expected masks of object 2 for the case pigs@2, got those of 1, 3 "
    ):
        reader.video("pigs@2")
    assert reader.load("pigs", SELECTION)


def test_masks_without_ids_are_taken_whole_and_told(tmp_path: Path) -> None:
    moving.masks(tmp_path / "mine" / "pigs", left=40)
    reader = Davis(sequence(tmp_path / "data", "pigs"), masks=tmp_path / "mine")
    video = reader.video("pigs@2")
    first = next(iter(video.masks()))
    assert first is not None and (first == moving.mask(0, left=40)).all()
    assert "they hold no object ids: all of them is taken as object 2" in video.notes[0]


def test_people_and_geese_are_no_default_cases(tmp_path: Path) -> None:
    for name in ("cat-girl", "dog-gooses", "pigs"):
        sequence(tmp_path, name)
    reader = Davis(tmp_path)
    assert reader.default_cases(SELECTION) == ["cat-girl@2", "dog-gooses@1", "pigs@1", "pigs@2"]
    assert {"cat-girl", "cat-girl@1", "dog-gooses@2"} <= set(reader.cases(SELECTION))
    told = {case: (reader.video(case).species, reader.video(case).notes) for case in reader.cases(SELECTION)}
    assert told["cat-girl@2"] == ("cat", ()) and told["pigs@2"] == ("pig", ())
    assert told["cat-girl@1"] == ("cat-girl@1", ("no cat: object 1 of its masks",))
    assert told["dog-gooses"] == ("dog", ("no dog: object 2 of its masks",))


def test_ids_of_other_annotations_say_nothing_about_the_animal(tmp_path: Path) -> None:
    reader = Davis(sequence(tmp_path, "cat-girl", "Annotations_unsupervised"))
    assert reader.default_cases(SELECTION) == ["cat-girl@1", "cat-girl@2"]
    assert reader.video("cat-girl@1").notes == ()
