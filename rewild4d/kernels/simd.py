"""A vector of 16 float32 lanes for numba kernels: `Lanes`, lowered by LLVM to AVX-512, AVX2 or NEON.

Inside kernels ``+``, ``-`` and ``*`` work on two `Lanes`; all else is a function below, lane by lane. Loads and stores
take a 1D float32 array and the index of the first lane.
"""

# numba fixes the shape of an intrinsic: it takes the typing context and returns a signature and a code generator.
import operator
from collections.abc import Callable
from functools import wraps
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
    """The numba type of `<16 x float>`."""

    def __init__(self) -> None:
        super().__init__(name="float32x16")


lanes_type = LanesType()


@register_model(LanesType)
class _LanesModel(models.PrimitiveModel):
    def __init__(self, manager: Any, kind: Any) -> None:
        super().__init__(manager, kind, VECTOR)


def constant(values: Any) -> ir.Constant:
    """Return a vector of one number, or of sixteen, while code is generated."""
    return ir.Constant(VECTOR, [float(np.float32(value)) for value in np.broadcast_to(values, LANES)])


def broadcast_number(builder: Any, number: Any) -> Any:
    """Put a number in all lanes, while code is generated."""
    one = builder.insert_element(ir.Constant(ir.VectorType(number.type, LANES), ir.Undefined), number, _INT(0))
    return builder.shuffle_vector(one, one, ir.Constant(INTEGERS, [0] * LANES))


def array_data(context: Any, builder: Any, kind: Any, array: Any) -> Any:
    """Return the pointer to an array's first element, while code is generated."""
    return context.make_array(kind)(context, builder, array).data


def vector_at(builder: Any, data: Any, index: Any) -> Any:
    """Return the pointer to sixteen numbers from an index on, while code is generated."""
    return builder.bitcast(builder.gep(data, [index]), VECTOR.as_pointer())


def llvm_call(builder: Any, name: str, args: Any, result: Any = VECTOR) -> Any:
    """Call one of LLVM's own functions, while code is generated."""
    function = cgutils.get_or_insert_function(builder.module, ir.FunctionType(result, [arg.type for arg in args]), name)
    return builder.call(function, args)


def elementwise(kind: types.Type) -> Callable[[Callable[..., Any]], Any]:
    """Make an intrinsic on vectors of a type from a function that generates its code: (builder, *vectors) -> vector."""

    def decorate(emit: Callable[..., Any]) -> Any:
        @wraps(emit)  # numba reads the number of vectors from its signature
        def definition(typing: Any, *given: Any) -> Any:
            def generate(context: Any, builder: Any, sig: Any, args: Any) -> Any:
                return emit(builder, *args)

            return signature(kind, *[kind] * len(given)), generate

        return intrinsic(definition)

    return decorate


class _Arithmetic(AbstractTemplate):
    def generic(self, args: Any, kws: Any) -> Any:
        return signature(lanes_type, *args) if args == (lanes_type, lanes_type) else None


def _define(operation: Any, name: str) -> None:
    infer_global(operation)(_Arithmetic)

    @lower_builtin(operation, lanes_type, lanes_type)
    def lower(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        return getattr(builder, name)(*args)


for _operation, _name in ((operator.add, "fadd"), (operator.sub, "fsub"), (operator.mul, "fmul")):
    _define(_operation, _name)


@intrinsic
def splat(typing: Any, value: Any) -> Any:
    """Put one number in all lanes."""

    def generate(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        return broadcast_number(builder, args[0])

    return signature(lanes_type, types.float32), generate


@elementwise(lanes_type)
def columns_of_block(builder: Any) -> Any:
    """Return the column 0..3 of each lane in a 4 x 4 block."""
    return constant([lane % 4 for lane in range(LANES)])


@elementwise(lanes_type)
def rows_of_block(builder: Any) -> Any:
    """Return the row 0..3 of each lane in a 4 x 4 block."""
    return constant([lane // 4 for lane in range(LANES)])


@intrinsic
def load(typing: Any, array: Any, index: Any) -> Any:
    """Load sixteen consecutive numbers of an array."""

    def generate(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        return builder.load(vector_at(builder, array_data(context, builder, sig.args[0], args[0]), args[1]), align=4)

    return signature(lanes_type, array, types.intp), generate


@intrinsic
def broadcast(typing: Any, array: Any, index: Any) -> Any:
    """Put one number of an array in all lanes; the index is not checked and not counted from the end."""

    def generate(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        data = array_data(context, builder, sig.args[0], args[0])
        return broadcast_number(builder, builder.load(builder.gep(data, [args[1]])))

    return signature(lanes_type, array, types.intp), generate


@intrinsic
def store(typing: Any, array: Any, index: Any, value: Any) -> Any:
    """Store sixteen consecutive numbers of an array."""

    def generate(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        data = array_data(context, builder, sig.args[0], args[0])
        builder.store(args[2], vector_at(builder, data, args[1]), align=4)
        return context.get_dummy_value()

    return signature(types.void, array, types.intp, lanes_type), generate


@elementwise(lanes_type)
def divide(builder: Any, a: Any, b: Any) -> Any:
    """Compute a / b."""
    return builder.fdiv(a, b)


@elementwise(lanes_type)
def fma(builder: Any, a: Any, b: Any, c: Any) -> Any:
    """Compute a * b + c, rounded once."""
    return llvm_call(builder, "llvm.fma.v16f32", [a, b, c])


@elementwise(lanes_type)
def fnma(builder: Any, a: Any, b: Any, c: Any) -> Any:
    """Compute c - a * b, rounded once."""
    return llvm_call(builder, "llvm.fma.v16f32", [builder.fneg(a), b, c])


@elementwise(lanes_type)
def absolute(builder: Any, a: Any) -> Any:
    """Compute the absolute value."""
    return llvm_call(builder, "llvm.fabs.v16f32", [a])


@elementwise(lanes_type)
def square_root(builder: Any, a: Any) -> Any:
    """Compute the square root."""
    return llvm_call(builder, "llvm.sqrt.v16f32", [a])


@elementwise(lanes_type)
def negated_absolute(builder: Any, a: Any) -> Any:
    """Compute minus the absolute value."""
    bits = builder.or_(builder.bitcast(a, INTEGERS), ir.Constant(INTEGERS, [-(2**31)] * LANES))
    return builder.bitcast(bits, VECTOR)


@elementwise(lanes_type)
def minimum(builder: Any, a: Any, b: Any) -> Any:
    """Compute the smaller of two; the second where one is a NaN."""
    return builder.select(builder.fcmp_ordered("<", a, b), a, b)


@elementwise(lanes_type)
def maximum(builder: Any, a: Any, b: Any) -> Any:
    """Compute the larger of two; the second where one is a NaN."""
    return builder.select(builder.fcmp_ordered(">", a, b), a, b)


@elementwise(lanes_type)
def keep_where_ge(builder: Any, value: Any, a: Any, b: Any) -> Any:
    """Return the value where a >= b, zero elsewhere."""
    return builder.select(builder.fcmp_ordered(">=", a, b), value, constant(0.0))


@elementwise(lanes_type)
def select_gt(builder: Any, a: Any, b: Any, yes: Any, no: Any) -> Any:
    """Return ``yes`` where a > b, ``no`` elsewhere."""
    return builder.select(builder.fcmp_ordered(">", a, b), yes, no)


@intrinsic
def bits_gt(typing: Any, a: Any, b: Any) -> Any:
    """Return an integer whose bit i says a > b in lane i."""

    def generate(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        bits = builder.bitcast(builder.fcmp_ordered(">", *args), ir.IntType(LANES))
        return builder.zext(bits, ir.IntType(64))

    return signature(types.int64, lanes_type, lanes_type), generate


def _fold(take_low: list[int], take_high: list[int]) -> Any:
    """Make an intrinsic that adds two shuffles of (a, b): one level of a transposing sum."""

    @elementwise(lanes_type)
    def fold(builder: Any, a: Any, b: Any) -> Any:
        low = builder.shuffle_vector(a, b, ir.Constant(INTEGERS, take_low))
        return builder.fadd(low, builder.shuffle_vector(a, b, ir.Constant(INTEGERS, take_high)))

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
    """Return the index of the lowest set bit of a nonzero integer."""

    def generate(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        return builder.cttz(args[0], ir.Constant(ir.IntType(1), 1))

    return signature(types.int64, types.int64), generate


@intrinsic
def take_ticket(typing: Any, counter: Any) -> Any:
    """Atomically add one to the first number of an int64 array and return its old value."""

    def generate(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        data = array_data(context, builder, sig.args[0], args[0])
        return builder.atomic_rmw("add", data, ir.Constant(ir.IntType(64), 1), "monotonic")

    return signature(types.int64, counter), generate
