"""Masks whose objects have colours: one colour is the animal, several are objects, shades are neither."""

from pathlib import Path

import numpy as np
from PIL import Image

from rewild4d.datasets.masking.masks import open_masks

RED, GREEN, WHITE = (128, 0, 0), (0, 128, 0), (224, 224, 224)
SIZE = (8, 6)


def written(folder: Path, *frames: dict[tuple[int, int, int], slice]) -> list[Path]:
    """Images of black with columns of some colours, one for each frame."""
    paths = []
    for number, columns in enumerate(frames):
        pixels = np.zeros((SIZE[1], SIZE[0], 3), np.uint8)
        for color, where in columns.items():
            pixels[:, where] = color
        paths.append(folder / f"{number}.png")
        Image.fromarray(pixels).save(paths[-1])
    return paths


def areas(files: list[Path], object_id: int | None) -> list[int]:
    masks = open_masks(files)
    found = [masks.read(index, object_id, SIZE) for index in range(len(files))]
    return [int((mask == 255).sum()) for mask in found if mask is not None]


def test_two_colours_are_two_objects_in_every_frame(tmp_path: Path) -> None:
    files = written(tmp_path, {RED: slice(0, 2), GREEN: slice(2, 5)}, {RED: slice(0, 3)}, {GREEN: slice(4, 5)})
    masks = open_masks(files)
    assert masks.ids == (1, 2)  # 0x008000 is green, 0x800000 red
    assert areas(files, 1) == [3 * 6, 0, 1 * 6] and areas(files, 2) == [2 * 6, 3 * 6, 0]
    assert areas(files, None) == [5 * 6, 3 * 6, 1 * 6]
    assert masks.meaning.note == (
        "masks hold 2 colours: taken as numbers of objects (1 is (0, 128, 0), 2 is (128, 0, 0))"
    )


def test_one_colour_is_the_animal(tmp_path: Path) -> None:
    files = written(tmp_path, {RED: slice(0, 2), (9, 20, 3): slice(4, 6)}, {RED: slice(0, 3)})
    assert open_masks(files).ids == () and areas(files, None) == [2 * 6, 3 * 6]


def test_a_grey_beside_two_colours_is_an_object_and_greys_alone_are_shades(tmp_path: Path) -> None:
    (tmp_path / "a").mkdir(), (tmp_path / "b").mkdir()
    files = written(tmp_path / "a", {RED: slice(0, 2), GREEN: slice(2, 5), WHITE: slice(5, 6)})
    assert open_masks(files).ids == (1, 2, 3)
    greys = written(tmp_path / "b", {WHITE: slice(0, 3), (90, 90, 90): slice(3, 4), RED: slice(7, 8)})
    assert open_masks(greys).colors == ()


def test_soft_edges_are_no_objects(tmp_path: Path) -> None:
    files = written(tmp_path, {(255 - 7 * step, 7 * step, 0): slice(0, 8) for step in range(2)})
    ramp = np.zeros((SIZE[1], SIZE[0], 3), np.uint8)
    ramp[..., 0] = 40 + 4 * np.arange(48).reshape(6, 8)
    Image.fromarray(ramp).save(files[0])
    assert open_masks(files).colors == ()
