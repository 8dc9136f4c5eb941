"""Powers of two on the sixteen lanes of simd.py."""

from typing import Any

import numpy as np
from llvmlite import ir
from numba.core.typing import signature

from rewild4d.kernels.compiling import inlined
from rewild4d.kernels.simd import INTEGERS, LANES, VECTOR, broadcast, constant, fma, intrinsic, lanes_type, llvm_call

LOG2_E = np.float32(1.4426950408889634)
"""exp(x) = exp2(x LOG2_E)."""


def _power_of_two_fit() -> list[float]:
    """Fit 2**x on [-1/2, 1/2]: degree 5 at Chebyshev nodes, relative error 2e-7 in float32."""
    nodes = 0.5 * np.cos((np.arange(6) + 0.5) * np.pi / 6)
    return [float(value) for value in np.polyfit(nodes, np.exp2(nodes), 5)]


POWER_TERMS = np.array([1.5 * 2.0**23, *_power_of_two_fit()], np.float32)
"""Constants of `exp2_with`: one whose addition rounds to an integer in the low bits, then the polynomial."""


@intrinsic
def _times_power(typing: Any, value: Any, shifted: Any) -> Any:
    """Multiply by two to the power in the low bits of ``shifted``."""

    def generate(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        exponent = builder.shl(builder.bitcast(args[1], INTEGERS), ir.Constant(INTEGERS, [23] * LANES))
        return builder.bitcast(builder.add(builder.bitcast(args[0], INTEGERS), exponent), VECTOR)

    return signature(lanes_type, lanes_type, lanes_type), generate


@inlined
def load_terms(constants: np.ndarray, index: int) -> tuple:
    """Load `POWER_TERMS` from an array that holds them at ``index``."""
    return (
        broadcast(constants, index), broadcast(constants, index + 1), broadcast(constants, index + 2),
        broadcast(constants, index + 3), broadcast(constants, index + 4), broadcast(constants, index + 5),
        broadcast(constants, index + 6),
    )  # fmt: skip


@inlined
def exp2_with(terms: tuple, x: Any) -> Any:
    """Compute `exp2` with constants in registers: as literals each costs an instruction of ten bytes at every use."""
    shifted = x + terms[0]
    fraction = x - (shifted - terms[0])
    value = fma(terms[1], fraction, terms[2])
    value = fma(value, fraction, terms[3])
    value = fma(value, fraction, terms[4])
    value = fma(value, fraction, terms[5])
    value = fma(value, fraction, terms[6])
    return _times_power(value, shifted)


@intrinsic
def exp2(typing: Any, x: Any) -> Any:
    """Compute 2**x for -126 <= x <= 126; undefined outside."""
    coefficients = _power_of_two_fit()

    def generate(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        magic = constant(1.5 * 2.0**23)  # adding it rounds to an integer, left in the low bits
        shifted = builder.fadd(args[0], magic)
        fraction = builder.fsub(args[0], builder.fsub(shifted, magic))
        value = constant(coefficients[0])
        for coefficient in coefficients[1:]:
            value = llvm_call(builder, "llvm.fma.v16f32", [value, fraction, constant(coefficient)])
        exponent = builder.shl(builder.bitcast(shifted, INTEGERS), ir.Constant(INTEGERS, [23] * LANES))
        return builder.bitcast(builder.add(builder.bitcast(value, INTEGERS), exponent), VECTOR)

    return signature(lanes_type, lanes_type), generate
