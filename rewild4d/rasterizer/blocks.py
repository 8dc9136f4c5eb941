"""Load and store blocks of 4 x 4 pixels, a vector each: four side by side are four rows of sixteen pixels."""

from typing import Any

import numpy as np
from llvmlite import ir
from numba.core.typing import signature

from rewild4d.kernels.compiling import inlined
from rewild4d.kernels.simd import INTEGERS, LANES, intrinsic, lanes_type, load, splat, store
from rewild4d.kernels.tails import load_first, store_first


def _pick(quarters: list[int]) -> Any:
    """Return an intrinsic that picks quarters of (a, b), numbered 0..7."""
    lanes = [4 * quarter + i for quarter in quarters for i in range(4)]

    @intrinsic
    def pick(typing: Any, a: Any, b: Any) -> Any:
        def generate(context: Any, builder: Any, sig: Any, args: Any) -> Any:
            return builder.shuffle_vector(*args, ir.Constant(INTEGERS, lanes))

        return signature(lanes_type, lanes_type, lanes_type), generate

    return pick


_first_halves, _second_halves = _pick([0, 1, 4, 5]), _pick([2, 3, 6, 7])
_even_quarters, _odd_quarters = _pick([0, 2, 4, 6]), _pick([1, 3, 5, 7])


@inlined
def exchange_quarters(a: Any, b: Any, c: Any, d: Any) -> tuple[Any, Any, Any, Any]:
    """Convert blocks to rows and back: quarter i of vector j goes to quarter j of vector i."""
    left, right = _first_halves(a, b), _first_halves(c, d)
    left_below, right_below = _second_halves(a, b), _second_halves(c, d)
    return (
        _even_quarters(left, right), _odd_quarters(left, right),
        _even_quarters(left_below, right_below), _odd_quarters(left_below, right_below),
    )  # fmt: skip


@inlined
def _store_row(plane: np.ndarray, place: int, inside: bool, room: int, row: Any) -> None:
    if inside and room >= LANES:
        store(plane, place, row)
    elif inside:
        store_first(plane, place, room, row)


@inlined
def _load_row(plane: np.ndarray, place: int, inside: bool, room: int) -> Any:
    row = splat(np.float32(0))
    if inside and room >= LANES:
        row = load(plane, place)
    elif inside:
        row = load_first(plane, place, room, row)
    return row


@inlined
def store_blocks(plane: np.ndarray, first_row: int, x: int, y: int, width: int, height: int, blocks: tuple) -> None:
    """Write the part of four blocks side by side that is in the image.

    Args:
        plane: flat images, one below the other.
        first_row: of the image in the plane.
        x, y: left and top pixel of the first block, in the image.
        width, height: of the image.
        blocks: four vectors.
    """
    corner, room = (first_row + y) * width + x, width - x
    a, b, c, d = exchange_quarters(blocks[0], blocks[1], blocks[2], blocks[3])
    _store_row(plane, corner, y < height, room, a)
    _store_row(plane, corner + width, y + 1 < height, room, b)
    _store_row(plane, corner + 2 * width, y + 2 < height, room, c)
    _store_row(plane, corner + 3 * width, y + 3 < height, room, d)


@inlined
def load_blocks(plane: np.ndarray, first_row: int, x: int, y: int, width: int, height: int) -> tuple:
    """Return four blocks side by side, zero outside the image; arguments as in `store_blocks`."""
    corner, room = (first_row + y) * width + x, width - x
    return exchange_quarters(
        _load_row(plane, corner, y < height, room),
        _load_row(plane, corner + width, y + 1 < height, room),
        _load_row(plane, corner + 2 * width, y + 2 < height, room),
        _load_row(plane, corner + 3 * width, y + 3 < height, room),
    )
