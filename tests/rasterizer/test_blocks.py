"""Blocks of 4 x 4 pixels in an image: where a row of four of them lies inside, and where it leaves the frame."""

import numba
import numpy as np
import pytest

from rewild4d.kernels.simd import load, store
from rewild4d.rasterizer.blocks import load_blocks, store_blocks


@numba.njit
def _write(plane, first_row, x, y, width, height, lanes):  # type: ignore[no-untyped-def]
    blocks = load(lanes, 0), load(lanes, 16), load(lanes, 32), load(lanes, 48)
    store_blocks(plane, first_row, x, y, width, height, blocks)


@numba.njit
def _read(plane, first_row, x, y, width, height, lanes):  # type: ignore[no-untyped-def]
    a, b, c, d = load_blocks(plane, first_row, x, y, width, height)
    store(lanes, 0, a)
    store(lanes, 16, b)
    store(lanes, 32, c)
    store(lanes, 48, d)


@pytest.mark.parametrize(("width", "height"), [(32, 8), (21, 6), (17, 5), (3, 1), (16, 4)])
@pytest.mark.parametrize(("x", "y"), [(0, 0), (16, 0), (0, 4), (16, 4)])
def test_blocks_side_by_side_are_the_pixels_of_the_image(width: int, height: int, x: int, y: int) -> None:
    lanes = np.arange(1, 65, dtype=np.float32)
    # Lane 4 r + c of block b is row r, column 4 b + c.
    pixels = lanes.reshape(4, 4, 4).transpose(1, 0, 2).reshape(4, 16)
    planes = np.zeros((3, height, width), np.float32)
    _write(planes.reshape(-1), height, x, y, width, height, lanes)
    expected = np.zeros((3, height + 8, width + 32), np.float32)
    expected[1, y : y + 4, x : x + 16] = pixels
    assert (planes[1] == expected[1, :height, :width]).all()
    assert (planes[[0, 2]] == 0).all(), "other images are not touched"
    again = np.full(64, np.nan, np.float32)
    _read(planes.reshape(-1), height, x, y, width, height, again)
    seen = np.zeros((4, 16), np.float32)
    inside = planes[1, y : y + 4, x : x + 16]
    seen[: inside.shape[0], : inside.shape[1]] = inside
    assert (again.reshape(4, 4, 4).transpose(1, 0, 2).reshape(4, 16) == seen).all()
