"""Tensors as the arrays that kernels take."""

from collections.abc import Iterable

import numpy as np
import torch
from torch import Tensor


def fits(tensor: Tensor) -> bool:
    """Whether the kernels take it: single precision on the CPU. All else goes to the twins in plain torch."""
    return tensor.is_cpu and tensor.dtype == torch.float32


def array(tensor: Tensor) -> np.ndarray:
    """Its values without a gradient, C-contiguous; the same memory where that is possible."""
    # Each of the two calls is an operation of torch, even where it changes nothing.
    if tensor.requires_grad:
        tensor = tensor.detach()
    return (tensor if tensor.is_contiguous() else tensor.contiguous()).numpy()


class Held:
    """Tensors whose memory a backward pass will read again, as `ctx.save_for_backward` would watch over them."""

    def __init__(self, tensors: Iterable[Tensor]) -> None:
        self._kept = [(tensor, tensor._version, tensor.data_ptr()) for tensor in tensors]

    def check(self) -> None:
        """Whether all are as they were.

        Raises:
            RuntimeError: one was changed in place, or its memory replaced.
        """
        for tensor, version, address in self._kept:
            if tensor._version != version or tensor.data_ptr() != address:
                raise RuntimeError(
                    f"a tensor of shape {list(tensor.shape)} that the gradient needs was modified by an inplace "
                    "operation after the forward pass."
                )
