"""The animal's root motion and the input cameras between the frames of a clip."""

import torch
from torch import Tensor
from torch.nn.functional import normalize

from rewild4d.transforms import matrix_to_quat, quat_to_matrix, similarity, split_similarity


def frame_position(times: Tensor, time: float) -> float:
    """Where a time lies among the frames: 1.5 is half-way between the second and the third; clamped to the clip.

    Args:
        times: of the frames, ascending, [T].
        time: seconds.
    """
    if len(times) == 1 or time <= float(times[0]):
        return 0.0
    if time >= float(times[-1]):
        return float(len(times) - 1)
    after = int(torch.searchsorted(times, torch.tensor(time, dtype=times.dtype), right=True))
    before, low = after - 1, float(times[after - 1])
    return before + (time - low) / (float(times[after]) - low)


def interpolate_similarity(matrices: Tensor, position: float) -> Tensor:
    """A similarity between those of the frames: rotation by normalised quaternion blend, the rest linearly.

    Args:
        matrices: [T, 4, 4].
        position: from `frame_position`.

    Returns:
        [4, 4].
    """
    low = int(position)
    part = position - low
    if part == 0:
        return matrices[low]
    scale, rotation, translation = split_similarity(matrices[low : low + 2])
    first, second = matrix_to_quat(rotation)
    second = torch.where((first * second).sum() < 0, -second, second)
    turn = quat_to_matrix(normalize((1 - part) * first + part * second, dim=0))
    mix = torch.tensor((1 - part, part), dtype=matrices.dtype)
    return similarity((mix * scale).sum(), turn, mix @ translation)
