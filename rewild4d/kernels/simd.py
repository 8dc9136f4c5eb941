"""A vector of 16 float32 lanes for numba kernels: `Lanes`, lowered by LLVM to AVX-512, AVX2 or NEON.

Inside kernels ``+``, ``-`` and ``*`` work on two `Lanes`; everything else is a function below. Loads and stores take a
1D float32 array and the index of the first lane.
"""

# numba fixes the shape of an intrinsic: it takes the typing context and gives a signature and a code generator.
import operator
from typing import Any

import numpy as np
from llvmlite import ir
from numba.core import cgutils, types
from numba.core.typing import signature
from numba.core.typing.templates import AbstractTemplate, infer_global
from numba.extending import intrinsic as numba_intrinsic
from numba.extending import lower_builtin, models, register_model

intrinsic: Any = numba_intrinsic  # to a type checker its results are still functions of the typing context

LANES = 16
_FLOAT, _INT = ir.FloatType(), ir.IntType(32)
VECTOR, INTEGERS = ir.VectorType(_FLOAT, LANES), ir.VectorType(_INT, LANES)


class LanesType(types.Type):
    """numba's name for `<16 x float>`."""

    def __init__(self) -> None:
        super().__init__(name="float32x16")


lanes_type = LanesType()


@register_model(LanesType)
class _LanesModel(models.PrimitiveModel):
    def __init__(self, manager: Any, kind: Any) -> None:
        super().__init__(manager, kind, VECTOR)


def constant(values: Any) -> ir.Constant:
    return ir.Constant(VECTOR, [float(np.float32(value)) for value in np.broadcast_to(values, LANES)])


@infer_global(operator.add)
@infer_global(operator.sub)
@infer_global(operator.mul)
class _Arithmetic(AbstractTemplate):
    def generic(self, args: Any, kws: Any) -> Any:
        return signature(lanes_type, *args) if args == (lanes_type, lanes_type) else None


@lower_builtin(operator.add, lanes_type, lanes_type)
def _lower_add(context: Any, builder: Any, sig: Any, args: Any) -> Any:
    return builder.fadd(*args)


@lower_builtin(operator.sub, lanes_type, lanes_type)
def _lower_sub(context: Any, builder: Any, sig: Any, args: Any) -> Any:
    return builder.fsub(*args)


@lower_builtin(operator.mul, lanes_type, lanes_type)
def _lower_mul(context: Any, builder: Any, sig: Any, args: Any) -> Any:
    return builder.fmul(*args)


@intrinsic
def divide(typing: Any, a: Any, b: Any) -> Any:
    """Divide a / b."""
    return signature(lanes_type, a, b), lambda context, builder, sig, args: builder.fdiv(*args)


@intrinsic
def splat(typing: Any, value: Any) -> Any:
    """One number in all lanes."""

    def generate(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        one = builder.insert_element(ir.Constant(VECTOR, ir.Undefined), args[0], ir.Constant(_INT, 0))
        return builder.shuffle_vector(one, one, ir.Constant(INTEGERS, [0] * LANES))

    return signature(lanes_type, types.float32), generate


@intrinsic
def columns_of_block(typing: Any) -> Any:
    """Column 0..3 of each lane in a 4 x 4 block."""
    values = [lane % 4 for lane in range(LANES)]
    return signature(lanes_type), lambda context, builder, sig, args: constant(values)


@intrinsic
def rows_of_block(typing: Any) -> Any:
    """Row 0..3 of each lane in a 4 x 4 block."""
    values = [lane // 4 for lane in range(LANES)]
    return signature(lanes_type), lambda context, builder, sig, args: constant(values)


def _pointer(context: Any, builder: Any, sig: Any, args: Any) -> Any:
    array = context.make_array(sig.args[0])(context, builder, args[0])
    first = builder.gep(array.data, [args[1]])
    return builder.bitcast(first, VECTOR.as_pointer())


@intrinsic
def load(typing: Any, array: Any, index: Any) -> Any:
    """Sixteen consecutive numbers of an array."""

    def generate(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        return builder.load(_pointer(context, builder, sig, args), align=4)

    return signature(lanes_type, array, types.intp), generate


@intrinsic
def broadcast(typing: Any, array: Any, index: Any) -> Any:
    """One number of an array in all lanes; the index is not checked and not counted from the end."""

    def generate(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        data = context.make_array(sig.args[0])(context, builder, args[0]).data
        one = ir.Constant(VECTOR, ir.Undefined)
        one = builder.insert_element(one, builder.load(builder.gep(data, [args[1]])), ir.Constant(_INT, 0))
        return builder.shuffle_vector(one, one, ir.Constant(INTEGERS, [0] * LANES))

    return signature(lanes_type, array, types.intp), generate


@intrinsic
def store(typing: Any, array: Any, index: Any, value: Any) -> Any:
    """Write sixteen consecutive numbers of an array."""

    def generate(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        builder.store(args[2], _pointer(context, builder, sig, args), align=4)
        return context.get_dummy_value()

    return signature(types.void, array, types.intp, lanes_type), generate


def llvm_call(builder: Any, name: str, args: Any, result: Any = VECTOR) -> Any:
    """A call of one of LLVM's own functions, while code is generated."""
    function = cgutils.get_or_insert_function(builder.module, ir.FunctionType(result, [arg.type for arg in args]), name)
    return builder.call(function, args)


@intrinsic
def fma(typing: Any, a: Any, b: Any, c: Any) -> Any:
    """Compute a * b + c, rounded once."""

    def generate(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        return llvm_call(builder, "llvm.fma.v16f32", args)

    return signature(lanes_type, lanes_type, lanes_type, lanes_type), generate


@intrinsic
def fnma(typing: Any, a: Any, b: Any, c: Any) -> Any:
    """Compute c - a * b, rounded once."""

    def generate(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        return llvm_call(builder, "llvm.fma.v16f32", [builder.fneg(args[0]), args[1], args[2]])

    return signature(lanes_type, lanes_type, lanes_type, lanes_type), generate


@intrinsic
def absolute(typing: Any, a: Any) -> Any:
    """Lane by lane absolute value."""
    return signature(lanes_type, a), lambda context, builder, sig, args: llvm_call(builder, "llvm.fabs.v16f32", args)


@intrinsic
def square_root(typing: Any, a: Any) -> Any:
    """Lane by lane square root."""
    return signature(lanes_type, a), lambda context, builder, sig, args: llvm_call(builder, "llvm.sqrt.v16f32", args)


@intrinsic
def negated_absolute(typing: Any, a: Any) -> Any:
    """Lane by lane, minus the absolute value."""

    def generate(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        bits = builder.or_(builder.bitcast(args[0], INTEGERS), ir.Constant(INTEGERS, [-(2**31)] * LANES))
        return builder.bitcast(bits, VECTOR)

    return signature(lanes_type, a), generate


@intrinsic
def minimum(typing: Any, a: Any, b: Any) -> Any:
    """Lane by lane minimum."""

    def generate(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        return builder.select(builder.fcmp_ordered("<", *args), *args)

    return signature(lanes_type, lanes_type, lanes_type), generate


@intrinsic
def maximum(typing: Any, a: Any, b: Any) -> Any:
    """Lane by lane maximum."""

    def generate(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        return builder.select(builder.fcmp_ordered(">", *args), *args)

    return signature(lanes_type, lanes_type, lanes_type), generate


@intrinsic
def keep_where_ge(typing: Any, value: Any, a: Any, b: Any) -> Any:
    """The value where a >= b, zero elsewhere."""

    def generate(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        return builder.select(builder.fcmp_ordered(">=", args[1], args[2]), args[0], constant(0.0))

    return signature(lanes_type, lanes_type, lanes_type, lanes_type), generate


@intrinsic
def select_gt(typing: Any, a: Any, b: Any, yes: Any, no: Any) -> Any:
    """``yes`` where a > b, ``no`` elsewhere."""

    def generate(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        return builder.select(builder.fcmp_ordered(">", args[0], args[1]), args[2], args[3])

    return signature(lanes_type, *[lanes_type] * 4), generate


@intrinsic
def bits_gt(typing: Any, a: Any, b: Any) -> Any:
    """An integer whose bit i says a > b in lane i."""

    def generate(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        bits = builder.bitcast(builder.fcmp_ordered(">", *args), ir.IntType(LANES))
        return builder.zext(bits, ir.IntType(64))

    return signature(types.int64, lanes_type, lanes_type), generate


def _fold(take_low: list[int], take_high: list[int]) -> Any:
    """An intrinsic that adds two shuffles of (a, b): one level of a transposing sum."""

    @intrinsic
    def fold(typing: Any, a: Any, b: Any) -> Any:
        def generate(context: Any, builder: Any, sig: Any, args: Any) -> Any:
            low = builder.shuffle_vector(*args, ir.Constant(INTEGERS, take_low))
            high = builder.shuffle_vector(*args, ir.Constant(INTEGERS, take_high))
            return builder.fadd(low, high)

        return signature(lanes_type, lanes_type, lanes_type), generate

    return fold


def _quarters(pattern: list[int]) -> list[int]:
    """Repeat a pattern over (a0..a3, b0..b3) in each of the four 128-bit quarters."""
    return [4 * quarter + (index if index < 4 else LANES + index - 4) for quarter in range(4) for index in pattern]


# After fold1, fold2, fold4, fold8 over a tree of sixteen vectors, lane i of the result is the sum of vector i.
fold1 = _fold(_quarters([0, 4, 1, 5]), _quarters([2, 6, 3, 7]))
fold2 = _fold(_quarters([0, 1, 4, 5]), _quarters([2, 3, 6, 7]))
fold4 = _fold([*range(0, 8), *range(16, 24)], [*range(8, 16), *range(24, 32)])
fold8 = _fold(
    [*range(0, 4), *range(8, 12), *range(16, 20), *range(24, 28)],
    [*range(4, 8), *range(12, 16), *range(20, 24), *range(28, 32)],
)


@intrinsic
def lowest_bit(typing: Any, bits: Any) -> Any:
    """Index of the lowest set bit of a nonzero integer."""

    def generate(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        return builder.cttz(args[0], ir.Constant(ir.IntType(1), 1))

    return signature(types.int64, types.int64), generate


@intrinsic
def take_ticket(typing: Any, counter: Any) -> Any:
    """Atomically add one to the first number of an int64 array and give its old value."""

    def generate(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        array = context.make_array(sig.args[0])(context, builder, args[0])
        return builder.atomic_rmw("add", array.data, ir.Constant(ir.IntType(64), 1), "monotonic")

    return signature(types.int64, counter), generate
