"""One look at all numbers of several tensors: every place of each, whole vectors and what is left of them."""

import math

import pytest
import torch

from rewild4d.kernels.magnitudes import all_below


@pytest.mark.parametrize("count", [1, 63, 64, 65, 130])
@pytest.mark.parametrize("odd", [math.nan, math.inf, -math.inf, 8.0, -8.0])
def test_one_odd_number_is_seen_wherever_it_stands(count: int, odd: float) -> None:
    before, after = torch.ones(3), -torch.ones(70)
    for place in range(count):
        values = torch.linspace(-7.9, 7.9, count)
        assert all_below((before, values, after), 8.0)
        values[place] = odd
        assert not all_below((before, values, after), 8.0), place


def test_tensors_of_any_layout_and_none_at_all() -> None:
    wide = torch.zeros(4, 6)
    wide[:, 3:] = math.nan
    assert all_below((wide[:, :3], wide.T[:3]), 1.0)
    assert not all_below((wide[:, 1:4],), 1.0)
    assert all_below((), 1.0)
    assert all_below((torch.zeros(0, 3), torch.zeros(1).expand(5, 2)), 1.0)
