"""Float32 fused multiply-adds on all processors of a GPU, for the lower bound of floor.py."""

import torch
import triton
import triton.language as tl

LANES = tl.constexpr(256)
CHAINS = 8
ROUNDS = 20_000
"""Length of each chain in one call, which takes about a millisecond."""
PROGRAMS = 16
"""Programs of one multiprocessor, which fill its threads."""
WARPS = 4


@triton.jit
def _chains(end: tl.tensor, rounds: tl.tensor) -> None:
    """Run eight independent chains of multiply-adds; their start depends on the lane, so that nothing is folded."""
    index = tl.program_id(0) * LANES + tl.arange(0, LANES)
    x = 0.1 + index.to(tl.float32) / (LANES * tl.num_programs(0))
    y = 0.5 * x
    a, b, c, d = x, x + y, x - y, x * y
    e, f, g, h = a + b, b + c, c + d, d + a
    for _ in range(rounds):
        a, b, c, d = tl.fma(a, x, y), tl.fma(b, x, y), tl.fma(c, x, y), tl.fma(d, x, y)
        e, f, g, h = tl.fma(e, x, y), tl.fma(f, x, y), tl.fma(g, x, y), tl.fma(h, x, y)
    tl.store(end + index, a + b + c + d + e + f + g + h)


def multiply_adds(device: torch.device) -> None:
    """Do `multiply_adds_flops` operations."""
    programs = _programs(device)
    end = torch.empty(programs * LANES.value, device=device)
    _chains[(programs,)](end, ROUNDS, num_warps=WARPS)


def multiply_adds_flops(device: torch.device) -> int:
    """Return the operations of one call of `multiply_adds`: a multiplication and an addition in every lane."""
    return 2 * CHAINS * ROUNDS * LANES.value * _programs(device)


def _programs(device: torch.device) -> int:
    return PROGRAMS * torch.cuda.get_device_properties(device).multi_processor_count
