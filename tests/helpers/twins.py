"""The same function twice, in double precision (plain torch) and in single (fused), for tests of the kernels."""

from collections.abc import Callable

import torch
from torch import Tensor

Make = Callable[[torch.dtype], tuple[list[Tensor], dict[str, Tensor]]]


def normal(*shape: int, seed: int) -> Tensor:
    return torch.randn(shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def unit(*shape: int, seed: int) -> Tensor:
    return torch.nn.functional.normalize(normal(*shape, seed=seed), dim=-1)


def leaves(dtype: torch.dtype, **values: Tensor) -> dict[str, Tensor]:
    return {name: value.to(dtype).detach().clone().requires_grad_() for name, value in values.items()}


def same_on_any_threads(make: Callable[[], list[Tensor]], counts: tuple[int, ...] = (1, 2, 4)) -> list[Tensor]:
    """The same bits for each number of threads; gives them."""
    before, found = torch.get_num_threads(), []
    try:
        for threads in counts:
            torch.set_num_threads(threads)
            found.append(make())
    finally:
        torch.set_num_threads(before)
    for other in found[1:]:
        assert all(torch.equal(a, b) for a, b in zip(found[0], other, strict=True))
    return found[0]


def check_twins(make: Make, tolerance: float = 2e-5) -> None:
    """The same function in double (plain torch) and single precision (fused): relative errors of values and gradients.

    ``make`` gives the outputs and the inputs by name for a dtype.
    """
    found = []
    for dtype in (torch.float64, torch.float32):
        outputs, inputs = make(dtype)
        loss = torch.stack([(out * normal(*out.shape, seed=i).to(out)).sum() for i, out in enumerate(outputs)]).sum()
        loss.backward()
        found.append((outputs, {name: tensor.grad for name, tensor in inputs.items()}))
    (wanted, slopes), (got, own) = found
    scale = max(float(slope.norm()) for slope in slopes.values() if slope is not None)
    for i, (a, b) in enumerate(zip(wanted, got, strict=True)):
        assert (a - b).norm() <= tolerance * a.norm(), f"output {i}"
    for name, slope in slopes.items():
        if slope is None:
            assert own[name] is None or own[name].abs().max() == 0, name
        else:
            # A gradient that is zero in exact arithmetic (a key's bias) is held to the size of the others.
            limit = tolerance * max(float(slope.norm()), 1e-2 * scale)
            assert float((slope - own[name]).norm()) <= limit, f"gradient of {name}"
