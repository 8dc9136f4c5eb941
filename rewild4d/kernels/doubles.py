"""A vector of 8 float64 lanes for numba kernels, `Doubles`, where float32 is too coarse.

Inside kernels ``+``, ``-``, ``*`` and ``/`` work on two `Doubles` or on one and a number; a product that is added may
be rounded together with the sum. Arrays of rows are flat: eight rows are read as columns, one `Doubles` each.
"""

# numba fixes the shape of an intrinsic, see simd.py.
import math
import operator
from typing import Any

from llvmlite import ir
from numba.core import types
from numba.core.typing import signature
from numba.core.typing.templates import AbstractTemplate, infer_global
from numba.extending import lower_builtin, models, register_model

from rewild4d.kernels.compiling import inlined
from rewild4d.kernels.simd import array_data, elementwise, intrinsic, llvm_call

WIDTH = 8
_DOUBLE, _LONG, _INT = ir.DoubleType(), ir.IntType(64), ir.IntType(32)
_VECTOR, _LONGS = ir.VectorType(_DOUBLE, WIDTH), ir.VectorType(_LONG, WIDTH)
_OPERATORS = {operator.add: "fadd", operator.sub: "fsub", operator.mul: "fmul", operator.truediv: "fdiv"}


class DoublesType(types.Type):
    """The numba type of `<8 x double>`."""

    def __init__(self) -> None:
        super().__init__(name="float64x8")


doubles_type = DoublesType()


@register_model(DoublesType)
class _DoublesModel(models.PrimitiveModel):
    def __init__(self, manager: Any, kind: Any) -> None:
        super().__init__(manager, kind, _VECTOR)


class _Arithmetic(AbstractTemplate):
    def generic(self, args: Any, kws: Any) -> Any:
        if len(args) != 2 or doubles_type not in args:
            return None
        known = [arg if arg == doubles_type else types.float64 for arg in args]
        fits = all(arg == doubles_type or isinstance(arg, types.Float | types.Integer) for arg in args)
        return signature(doubles_type, *known) if fits else None


def _spread(builder: Any, number: Any) -> Any:
    one = builder.insert_element(ir.Constant(_VECTOR, ir.Undefined), number, ir.Constant(_INT, 0))
    return builder.shuffle_vector(one, one, ir.Constant(ir.VectorType(_INT, WIDTH), [0] * WIDTH))


def _define(operation: Any, name: str) -> None:
    infer_global(operation)(_Arithmetic)

    def lower(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        vectors = [a if t == doubles_type else _spread(builder, a) for a, t in zip(args, sig.args, strict=True)]
        return getattr(builder, name)(*vectors, flags=("contract",))

    for pair in ((doubles_type, doubles_type), (doubles_type, types.float64), (types.float64, doubles_type)):
        lower_builtin(operation, *pair)(lower)


for _operation, _name in _OPERATORS.items():
    _define(_operation, _name)


@intrinsic
def spread(typing: Any, number: Any) -> Any:
    """Put one number in all lanes."""
    return signature(doubles_type, types.float64), lambda context, builder, sig, args: _spread(builder, args[0])


@elementwise(doubles_type)
def lane_numbers(builder: Any) -> Any:
    """Return 0 to 7."""
    return ir.Constant(_VECTOR, [*map(float, range(WIDTH))])


@elementwise(doubles_type)
def root(builder: Any, a: Any) -> Any:
    """Compute the square root."""
    return llvm_call(builder, "llvm.sqrt.v8f64", [a], _VECTOR)


@elementwise(doubles_type)
def floor(builder: Any, a: Any) -> Any:
    """Round down to a whole number."""
    return llvm_call(builder, "llvm.floor.v8f64", [a], _VECTOR)


@elementwise(doubles_type)
def where_gt(builder: Any, a: Any, b: Any, yes: Any, no: Any) -> Any:
    """Return ``yes`` where a > b, ``no`` elsewhere; a NaN is not greater."""
    return builder.select(builder.fcmp_ordered(">", a, b), yes, no)


@intrinsic
def any_gt(typing: Any, a: Any, b: Any) -> Any:
    """Tell whether a > b in any lane."""

    def generate(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        bits = builder.bitcast(builder.fcmp_ordered(">", *args), ir.IntType(WIDTH))
        return builder.icmp_unsigned("!=", bits, ir.Constant(ir.IntType(WIDTH), 0))

    return signature(types.boolean, doubles_type, doubles_type), generate


@intrinsic
def _split(typing: Any, a: Any) -> Any:
    """Return exponent and mantissa in [1, 2) of a positive normal number."""
    pair = types.UniTuple(doubles_type, 2)

    def generate(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        def constant(value: int) -> Any:
            return ir.Constant(_LONGS, [value] * WIDTH)

        bits = builder.bitcast(args[0], _LONGS)
        exponent = builder.sub(builder.lshr(bits, constant(52)), constant(1023))
        mantissa = builder.or_(builder.and_(bits, constant((1 << 52) - 1)), constant(1023 << 52))
        numbers = builder.sitofp(exponent, _VECTOR), builder.bitcast(mantissa, _VECTOR)
        return context.make_tuple(builder, pair, numbers)

    return signature(pair, a), generate


@inlined
def log2(x: Any) -> Any:
    """Compute the base 2 logarithm of positive normal numbers, to 1e-11; undefined for others."""
    exponent, mantissa = _split(x)
    high = spread(math.sqrt(2.0))
    exponent = where_gt(mantissa, high, exponent + 1.0, exponent)
    mantissa = where_gt(mantissa, high, mantissa * 0.5, mantissa)
    s = (mantissa - 1.0) / (mantissa + 1.0)
    square = s * s
    series = square * (1 / 11) + 1 / 9
    series = series * square + 1 / 7
    series = series * square + 1 / 5
    series = series * square + 1 / 3
    return exponent + (2 / math.log(2.0)) * (s * (series * square) + s)


def _first(context: Any, builder: Any, sig: Any, args: Any, kind: Any) -> Any:
    data = array_data(context, builder, sig.args[0], args[0])
    return builder.bitcast(builder.gep(data, [args[1]]), kind.as_pointer())


def _pick(builder: Any, vector: Any, lanes: list[int]) -> Any:
    return builder.shuffle_vector(vector, vector, ir.Constant(ir.VectorType(_INT, len(lanes)), lanes))


@intrinsic(prefer_literal=True)
def load_columns(typing: Any, array: Any, index: Any, count: Any) -> Any:
    """Load the columns of eight rows of ``count`` numbers each, from ``index`` on in a flat array."""
    columns = count.literal_value
    result = types.UniTuple(doubles_type, columns)

    def generate(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        element = context.get_value_type(sig.args[0].dtype)
        rows = builder.load(_first(context, builder, sig, args, ir.VectorType(element, WIDTH * columns)), align=4)
        values = [_pick(builder, rows, [column + columns * i for i in range(WIDTH)]) for column in range(columns)]
        if element != _DOUBLE:
            values = [builder.fpext(value, _VECTOR) for value in values]
        return context.make_tuple(builder, result, values)

    return signature(result, array, types.intp, count), generate


def _join(builder: Any, vectors: list[Any]) -> Any:
    """Join all lanes of vectors, padded to a power of two of them."""
    if len(vectors) == 1:
        return vectors[0]
    size = 1 << (len(vectors) - 1).bit_length()
    vectors = [*vectors, *[ir.Constant(vectors[0].type, ir.Undefined)] * (size - len(vectors))]
    halves = [_join(builder, vectors[: size // 2]), _join(builder, vectors[size // 2 :])]
    lanes = list(range(2 * halves[0].type.count))
    return builder.shuffle_vector(*halves, ir.Constant(ir.VectorType(_INT, len(lanes)), lanes))


@intrinsic
def store_columns(typing: Any, array: Any, index: Any, columns: Any) -> Any:
    """Store eight rows, given as a tuple of columns, from ``index`` on in a flat array."""

    def generate(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        element, count = context.get_value_type(sig.args[0].dtype), sig.args[2].count
        values = [builder.extract_value(args[2], column) for column in range(count)]
        if element != _DOUBLE:
            values = [builder.fptrunc(value, ir.VectorType(element, WIDTH)) for value in values]
        rows = _pick(builder, _join(builder, values), [WIDTH * c + i for i in range(WIDTH) for c in range(count)])
        builder.store(rows, _first(context, builder, sig, args, rows.type), align=4)
        return context.get_dummy_value()

    return signature(types.void, array, types.intp, columns), generate
