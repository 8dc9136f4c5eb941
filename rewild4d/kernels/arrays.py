"""Convert tensors to the arrays that kernels take."""

import numpy as np
import torch
from torch import Tensor


def fits(tensor: Tensor) -> bool:
    """Tell whether the kernels take a tensor (float32 on the CPU); others go to the torch twins."""
    return tensor.is_cpu and tensor.dtype == torch.float32


def array(tensor: Tensor) -> np.ndarray:
    """Return a tensor's values without a gradient, C-contiguous, in the same memory where possible."""
    # Each of the two calls is an operation of torch, even where it changes nothing.
    if tensor.requires_grad:
        tensor = tensor.detach()
    return (tensor if tensor.is_contiguous() else tensor.contiguous()).numpy()
