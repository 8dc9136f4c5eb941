"""Vectors that are not full (the last of a row whose length is no multiple of sixteen), and sums across lanes."""

from typing import Any

from llvmlite import ir
from numba.core import types
from numba.core.typing import signature

from rewild4d.kernels.simd import INTEGERS, LANES, VECTOR, intrinsic, lanes_type, llvm_call

_INT = ir.IntType(32)
_ALIGN = ir.Constant(_INT, 4)


def _first_lanes(builder: Any, count: Any) -> Any:
    """A mask of the first ``count`` lanes."""
    one = builder.insert_element(ir.Constant(INTEGERS, ir.Undefined), builder.trunc(count, _INT), ir.Constant(_INT, 0))
    limit = builder.shuffle_vector(one, one, ir.Constant(INTEGERS, [0] * LANES))
    return builder.icmp_signed("<", ir.Constant(INTEGERS, list(range(LANES))), limit)


def _pointer(context: Any, builder: Any, kind: Any, array: Any, index: Any) -> Any:
    data = context.make_array(kind)(context, builder, array).data
    return builder.bitcast(builder.gep(data, [index]), VECTOR.as_pointer())


@intrinsic
def load_first(typing: Any, array: Any, index: Any, count: Any, rest: Any) -> Any:
    """The first ``count`` of sixteen consecutive numbers, ``rest`` in the lanes behind; those are not read."""

    def generate(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        place = _pointer(context, builder, sig.args[0], *args[:2])
        return llvm_call(
            builder, "llvm.masked.load.v16f32.p0", [place, _ALIGN, _first_lanes(builder, args[2]), args[3]]
        )

    return signature(lanes_type, array, types.intp, types.intp, lanes_type), generate


@intrinsic
def store_first(typing: Any, array: Any, index: Any, count: Any, value: Any) -> Any:
    """Write the first ``count`` of sixteen consecutive numbers of a float32 array."""
    if array.dtype != types.float32:
        return None

    def generate(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        place = _pointer(context, builder, sig.args[0], *args[:2])
        mask = _first_lanes(builder, args[2])
        llvm_call(builder, "llvm.masked.store.v16f32.p0", [args[3], place, _ALIGN, mask], ir.VoidType())
        return context.get_dummy_value()

    return signature(types.void, array, types.intp, types.intp, lanes_type), generate


def _across(builder: Any, value: Any, combine: Any) -> Any:
    """Combine all lanes, halves first, into one number."""
    for half in (8, 4, 2, 1):
        order = [(lane + half) % LANES for lane in range(LANES)]
        value = combine(value, builder.shuffle_vector(value, value, ir.Constant(INTEGERS, order)))
    return builder.extract_element(value, ir.Constant(_INT, 0))


@intrinsic
def lanes_sum(typing: Any, a: Any) -> Any:
    """The sum of all lanes."""

    def generate(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        return _across(builder, args[0], builder.fadd)

    return signature(types.float32, lanes_type), generate


@intrinsic
def lanes_maximum(typing: Any, a: Any) -> Any:
    """The largest lane."""

    def larger(builder: Any) -> Any:
        return lambda a, b: builder.select(builder.fcmp_ordered(">", a, b), a, b)

    def generate(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        return _across(builder, args[0], larger(builder))

    return signature(types.float32, lanes_type), generate
