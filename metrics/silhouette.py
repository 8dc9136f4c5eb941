"""Agreement of silhouettes."""

import torch
from torch import Tensor


def mask_iou(prediction: Tensor, target: Tensor, threshold: float = 0.5) -> Tensor:
    """Intersection over union of two mattes, both cut at a threshold.

    Args:
        prediction: matte in [0, 1], [B, 1, H, W].
        target: matte in [0, 1], [B, 1, H, W].
        threshold: a pixel is inside where the matte is at least this.

    Returns:
        Per image in [0, 1], float64, [B]; NaN where both are empty (the caller reports it as not computed).
    """
    if prediction.shape != target.shape or prediction.ndim != 4 or prediction.shape[1] != 1:
        raise ValueError(
            f"expected two mattes of one shape [B, 1, H, W], got {tuple(prediction.shape)} and {tuple(target.shape)}"
        )
    a, b = (prediction >= threshold).flatten(1), (target >= threshold).flatten(1)
    return (a & b).sum(1).to(torch.float64) / (a | b).sum(1).to(torch.float64)
