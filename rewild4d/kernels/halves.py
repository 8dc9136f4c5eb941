"""Products of bfloat16 pairs: sixteen float32 lanes, each the sum of two products (AVX512_BF16).

A word is two bfloat16 numbers in the bits of a float32, the first in the lower half. Sums stay in float32.
"""

import contextlib
import logging
import os
import subprocess
import sys
from functools import cache
from typing import Any

import llvmlite
import numba
import numpy as np
from llvmlite import ir
from numba.core.typing import signature

from rewild4d.files import cache_folder, write_text
from rewild4d.kernels.compiling import compiled_for, kernel
from rewild4d.kernels.matrix import ROWS, matrix_tile, tile_width
from rewild4d.kernels.simd import INTEGERS, LANES, VECTOR, intrinsic, lanes_type, load, store

logger = logging.getLogger(__name__)

IN_PROBE = "REWILD4D_IN_PROBE"
"""Set in the process that tries to compile the instruction."""


@cache
def available() -> bool:
    """Tell whether this machine multiplies pairs and this numba compiles that; float32 is used elsewhere.

    Some versions of LLVM end the process on the instruction (numba 0.61), so it is tried once a version in its own
    process; the answer is kept in the cache folder.
    """
    if not compiled_for("avx512bf16"):
        return False
    if os.environ.get(IN_PROBE):
        return True
    answer = cache_folder() / "kernels" / f"bfloat16-numba-{numba.__version__}-llvmlite-{llvmlite.__version__}"
    with contextlib.suppress(OSError):
        return answer.read_text(encoding="utf-8") == "yes"
    child = [sys.executable, "-c", f"from {__name__} import probe; probe()"]
    works = subprocess.run(child, env=os.environ | {IN_PROBE: "1"}, capture_output=True).returncode == 0
    if not works:
        logger.warning(
            "numba %s cannot compile products of bfloat16 pairs: single precision is used.", numba.__version__
        )
    with contextlib.suppress(OSError):
        write_text(answer, "yes" if works else "no")
    return works


def probe() -> None:
    """Compile one product of pairs and check it: 16 x 16 words of ones give sums of 32."""
    ones = np.full((16, 16), np.uint32(0x3F803F80)).view(np.float32)
    product = np.zeros((16, 16), np.float32)
    add_pair_product(ones.ravel(), 0, 16, ones.ravel(), 0, 16, 16, product.ravel(), 0, 16, 16, 16)
    if not (product == 32).all():
        raise ArithmeticError(f"expected sums of 32, got {product.min()} to {product.max()}")


class _BFloat(ir.Type):
    """LLVM's name for the format, which llvmlite lacks."""

    def _to_string(self) -> str:
        return "bfloat"


_PAIRS = ir.VectorType(_BFloat(), 2 * LANES)


def _multiply_add(builder: Any, left: Any, right: Any, total: Any) -> Any:
    """Add, lane by lane, the two products of a pair to the total; compiled only where available."""
    if not available():
        return total
    pairs = [builder.bitcast(word, _PAIRS) for word in (left, right)]
    kind = ir.FunctionType(VECTOR, [VECTOR, _PAIRS, _PAIRS])
    name = "llvm.x86.avx512bf16.dpbf16ps.512"
    function = builder.module.globals.get(name) or ir.Function(builder.module, kind, name)
    return builder.call(function, [total, *pairs])


_tile1, _tile2, _tile3 = (matrix_tile(ROWS, vectors, _multiply_add) for vectors in (1, 2, 3))


@kernel
def add_pair_product(
    a: np.ndarray, a_first: int, a_row: int, b: np.ndarray, b_first: int, b_row: int, depth: int, c: np.ndarray,
    c_first: int, c_row: int, rows: int, columns: int,
) -> None:  # fmt: skip
    """Compute C += A B of words, as `matrix.add_product`.

    A [rows, depth] has pairs along a row, B [depth, columns] along a column; ``depth`` counts words.
    """
    column = 0
    while column < columns:
        width = tile_width((columns - column) // LANES)
        for row in range(0, rows, ROWS):
            index = c_first + row * c_row + column
            if width == 3:
                _tile3(a, a_first + row * a_row, a_row, 1, b, b_first + column, b_row, depth, c, index, c_row)
            elif width == 2:
                _tile2(a, a_first + row * a_row, a_row, 1, b, b_first + column, b_row, depth, c, index, c_row)
            else:
                _tile1(a, a_first + row * a_row, a_row, 1, b, b_first + column, b_row, depth, c, index, c_row)
        column += width * LANES


@intrinsic
def pair(typing: Any, low: Any, high: Any) -> Any:
    """Round two vectors to words, lane by lane, each number to the nearest."""

    def generate(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        half, upper, shift = (ir.Constant(INTEGERS, [bits] * LANES) for bits in (0x8000, -0x10000, 16))
        first, second = (builder.add(builder.bitcast(arg, INTEGERS), half) for arg in args)
        return builder.bitcast(builder.or_(builder.lshr(first, shift), builder.and_(second, upper)), VECTOR)

    return signature(lanes_type, lanes_type, lanes_type), generate


@kernel
def pair_rows(given: np.ndarray, rows: int, columns: int, words: np.ndarray) -> None:
    """Set words of neighbouring rows: [rows, columns] -> [rows / 2, columns], the right factor of a product."""
    for row in range(0, rows, 2):
        for lane in range(0, columns, LANES):
            index = row * columns + lane
            store(words, index - row // 2 * columns, pair(load(given, index), load(given, index + columns)))


@kernel
def pair_vectors(given: np.ndarray, rows: int, columns: int, words: np.ndarray) -> None:
    """Set words of neighbouring vectors of a row: [rows, columns] -> [rows, columns / 2], columns a multiple of 32.

    Which numbers of a row make a pair does not matter to a sum over the row, if both factors agree.
    """
    for index in range(0, rows * columns, 2 * LANES):
        store(words, index // 2, pair(load(given, index), load(given, index + LANES)))


@kernel
def _rounded(bits: int) -> int:
    return (bits + 0x8000) >> 16 & 0xFFFF


@kernel
def pair_matrix(
    bits: np.ndarray, first: int, rows: int, columns: int, along: np.ndarray, across: np.ndarray, index: int
) -> None:
    """Set words of a matrix and of its transpose, both from ``index`` on.

    ``bits`` are float32 numbers as int32; the matrix [rows, columns], both even, begins at ``first``. ``along`` gets
    [rows, columns / 2] words, ``across`` [columns, rows / 2].
    """
    for row in range(rows):
        for column in range(0, columns, 2):
            low, high = bits[first + row * columns + column], bits[first + row * columns + column + 1]
            word = _rounded(low) | _rounded(high) << 16
            along[index + (row * columns + column) // 2] = np.int32(np.uint32(word))
    for column in range(columns):
        for row in range(0, rows, 2):
            low, high = bits[first + row * columns + column], bits[first + (row + 1) * columns + column]
            word = _rounded(low) | _rounded(high) << 16
            across[index + (column * rows + row) // 2] = np.int32(np.uint32(word))
