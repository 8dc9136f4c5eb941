"""Many tensors in one call: kernels that take addresses, since an array for each tensor would cost a microsecond."""

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
    """An address as a pointer to float32."""

    def generate(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        return builder.inttoptr(args[0], ir.FloatType().as_pointer())

    return signature(types.CPointer(types.float32), types.int64), generate


@inlined
def floats_at(address: int, count: int) -> np.ndarray:
    """The float32 numbers at an address, as an array of the same memory."""
    return numba.carray(_pointer(address), count)


def packed(tensor: Tensor) -> bool:
    """Whether a kernel may read it at its address: single precision on the CPU without gaps."""
    return tensor.is_cpu and tensor.dtype == torch.float32 and tensor.is_contiguous()
