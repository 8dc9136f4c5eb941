"""Mask files as cameras, printers and programs write them: one meaning each, or one sentence."""

from pathlib import Path

import cv2
import moving
import numpy as np
import pytest
from films import SELECTION
from one_mask import read_values
from PIL import Image

from rewild4d.datasets.masking.masks import list_images, open_masks
from rewild4d.datasets.video.davis import Davis
from rewild4d.datasets.video.online import Online
from rewild4d.errors import UserError

pytestmark = pytest.mark.usefixtures("cache")

INSIDE = moving.mask(0)


def agreement(values: np.ndarray) -> float:
    return float(((values > 127) == (INSIDE > 0)).mean())


def test_noise_around_a_coloured_animal_is_no_animal(tmp_path: Path) -> None:
    red = np.where(INSIDE[..., None] > 0, np.array((255, 0, 0), np.uint8), np.uint8(0))
    Image.fromarray(red).save(tmp_path / "m.jpg", quality=85)
    assert (np.asarray(Image.open(tmp_path / "m.jpg")).any(axis=2) != (INSIDE > 0)).mean() > 0.05
    assert agreement(read_values(tmp_path / "m.jpg")) > 0.97
    # the darkest colours of the VOC palette have a channel of 64
    dark = np.where(INSIDE[..., None] > 0, np.array((64, 0, 0), np.uint8), np.uint8(0))
    assert (read_values(moving.save(tmp_path / "m.png", dark)) == INSIDE).all()


def test_colours_of_a_printer(tmp_path: Path) -> None:
    Image.fromarray(INSIDE).convert("RGB").convert("CMYK").save(tmp_path / "m.jpg", quality=95)
    assert agreement(read_values(tmp_path / "m.jpg")) > 0.99


def test_fractions_are_shades_and_no_number_is_one_sentence(tmp_path: Path) -> None:
    shades = np.where(INSIDE > 0, np.float32(0.6), np.float32(0))
    shades[0, 0] = 1.0
    Image.fromarray(shades).save(tmp_path / "m.tif")
    found = read_values(tmp_path / "m.tif")
    assert found[INSIDE > 0].tolist() == [153] * int((INSIDE > 0).sum()) and found[0, 0] == 255  # 0.6 * 255
    Image.fromarray(shades * np.float32(255)).save(tmp_path / "n.tif")
    assert (read_values(tmp_path / "n.tif") == found).all()
    shades[0, 0] = np.nan
    Image.fromarray(shades).save(tmp_path / "m.tif")
    with pytest.raises(UserError, match="m.tif: expected a mask of finite numbers, got some that are not"):
        read_values(tmp_path / "m.tif")


@pytest.mark.parametrize(("turn", "stored"), [(6, 1), (8, -1), (3, 2)])
def test_alpha_is_turned_with_its_frame(turn: int, stored: int, tmp_path: Path) -> None:
    """EXIF's 6, 8 and 3: to be seen upright, turn by 90 degrees clockwise, anticlockwise, by 180."""
    exif = Image.Exif()
    exif[0x0112] = turn
    (tmp_path / "rgba").mkdir()
    for i in range(5):
        pixels = np.rot90(np.dstack((moving.image(i), moving.mask(i))), stored)
        Image.fromarray(np.ascontiguousarray(pixels)).save(tmp_path / "rgba" / f"{i}.png", exif=exif)
    video = Online(tmp_path / "rgba").video("rgba")
    assert video.size == moving.SIZE
    assert (list(video.images())[3] == moving.image(3)).all()
    found = list(video.masks())[3]
    assert found is not None and (found == moving.mask(3)).all()


def test_opaque_frames_carry_no_mask(tmp_path: Path) -> None:
    opaque = np.full_like(moving.mask(0), 255)
    for i in range(5):
        moving.save(tmp_path / "rgba" / f"{i}.png", np.dstack((moving.image(i), opaque)))
    with pytest.raises(UserError, match="no frame is transparent anywhere and no --masks was given"):
        Online(tmp_path / "rgba").video("rgba")
    # the animal may fill the first frame
    moving.save(tmp_path / "rgba" / "4.png", np.dstack((moving.image(4), moving.mask(4))))
    assert "masks are the frames' alpha channel" in Online(tmp_path / "rgba").video("rgba").notes


def test_one_frame_in_two_files_is_one_sentence(tmp_path: Path) -> None:
    """A held-out frame's twin would be trained on."""
    frames, masks = moving.frames(tmp_path / "f"), moving.masks(tmp_path / "m")
    moving.save(frames / "00003.jpg", moving.image(3))
    with pytest.raises(UserError, match="f: expected one image of each name, got 00003.jpg and 00003.png"):
        Online(frames, masks=masks).video("f")
    (frames / "00003.jpg").unlink()
    (frames / "00003.tif").touch()  # no kind of frame
    Online(frames, masks=masks).video("f")
    moving.save(masks / "00005.bmp", moving.mask(5))
    with pytest.raises(UserError, match="m: expected one image of each name, got 00005.bmp and 00005.png"):
        Online(frames, masks=masks).video("f")
    root = moving.davis(tmp_path / "davis")
    moving.save(root / "JPEGImages" / "480p" / "camel" / "00000.png", moving.image(0))
    with pytest.raises(UserError, match="camel: expected one image of each name, got 00000.jpg and 00000.png"):
        Davis(root).load("camel", SELECTION)


def test_a_frame_that_is_a_link_to_nothing(tmp_path: Path) -> None:
    root = moving.davis(tmp_path)
    frame = root / "JPEGImages" / "480p" / "camel" / "00003.jpg"
    for target, reason in ((tmp_path / "none", "No such file"), (frame, "Too many levels of symbolic links")):
        frame.unlink()
        frame.symlink_to(target)
        with pytest.raises(UserError, match=f"00003.jpg: expected a file that can be read, but: {reason}"):
            Davis(root).load("camel", SELECTION)


def test_files_are_in_natural_order_whatever_digits_they_hold(tmp_path: Path) -> None:
    names = ["a2.png", "a10.png", "x1²2.png"]
    for name in reversed(names):
        (tmp_path / name).touch()
    assert [file.name for file in list_images(tmp_path)] == names


def test_a_palette_of_greys_holds_shades(tmp_path: Path) -> None:
    """Whatever index a program gave to white; a palette of colours, as DAVIS has it, holds numbers of objects."""
    soft = cv2.GaussianBlur(INSIDE, (0, 0), 2)
    Image.fromarray(INSIDE).quantize(2).save(tmp_path / "two.png")
    Image.fromarray(soft).convert("P").save(tmp_path / "soft.png")
    white_first = Image.fromarray((INSIDE == 0).astype(np.uint8), mode="P")
    white_first.putpalette([255, 255, 255, 0, 0, 0])
    white_first.save(tmp_path / "white.png")
    for name, wanted in (("two", INSIDE), ("soft", soft), ("white", INSIDE)):
        masks = open_masks([tmp_path / f"{name}.png"])
        found = masks.read(0, None, moving.SIZE)
        assert masks.ids == () and found is not None and (found == wanted).all(), name
    # the seventh colour of DAVIS's palette is a grey: in a folder with colours it is a number all the same
    colors = [0, 0, 0, *(64 * (i % 4) for i in range(18)), 128, 128, 128]
    for name, number in (("one", 1), ("seven", 7)):
        picture = Image.fromarray((INSIDE > 0).astype(np.uint8) * np.uint8(number), mode="P")
        picture.putpalette(colors)
        picture.save(tmp_path / f"{name}.png")
    masks = open_masks([tmp_path / "one.png", tmp_path / "seven.png"])
    found = masks.read(1, 7, moving.SIZE)
    assert masks.ids == (1, 7) and found is not None and (found == INSIDE).all()


def test_a_mask_that_is_transparent_everywhere_is_empty(tmp_path: Path) -> None:
    cut_out = np.dstack([np.full_like(INSIDE, 200)] * 3 + [np.zeros_like(INSIDE)])
    assert not read_values(moving.save(tmp_path / "m.png", cut_out)).any()
    cut_out[..., 3], cut_out[..., :3] = 255, INSIDE[..., None]
    assert (read_values(moving.save(tmp_path / "n.png", cut_out)) == INSIDE).all()


def test_a_tinted_pixel_leaves_the_shades(tmp_path: Path) -> None:
    soft = np.repeat(cv2.GaussianBlur(INSIDE, (0, 0), 2)[..., None], 3, axis=2)
    soft[0, 0] = 0, 0, 1
    found = read_values(moving.save(tmp_path / "m.png", soft))
    assert (found == soft.max(axis=2)).all() and len(np.unique(found)) > 50
