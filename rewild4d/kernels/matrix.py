"""Small dense products inside kernels, in tiles whose sums stay in registers.

A matrix is a 1D float32 array, the index of its first element and the distances between rows and columns, so that one
routine serves a matrix and its transpose. Rows of the result and of the right factor are multiples of sixteen floats.
"""

from collections.abc import Callable
from typing import Any

import numpy as np
from llvmlite import ir
from numba.core import types
from numba.core.typing import signature

from rewild4d.kernels.compiling import compiled_for, kernel
from rewild4d.kernels.simd import INTEGERS, LANES, VECTOR, array_data, broadcast_number, intrinsic, llvm_call, vector_at

ROWS, VECTORS = (8, 3) if compiled_for("avx512f") else (4, 1)
"""Rows of a tile and vectors in one of them; rows of the left factor and of the result are a multiple of 8.

AVX-512 has 32 registers: 24 sums, 3 loads and 8 broadcasts a step leave the multiplier as the limit. AVX2 has 16 of
half the length: an 8 x 3 tile would spill to memory (three times slower). Sums run over the depth in order, so the
result does not depend on the tile.
"""

_WORD = ir.IntType(64)


def matrix_tile(rows: int, vectors: int, multiply_add: Callable[[Any, Any, Any, Any], Any]) -> Any:
    """Make an intrinsic that adds A B to a tile of C.

    Args:
        rows: of the tile.
        vectors: in a row of the tile.
        multiply_add: generates total + left * right from (builder, left, right, total).
    """

    @intrinsic
    def tile(
        typing: Any, a: Any, a_first: Any, a_row: Any, a_step: Any, b: Any, b_first: Any, b_row: Any, depth: Any,
        c: Any, c_first: Any, c_row: Any,
    ) -> Any:  # fmt: skip
        def generate(context: Any, builder: Any, sig: Any, args: Any) -> Any:
            left, right, out = (array_data(context, builder, sig.args[i], args[i]) for i in (0, 4, 8))
            a_first, a_row, a_step, b_first, b_row, depth, c_first, c_row = (args[i] for i in (1, 2, 3, 5, 6, 7, 9, 10))
            row_starts = [builder.add(a_first, builder.mul(a_row, ir.Constant(_WORD, r))) for r in range(rows)]
            pointers = [
                vector_at(
                    builder, out, builder.add(c_first, builder.add(builder.mul(c_row, _word(r)), _word(v * LANES)))
                )
                for r in range(rows)
                for v in range(vectors)
            ]
            start = [builder.load(index, align=4) for index in pointers]
            before = builder.block
            loop, after = builder.append_basic_block("step"), builder.append_basic_block("done")
            builder.cbranch(builder.icmp_signed(">", depth, _word(0)), loop, after)
            builder.position_at_end(loop)
            step = builder.phi(_WORD)
            step.add_incoming(_word(0), before)
            sums = [builder.phi(VECTOR) for _ in pointers]
            for total, first in zip(sums, start, strict=True):
                total.add_incoming(first, before)
            line = builder.add(b_first, builder.mul(step, b_row))
            columns = [
                builder.load(vector_at(builder, right, builder.add(line, _word(v * LANES))), align=4)
                for v in range(vectors)
            ]
            along = builder.mul(step, a_step)
            new = []
            for r in range(rows):
                factor = broadcast_number(builder, builder.load(builder.gep(left, [builder.add(row_starts[r], along)])))
                new += [multiply_add(builder, factor, columns[v], sums[r * vectors + v]) for v in range(vectors)]
            following = builder.add(step, _word(1))
            step.add_incoming(following, loop)
            for total, value in zip(sums, new, strict=True):
                total.add_incoming(value, loop)
            builder.cbranch(builder.icmp_signed("<", following, depth), loop, after)
            builder.position_at_end(after)
            results = [builder.phi(VECTOR) for _ in pointers]
            for result, value, first in zip(results, new, start, strict=True):
                result.add_incoming(value, loop)
                result.add_incoming(first, before)
            for index, result in zip(pointers, results, strict=True):
                builder.store(result, index, align=4)
            return context.get_dummy_value()

        integer = types.intp
        return signature(
            types.void, a, integer, integer, integer, b, integer, integer, integer, c, integer, integer
        ), generate

    return tile


def _word(value: int) -> Any:
    return ir.Constant(_WORD, value)


def multiply_add(builder: Any, left: Any, right: Any, total: Any) -> Any:
    """Generate total + left * right, rounded once."""
    return llvm_call(builder, "llvm.fma.v16f32", [left, right, total])


_tile1, _tile2, _tile3 = (matrix_tile(ROWS, vectors, multiply_add) for vectors in (1, 2, 3))


@kernel
def tile_width(left: int) -> int:
    """Return the vectors of the next tile's rows; four are cut in two and two, as eight sums alone wait for each
    other."""
    return 2 if left == VECTORS + 1 == 4 else min(left, VECTORS)


@kernel
def add_product(
    a: np.ndarray, a_first: int, a_row: int, a_step: int, b: np.ndarray, b_first: int, b_row: int, depth: int,
    c: np.ndarray, c_first: int, c_row: int, rows: int, columns: int,
) -> None:  # fmt: skip
    """Compute C += A B.

    Args:
        a: A [rows, depth] from a_first, rows a_row apart and columns a_step.
        b: B [depth, columns] from b_first, rows b_row apart.
        c: C [rows, columns] from c_first, rows c_row apart.
        rows: a multiple of 8.
        columns: a multiple of 16.
    """
    column = 0
    while column < columns:
        width = tile_width((columns - column) // LANES)
        for row in range(0, rows, ROWS):
            index = c_first + row * c_row + column
            if width == 3:
                _tile3(a, a_first + row * a_row, a_row, a_step, b, b_first + column, b_row, depth, c, index, c_row)
            elif width == 2:
                _tile2(a, a_first + row * a_row, a_row, a_step, b, b_first + column, b_row, depth, c, index, c_row)
            else:
                _tile1(a, a_first + row * a_row, a_row, a_step, b, b_first + column, b_row, depth, c, index, c_row)
        column += width * LANES


@intrinsic
def transpose_tile(typing: Any, source: Any, first: Any, row: Any, target: Any, index: Any, step: Any) -> Any:
    """Write the transpose of the 16 x 16 tile of a float32 ``source`` at ``first``, rows ``row`` apart."""
    if not source.dtype == target.dtype == types.float32:
        return None

    def generate(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        given, made = (
            array_data(context, builder, sig.args[0], args[0]),
            array_data(context, builder, sig.args[3], args[3]),
        )
        lines = [
            builder.load(vector_at(builder, given, builder.add(args[1], builder.mul(args[2], _word(i)))), align=4)
            for i in range(LANES)
        ]
        # Stage s exchanges bit s of the row number with bit s of the lane number.
        for bit in (1, 2, 4, 8):
            low = [lane if not lane & bit else LANES + (lane ^ bit) for lane in range(LANES)]
            high = [lane | bit if not lane & bit else LANES + lane for lane in range(LANES)]
            swapped = list(lines)
            for i in range(LANES):
                if not i & bit:
                    pair = lines[i], lines[i | bit]
                    swapped[i] = builder.shuffle_vector(*pair, ir.Constant(INTEGERS, low))
                    swapped[i | bit] = builder.shuffle_vector(*pair, ir.Constant(INTEGERS, high))
            lines = swapped
        for i, line in enumerate(lines):
            builder.store(line, vector_at(builder, made, builder.add(args[4], builder.mul(args[5], _word(i)))), align=4)
        return context.get_dummy_value()

    integer = types.intp
    return signature(types.void, source, integer, integer, target, integer, integer), generate


@kernel
def transpose(given: np.ndarray, rows: int, wide: int, transposed: np.ndarray) -> None:
    """Write [rows, wide] as [wide, rows]; multiples of sixteen."""
    for row in range(0, rows, LANES):
        for lane in range(0, wide, LANES):
            transpose_tile(given, row * wide + lane, wide, transposed, lane * rows + row, rows)
