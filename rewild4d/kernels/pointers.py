"""Kernels on many tensors in one call: they take addresses, since an array for each tensor costs a microsecond."""

from typing import Any

import numba
import numpy as np
import torch
from llvmlite import ir
from numba.core import types
from numba.core.typing import signature
from torch import Tensor

from rewild4d.kernels.compiling import inlined
from rewild4d.kernels.simd import intrinsic


@intrinsic
def _pointer(typing: Any, address: Any) -> Any:
    """Convert an address to a pointer to float32."""

    def generate(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        return builder.inttoptr(args[0], ir.FloatType().as_pointer())

    return signature(types.CPointer(types.float32), types.int64), generate


@inlined
def floats_at(address: int, count: int) -> np.ndarray:
    """Return the float32 numbers at an address as an array of the same memory."""
    return numba.carray(_pointer(address), count)


def packed(tensor: Tensor) -> bool:
    """Tell whether a kernel may read a tensor at its address: contiguous float32 on the CPU."""
    return tensor.is_cpu and tensor.dtype == torch.float32 and tensor.is_contiguous()
