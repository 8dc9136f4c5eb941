"""Clipping of gradients."""

import torch
from torch import Tensor, nn


def clip_gradients(parameters: list[nn.Parameter], limit: float) -> Tensor:
    """Scale gradients down to a norm of at most ``limit``; gives the norm before, scalar.

    As `torch.nn.utils.clip_grad_norm_`, whose norms of many small tensors are slow on a CPU.
    """
    gradients = [parameter.grad for parameter in parameters if parameter.grad is not None]
    if not gradients:
        return torch.zeros(())
    flat = torch.cat([gradient.flatten() for gradient in gradients])
    norm = flat.dot(flat).sqrt()
    if norm > limit:
        for gradient in gradients:
            gradient.mul_(limit / (norm + 1e-6))
    return norm
