"""The cheapest path through the frames of a clip, by dynamic programming."""

import torch
from torch import Tensor


def cheapest_path(costs: Tensor, steps: Tensor) -> Tensor:
    """Choose one of C guesses for each frame, so that their costs and those of the steps between frames are least in
    sum.

    Args:
        costs: of each guess in each frame, [T, C].
        steps: from one guess, by row, to another, by column, [C, C].

    Returns:
        Indices of the guesses, [T].
    """
    total, origins = costs[0], []
    for cost in costs[1:]:
        least, origin = (total[:, None] + steps).min(dim=0)
        total = least + cost
        origins.append(origin)
    path = [total.argmin()]
    for origin in reversed(origins):
        path.append(origin[path[-1]])
    return torch.stack(path[::-1])
