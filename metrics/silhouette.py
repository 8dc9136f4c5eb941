"""Compare silhouettes by region (IoU, Dice) and by contour (boundary F).

Every function cuts two mattes [B, 1, H, W] at a threshold and returns one value per image, NaN where both are empty.
"""

import math

import numpy as np
import torch
from scipy.spatial import cKDTree
from torch import Tensor

BOUNDARY_TOLERANCE = 0.008
"""Distance at which two contours still match, as a share of the image's diagonal (DAVIS)."""


def mask_iou(prediction: Tensor, target: Tensor, threshold: float = 0.5) -> Tensor:
    """Compute the intersection over union of two mattes.

    Args:
        prediction: matte in [0, 1], [B, 1, H, W].
        target: matte in [0, 1], [B, 1, H, W].
        threshold: a pixel is inside where the matte is at least this.

    Returns:
        Per image in [0, 1], float64, [B]; NaN where both are empty.

    Examples:
        >>> mask_iou(torch.tensor([[[[1.0, 1.0, 0.0]]]]), torch.tensor([[[[1.0, 0.0, 0.0]]]])).tolist()
        [0.5]
    """
    a, b = (mask.flatten(1) for mask in _cut(prediction, target, threshold))
    return (a & b).sum(1).to(torch.float64) / (a | b).sum(1).to(torch.float64)


def mask_dice(prediction: Tensor, target: Tensor, threshold: float = 0.5) -> Tensor:
    """Compute the Dice coefficient 2 |A & B| / (|A| + |B|) (Dice 1945); arguments, range and NaN as `mask_iou`, [B].

    Examples:
        >>> mask_dice(torch.tensor([[[[1.0, 1.0, 1.0]]]]), torch.tensor([[[[1.0, 0.0, 0.0]]]])).tolist()
        [0.5]
    """
    a, b = (mask.flatten(1) for mask in _cut(prediction, target, threshold))
    return 2 * (a & b).sum(1).to(torch.float64) / (a.sum(1) + b.sum(1)).to(torch.float64)


def boundary_f(
    prediction: Tensor, target: Tensor, threshold: float = 0.5, tolerance: float = BOUNDARY_TOLERANCE
) -> Tensor:
    """Compute the contour accuracy F of the DAVIS benchmark (Perazzi et al. 2016).

    A contour pixel differs from its right, lower or lower right neighbour. Precision is the share of predicted contour
    pixels with a true one within r pixels (centre to centre), recall the reverse, F = 2 P R / (P + R). The radius is
    r = ceil(tolerance * sqrt(H^2 + W^2)), 3 pixels at 256x256. DAVIS scores two empty masks as 1; here they are NaN.

    Args:
        prediction: matte in [0, 1], [B, 1, H, W].
        target: matte in [0, 1], [B, 1, H, W].
        threshold: a pixel is inside where the matte is at least this.
        tolerance: share of the image's diagonal.

    Returns:
        Per image in [0, 1], float64, [B]; 0 where one contour is empty, NaN where neither image has one (both masks
        empty, or both full: the image's border is no contour).

    Examples:
        >>> truth, prediction = torch.zeros(1, 1, 16, 16), torch.zeros(1, 1, 16, 16)
        >>> truth[..., 4:12, 4:12] = 1
        >>> prediction[..., 4:12, 5:13] = 1
        >>> boundary_f(prediction, truth).tolist(), boundary_f(1 - truth * 0, truth).tolist()
        ([1.0], [0.0])
    """
    radius = math.ceil(tolerance * math.hypot(*target.shape[-2:]))
    pairs = zip(*(_contour(mask) for mask in _cut(prediction, target, threshold)), strict=True)
    values = [_contour_f(a, b, radius) for a, b in pairs]
    return torch.tensor(values, dtype=torch.float64, device=target.device)


def _contour_f(prediction: Tensor, target: Tensor, radius: int) -> float:
    """Compute F of two contours, [H, W] each."""
    ours, theirs = (np.argwhere(contour.numpy()) for contour in (prediction, target))
    if not len(ours) and not len(theirs):
        return math.nan
    if not len(ours) or not len(theirs):
        return 0.0
    precision = float((cKDTree(theirs).query(ours)[0] <= radius).mean())
    recall = float((cKDTree(ours).query(theirs)[0] <= radius).mean())
    return 2 * precision * recall / (precision + recall) if precision + recall else 0.0


def _contour(mask: Tensor) -> Tensor:
    """Find pixels unlike a neighbour to the right, below or both, on the CPU, [B, 1, H, W] -> [B, H, W]."""
    mask = mask[:, 0].cpu()
    padded = torch.nn.functional.pad(mask.float()[:, None], (0, 1, 0, 1), mode="replicate")[:, 0] > 0
    return (mask ^ padded[:, :-1, 1:]) | (mask ^ padded[:, 1:, :-1]) | (mask ^ padded[:, 1:, 1:])


def _cut(prediction: Tensor, target: Tensor, threshold: float) -> tuple[Tensor, Tensor]:
    if prediction.shape != target.shape or prediction.ndim != 4 or prediction.shape[1] != 1:
        raise ValueError(
            f"expected two mattes of one shape [B, 1, H, W], got {tuple(prediction.shape)} and {tuple(target.shape)}"
        )
    return prediction >= threshold, target >= threshold
