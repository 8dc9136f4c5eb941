"""Products of components in few operations of torch: on a GPU a training step waits for how many there are."""

from functools import cache

import torch
from torch import Tensor


def products(a: Tensor, b: Tensor) -> Tensor:
    """Return all a_i b_j, i the slower index, [..., n] and [..., m] -> [..., n m].

    The components are spread by matrices of zeros and ones: the gradient of a broadcast product would be a sum along
    short axes, which takes a CPU twice as long.
    """
    left, right = _spread(a.shape[-1], b.shape[-1], a.device, a.dtype)
    return (a @ left) * (b @ right)


@cache
def _spread(n: int, m: int, device: torch.device, dtype: torch.dtype) -> tuple[Tensor, Tensor]:
    left, right = torch.eye(n).repeat_interleave(m, dim=1), torch.eye(m).repeat(1, n)
    return left.to(device, dtype), right.to(device, dtype)
