"""Tensors as the arrays that kernels take."""

import numpy as np
import torch
from torch import Tensor


def fits(tensor: Tensor) -> bool:
    """Whether the kernels take it: single precision on the CPU. All else goes to the twins in plain torch."""
    return tensor.dtype == torch.float32 and tensor.device.type == "cpu"


def array(tensor: Tensor) -> np.ndarray:
    """Its values without a gradient, C-contiguous; the same memory where that is possible."""
    return tensor.detach().contiguous().numpy()
