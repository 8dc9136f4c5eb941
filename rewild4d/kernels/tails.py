"""Load and store vectors that are not full, and sum across lanes."""

from typing import Any

from llvmlite import ir
from numba.core import types
from numba.core.typing import signature

from rewild4d.kernels.simd import (
    INTEGERS,
    LANES,
    array_data,
    broadcast_number,
    intrinsic,
    lanes_type,
    llvm_call,
    vector_at,
)

_INT = ir.IntType(32)
_ALIGN = ir.Constant(_INT, 4)


def _first_lanes(builder: Any, count: Any) -> Any:
    """Return a mask of the first ``count`` lanes."""
    limit = broadcast_number(builder, builder.trunc(count, _INT))
    return builder.icmp_signed("<", ir.Constant(INTEGERS, list(range(LANES))), limit)


@intrinsic
def load_first(typing: Any, array: Any, index: Any, count: Any, rest: Any) -> Any:
    """Load the first ``count`` of sixteen consecutive numbers; the other lanes get ``rest`` and are not read."""

    def generate(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        pointer = vector_at(builder, array_data(context, builder, sig.args[0], args[0]), args[1])
        return llvm_call(
            builder, "llvm.masked.load.v16f32.p0", [pointer, _ALIGN, _first_lanes(builder, args[2]), args[3]]
        )

    return signature(lanes_type, array, types.intp, types.intp, lanes_type), generate


@intrinsic
def store_first(typing: Any, array: Any, index: Any, count: Any, value: Any) -> Any:
    """Store the first ``count`` of sixteen consecutive numbers of a float32 array."""
    if array.dtype != types.float32:
        return None

    def generate(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        pointer = vector_at(builder, array_data(context, builder, sig.args[0], args[0]), args[1])
        mask = _first_lanes(builder, args[2])
        llvm_call(builder, "llvm.masked.store.v16f32.p0", [args[3], pointer, _ALIGN, mask], ir.VoidType())
        return context.get_dummy_value()

    return signature(types.void, array, types.intp, types.intp, lanes_type), generate


@intrinsic
def lanes_sum(typing: Any, a: Any) -> Any:
    """Sum all lanes, halves first."""

    def generate(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        value = args[0]
        for half in (8, 4, 2, 1):
            order = [(lane + half) % LANES for lane in range(LANES)]
            value = builder.fadd(value, builder.shuffle_vector(value, value, ir.Constant(INTEGERS, order)))
        return builder.extract_element(value, ir.Constant(_INT, 0))

    return signature(types.float32, lanes_type), generate
