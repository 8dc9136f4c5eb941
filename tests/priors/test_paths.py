"""Paths by dynamic programming against all paths."""

import itertools

import torch

from rewild4d.priors.paths import cheapest_path


def test_a_path_is_the_cheapest_of_all() -> None:
    generator = torch.Generator().manual_seed(0)
    costs, steps = torch.rand(5, 4, generator=generator), torch.rand(4, 4, generator=generator)

    def total(path: tuple[int, ...]) -> float:
        changes = zip(path[:-1], path[1:], strict=True)
        return float(sum(costs[t, row] for t, row in enumerate(path)) + sum(steps[a, b] for a, b in changes))

    best = min(itertools.product(range(4), repeat=5), key=total)
    assert tuple(cheapest_path(costs, steps).tolist()) == best
    assert cheapest_path(costs, 100 * (1 - torch.eye(4))).tolist() == [int(costs.sum(0).argmin())] * 5
    assert cheapest_path(costs[:1], steps).tolist() == [int(costs[0].argmin())]
