"""Tensors as the arrays that kernels take."""

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
