"""Image similarity: PSNR and SSIM, each as a pure function that gives one value per image.

All images are float tensors in [0, 1], [B, C, H, W]; predictions and truths share size and background.
"""

import torch
from torch import Tensor

WINDOW = 11
"""Side of the SSIM window in pixels."""
PSNR_CAP = 100.0
"""Identical images have an infinite PSNR; it is reported as this many dB so that a mean exists."""


def psnr(prediction: Tensor, target: Tensor, mask: Tensor | None = None) -> Tensor:
    """Peak signal-to-noise ratio, 10 log10(1 / MSE), peak 1, capped at `PSNR_CAP`.

    Args:
        prediction: in [0, 1], [B, C, H, W].
        target: in [0, 1], [B, C, H, W].
        mask: pixels to count, boolean, [B, 1, H, W]; all where None. The mean is over the counted pixels only,
            so a larger empty background does not change it.

    Returns:
        Decibels per image, float64, [B]; NaN for an image with no counted pixel (the caller says "not computed").
    """
    _check_pair(prediction, target)
    squares = (prediction.double() - target.double()).square()
    if mask is None:
        error = squares.flatten(1).mean(1)
    else:
        expected = (target.shape[0], 1, *target.shape[2:])
        if mask.shape != expected:
            raise ValueError(f"expected a mask of shape {expected}, got {tuple(mask.shape)}")
        counted = mask.to(squares)
        error = (squares * counted).flatten(1).sum(1) / (counted.flatten(1).sum(1) * target.shape[1])
    return (-10.0 * error.clamp_min(10 ** (-PSNR_CAP / 10)).log10()).where(~error.isnan(), error)


def ssim(prediction: Tensor, target: Tensor) -> Tensor:
    """Structural similarity (Wang et al. 2004): 11x11 Gaussian window, sigma 1.5, population covariance, valid region.

    Equals scikit-image with gaussian_weights=True, sigma=1.5, use_sample_covariance=False, data_range=1.

    Args:
        prediction: in [0, 1], [B, C, H, W], at least 11 pixels each way.
        target: in [0, 1], [B, C, H, W].

    Returns:
        Mean over the map and the channels per image, float64, [B].
    """
    _check_pair(prediction, target)
    if min(target.shape[2:]) < WINDOW:
        raise ValueError(f"expected images of at least 11x11 pixels for SSIM, got {target.shape[3]}x{target.shape[2]}")
    return torch.stack([_ssim_of_one(x, y) for x, y in zip(prediction, target, strict=True)])


def _ssim_of_one(prediction: Tensor, target: Tensor) -> Tensor:
    """SSIM of one image [C, H, W].

    The map is exactly one wherever its window sees no difference, so only the rest is computed.
    """
    height, width = target.shape[1:]
    differs = (prediction != target).any(0)
    if not differs.any():
        return torch.ones((), dtype=torch.float64, device=target.device)
    top, bottom = _span(differs.any(1), height)
    left, right = _span(differs.any(0), width)
    x, y = (image[:, top:bottom, left:right].double() for image in (prediction, target))
    mean_x, mean_y, xx, yy, xy = _blur(torch.stack((x, y, x * x, y * y, x * y)))
    c1, c2 = 0.01**2, 0.03**2
    luminance = (2 * mean_x * mean_y + c1) / (mean_x**2 + mean_y**2 + c1)
    structure = (2 * (xy - mean_x * mean_y) + c2) / (xx - mean_x**2 + yy - mean_y**2 + c2)
    positions = target.shape[0] * (height - WINDOW + 1) * (width - WINDOW + 1)
    return 1 - (1 - luminance * structure).sum() / positions


def _span(differs: Tensor, size: int) -> tuple[int, int]:
    """Rows (or columns) that the windows over a difference read, as a slice of at least one window."""
    places = torch.nonzero(differs)
    first = min(max(0, int(places[0]) - WINDOW + 1), size - WINDOW)
    return first, max(min(size, int(places[-1]) + WINDOW), first + WINDOW)


def _blur(images: Tensor) -> Tensor:
    """Separable Gaussian window over the valid region as two banded products, [..., H, W] -> [..., H-10, W-10]."""
    rows, columns = (_band(size, images) for size in images.shape[-2:])
    return rows @ images @ columns.T


def _band(size: int, like: Tensor) -> Tensor:
    """Each row holds the window, shifted by one, [size-10, size]."""
    offsets = torch.arange(WINDOW, dtype=like.dtype, device=like.device) - WINDOW // 2
    window = torch.exp(-(offsets**2) / (2 * 1.5**2))
    band = torch.zeros(size - WINDOW + 1, size, dtype=like.dtype, device=like.device)
    for row in range(len(band)):
        band[row, row : row + WINDOW] = window / window.sum()
    return band


def _check_pair(prediction: Tensor, target: Tensor) -> None:
    if prediction.shape != target.shape or prediction.ndim != 4:
        shapes = f"{tuple(prediction.shape)} and {tuple(target.shape)}"
        raise ValueError(f"expected two image batches of one shape [B, C, H, W], got {shapes}")
