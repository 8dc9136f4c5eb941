"""Clip gradients."""

import torch
from torch import Tensor, nn

from rewild4d.kernels.pointers import packed
from rewild4d.ours.fused.gradients import GRADIENTS, measure, scale


def clip_gradients(parameters: list[nn.Parameter], limit: float) -> float:
    """Scale gradients down to a norm of at most ``limit``; return the norm before, not finite where a gradient is not.

    As `torch.nn.utils.clip_grad_norm_`, whose norms of many small tensors are slow on a CPU.
    """
    gradients = [parameter.grad for parameter in parameters if parameter.grad is not None]
    fused = GRADIENTS.takes(*gradients) and all(map(packed, gradients))
    norm = measure(gradients)[0] if fused else _norm(gradients)
    if norm > limit:
        factor = limit / (norm + 1e-6)
        if fused:
            scale(gradients, factor)
        else:
            torch._foreach_mul_(gradients, factor)
    return norm


def norm_of(parameters: list[nn.Parameter]) -> Tensor:
    """Return the norm of all gradients together, scalar; not finite where one is not; no look at a number."""
    gradients = [parameter.grad for parameter in parameters if parameter.grad is not None]
    norms = torch._foreach_norm(gradients) if gradients else [parameters[0].new_zeros(())]
    return torch.stack(list(norms)).norm()


def scale_gradients(parameters: list[nn.Parameter], factor: Tensor) -> None:
    """Multiply all gradients by a scalar."""
    if gradients := [parameter.grad for parameter in parameters if parameter.grad is not None]:
        torch._foreach_mul_(gradients, factor)


def all_finite(parameters: list[nn.Parameter]) -> bool:
    """Tell whether all gradients are finite."""
    gradients = [parameter.grad for parameter in parameters if parameter.grad is not None]
    if GRADIENTS.takes(*gradients) and all(map(packed, gradients)):
        return measure(gradients)[1]
    return bool(_flat(gradients).isfinite().all())  # one look: each would wait for a GPU


def require_finite(model: nn.Module, index: int) -> None:
    """Raise a FloatingPointError that names the iteration and the first parameter whose gradient is not finite."""
    for name, parameter in model.named_parameters():
        if parameter.grad is not None and not torch.isfinite(parameter.grad).all():
            raise FloatingPointError(f"iteration {index}: the gradient of '{name}' is not finite")


def _norm(gradients: list[Tensor]) -> float:
    flat = _flat(gradients)
    return float(flat.dot(flat).sqrt())


def _flat(gradients: list[Tensor]) -> Tensor:
    return torch.cat([gradient.flatten() for gradient in gradients]) if gradients else torch.zeros(1)
