"""Check in one call that all numbers of several tensors are finite and below a bound."""

from collections.abc import Iterable

import numpy as np
from torch import Tensor

from rewild4d.kernels.compiling import kernel
from rewild4d.kernels.pointers import floats_at, packed
from rewild4d.kernels.simd import LANES, absolute, bits_gt, load, splat

_STEP = 4 * LANES
_ALL = (1 << LANES) - 1


@kernel
def _all_below(addresses: np.ndarray, counts: np.ndarray, bound: float) -> bool:
    """Tell whether every float32 number at these addresses is below the bound in magnitude; NaN is not."""
    limit, inside = splat(np.float32(bound)), _ALL
    for run in range(len(addresses)):
        values = floats_at(addresses[run], counts[run])
        whole = counts[run] // _STEP * _STEP
        for i in range(0, whole, _STEP):
            inside &= (
                bits_gt(limit, absolute(load(values, i)))
                & bits_gt(limit, absolute(load(values, i + LANES)))
                & bits_gt(limit, absolute(load(values, i + 2 * LANES)))
                & bits_gt(limit, absolute(load(values, i + 3 * LANES)))
            )
        for i in range(whole, counts[run]):
            if not abs(values[i]) < bound:
                inside = 0
    return inside == _ALL


def all_below(tensors: Iterable[Tensor], bound: float) -> bool:
    """Tell whether every number of float32 CPU tensors is below a positive bound in magnitude; NaN is not."""
    kept = [tensor.contiguous() for tensor in tensors]  # alive until the kernel has read them
    assert all(map(packed, kept))
    spans = np.array([(tensor.data_ptr(), tensor.numel()) for tensor in kept], np.int64).reshape(-1, 2)
    return _all_below(spans[:, 0], spans[:, 1], bound)
