"""Compute image scores as single papers do, where that differs from `metrics.image` and `metrics.silhouette`.

All images are float tensors in [0, 1], [B, 3, H, W], masks boolean, [B, 1, H, W].
"""

import math

import torch
from torch import Tensor
from torch.nn.functional import pad

from rewild4d.metrics.image import WINDOW, ssim
from rewild4d.metrics.tallies import Floats, FrameSums

SMOOTH = 1e-6
"""Added by Animal Avatars to an intersection, a union and a root mean squared error."""
RMSE_PSNR_CAP = 120.0
"""PSNR of identical images by `psnr_of_rmse`, dB: 20 log10(1 / `SMOOTH`)."""
FACTORS = 100
"""Brightness factors that 4DEquine tries."""


def overlap(prediction: Tensor, target: Tensor) -> FrameSums:
    """Count the pixels of each pair's intersection (sums) and union (counts).

    `FrameSums.pooled` is then the IoU of a whole sequence (Animal-in-Motion, scripts/run_benchmark.py at 904a443), and
    `FrameSums.mean_of_frames` the mean of the frames' IoU; a frame in which both are empty counts nothing.

    Args:
        prediction: boolean, [B, 1, H, W].
        target: boolean, [B, 1, H, W].

    Examples:
        >>> a, b = torch.tensor([[[[True, True, False]]]]), torch.tensor([[[[True, False, False]]]])
        >>> overlap(a, b).pooled()
        0.5
    """
    _check(prediction, target, channels=1)
    both, either = ((f(prediction, target)).flatten(1).sum(1) for f in (torch.logical_and, torch.logical_or))
    return FrameSums(both.double().cpu().numpy(), either.cpu().numpy())


def smoothed_iou(found: FrameSums) -> Floats:
    """Compute (I + 1e-6) / (U + 1e-6) of each frame, [B]: 1 where both masks are empty.

    Source: Animal Avatars, losses/loss_utils.py at 4623ecd.

    Examples:
        >>> import numpy as np
        >>> smoothed_iou(FrameSums(np.array([3.0, 0.0]), np.array([4, 0]))).round(4).tolist()
        [0.75, 1.0]
    """
    return (found.sums + SMOOTH) / (found.counts + SMOOTH)


def psnr_of_rmse(prediction: Tensor, target: Tensor, mask: Tensor | None = None) -> Tensor:
    """Compute 20 log10(1 / (RMSE + 1e-6)) of each pair, at most 120 dB.

    PSNR and PSNRM of Animal Avatars, losses/loss_utils.py and scene_optim/evaluators/psnr_evaluator.py at 4623ecd.

    Args:
        prediction: [B, 3, H, W].
        target: [B, 3, H, W].
        mask: pixels of the mean (PSNRM), boolean, [B, 1, H, W]; all where None.

    Returns:
        Decibels, float64, [B]; NaN for an image without a pixel in the mask.

    Examples:
        >>> psnr_of_rmse(torch.full((1, 3, 2, 2), 0.6), torch.full((1, 3, 2, 2), 0.5)).round(decimals=3).tolist()
        [20.0]
    """
    _check(prediction, target, channels=3)
    squares = (prediction.double() - target.double()).square()
    counted = torch.ones_like(squares) if mask is None else mask.expand_as(squares).double()
    mean = (squares * counted).flatten(1).sum(1) / counted.flatten(1).sum(1)
    return 20 * torch.log10(1 / (mean.sqrt() + SMOOTH))


def pooled_psnr(squares: float, count: int) -> float:
    """Compute the PSNR of one mean squared error over a whole sequence, 10 log10(count / squares), in dB.

    It is never above the mean of the frames' PSNR. Source: torchmetrics' PeakSignalNoiseRatio, which 4DEquine
    (amr/utils/evaluate_metric.py at 7f272d8) updates with all frames of a sequence.

    Args:
        squares: sum of squared differences, above zero.
        count: how many.

    Examples:
        >>> round(pooled_psnr(0.5, 50), 6)
        20.0
    """
    return 10 * math.log10(count / squares)


def ssim_reflected(prediction: Tensor, target: Tensor) -> Tensor:
    """Compute `image.ssim` over every pixel, the border continued by its reflection, [B, 3, H, W] -> float64, [B].

    So torchmetrics' StructuralSimilarityIndexMeasure (1.9.0) has it, which 4DEquine uses; `image.ssim` takes the mean
    over the windows that lie inside of the image, so that a plain border counts less.

    Examples:
        >>> black, white = torch.zeros(1, 3, 16, 16), torch.ones(1, 3, 16, 16)
        >>> ssim_reflected(white, white).tolist(), ssim_reflected(black, white).round(decimals=4).tolist()
        ([1.0], [0.0001])
    """
    half = WINDOW // 2
    return ssim(*(pad(images, (half, half, half, half), mode="reflect") for images in (prediction, target)))


def brightness_factors() -> Tensor:
    """Return the factors that 4DEquine tries, evenly from 0 to 2, float32, [100]; 1 is none of them.

    Examples:
        >>> [round(float(factor), 4) for factor in brightness_factors()[[0, 49, 50, 99]]]
        [0.0, 0.9899, 1.0101, 2.0]
    """
    return torch.linspace(0.0, 2.0, FACTORS)


def brightened(prediction: Tensor, factor: float) -> Tensor:
    """Multiply all rendered pixels by a factor, cut at 1; pixels that are exactly white are the background and stay.

    Source: 4DEquine, amr/utils/evaluate_metric.py at 7f272d8, with kornia's adjust_brightness_accumulative (image x
    factor, cut to [0, 1]).

    Examples:
        >>> brightened(torch.tensor([0.25, 1.0]).reshape(1, 1, 1, 2).repeat(1, 3, 1, 1), 2.0)[0, 0].tolist()
        [[0.5, 1.0]]
    """
    drawn = (prediction != 1).any(1, keepdim=True)
    return torch.where(drawn, (prediction * factor).clamp(0, 1), prediction)


def brightness_errors(prediction: Tensor, target: Tensor) -> Tensor:
    """Compute the sum of squared differences for each of the `brightness_factors`, float64, [100].

    Sums of several batches add up; the factor of the best pooled PSNR has the least of them.

    Args:
        prediction: on white, [B, 3, H, W].
        target: on white, [B, 3, H, W].

    Examples:
        >>> dark, true = torch.full((1, 3, 2, 2), 0.25), torch.full((1, 3, 2, 2), 0.5)
        >>> int(brightness_errors(dark, true).argmin())
        99
    """
    _check(prediction, target, channels=3)
    drawn = (prediction != 1).any(1)
    still = (prediction - target).double().square().sum(1)[~drawn].sum()
    ours, theirs = (images.permute(0, 2, 3, 1)[drawn] for images in (prediction, target))
    moved = [((ours * factor).clamp(0, 1) - theirs).double().square().sum() for factor in brightness_factors()]
    return torch.stack(moved) + still


def for_unscaled_network(images: Tensor) -> Tensor:
    """Return images that reach LPIPS's network as if nobody had scaled them to [-1, 1].

    `features.Lpips` takes [0, 1] and scales inside, x -> 2 x - 1; of (x + 1) / 2 it therefore reads x itself, as when
    torchmetrics' LearnedPerceptualImagePatchSimilarity with its default normalize=False is given [0, 1]: so 4DEquine,
    amr/utils/evaluate_metric.py at 7f272d8. The values are smaller and compare with no others.

    Examples:
        >>> (for_unscaled_network(torch.tensor([0.0, 1.0])) * 2 - 1).tolist()
        [0.0, 1.0]
    """
    return (images + 1) / 2


def _check(prediction: Tensor, target: Tensor, channels: int) -> None:
    if prediction.shape != target.shape or prediction.ndim != 4 or prediction.shape[1] != channels:
        shapes = f"{tuple(prediction.shape)} and {tuple(target.shape)}"
        raise ValueError(f"expected two batches of one shape [B, {channels}, H, W], got {shapes}")
