"""Adam for the training step: torch's own rule and state, all tensors of the CPU in one call."""

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from rewild4d.kernels.pointers import packed
from rewild4d.ours.fused.adam import adam_step


class Adam(torch.optim.Adam):
    """`torch.optim.Adam` without weight decay and AMSGrad; its state is torch's, so either continues the other.

    Tensors that the kernel does not take (another device or precision) go through torch's fused step.
    """

    def __init__(
        self, params: Any, lr: float = 1e-3, betas: tuple[float, float] = (0.9, 0.999), eps: float = 1e-8
    ) -> None:
        super().__init__(params, lr=lr, betas=betas, eps=eps, fused=True)

    def zero_grad(self, set_to_none: bool = True) -> None:
        """Forget the gradients."""
        if not set_to_none:
            super().zero_grad(set_to_none=False)
            return
        for group in self.param_groups:
            for parameter in group["params"]:
                parameter.grad = None

    @torch.no_grad()
    def step(self, closure: Callable[[], Any] | None = None) -> Any:
        """Move every parameter that has a gradient."""
        active = [
            (parameter, parameter.grad, group)
            for group in self.param_groups
            for parameter in group["params"]
            if parameter.grad is not None
        ]
        if closure is not None or not all(packed(each) and packed(slope) for each, slope, _ in active):
            return super().step(closure)
        places, rates = [], []
        for parameter, slope, group in active:
            state = self.state[parameter] or self._start(parameter)
            mean, square, count = state["exp_avg"], state["exp_avg_sq"], parameter.numel()
            if not mean.numel() == square.numel() == count:
                raise ValueError(f"Adam's state is of {list(mean.shape)}, the parameter of {list(parameter.shape)}.")
            addresses = [each.data_ptr() for each in (parameter, slope, mean, square, state["step"])]
            places.append((*addresses, count))
            rates.append((group["lr"], *group["betas"], group["eps"]))
        if places:
            adam_step(places, rates)
            torch.autograd.graph.increment_version([parameter for parameter, _, _ in active])
        return None

    def _start(self, parameter: Tensor) -> dict[str, Tensor]:
        """The state before the first step."""
        self.state[parameter] = {
            "step": torch.zeros((), dtype=torch.float32),
            "exp_avg": torch.zeros_like(parameter),
            "exp_avg_sq": torch.zeros_like(parameter),
        }
        return self.state[parameter]
