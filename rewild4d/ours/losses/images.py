"""Image losses of one view, each a sum over pixels divided by the area of the animal's box.

Outside the union of both silhouettes render and target are the same background, so the losses are computed on a crop
and equal those of the whole frame.
"""

import math
from functools import cache

import torch
from torch import Tensor
from torch.nn.functional import binary_cross_entropy

from rewild4d.kernels import gpu
from rewild4d.kernels.gpu_images import colour_sums
from rewild4d.ours.fused.images import COLOUR_LOSSES, SILHOUETTE, colour_means, matte_loss
from rewild4d.ours.symmetry import Target

WINDOW, SIGMA = 11, 1.5
"""Size and standard deviation of SSIM's Gaussian window, pixels."""
C1, C2 = 0.01**2, 0.03**2
"""SSIM's constants for images in [0, 1]."""

Window = tuple[slice, slice]


def union_window(alphas: list[Tensor], margin: int) -> Window:
    """Return rows and columns of pixels where any matte [1, h, w] is above zero, with a margin inside the image; all of
    it on a GPU, where a look at the mattes would cost more."""
    if not alphas[0].is_cpu:
        return slice(0, alphas[0].shape[1]), slice(0, alphas[0].shape[2])
    slices = []
    for (first, last), length in zip(_extent(alphas), alphas[0].shape[1:], strict=True):
        slices.append(slice(max(0, first - margin), min(length, last + 1 + margin)))
    return slices[0], slices[1]


def _extent(alphas: list[Tensor]) -> tuple[tuple[int, int], tuple[int, int]]:
    """Return first and last row and column where any matte is above zero."""
    union = torch.stack([alpha[0].detach() for alpha in alphas]).amax(0) > 0
    ends = []
    for marks in (union.any(dim=1), union.any(dim=0)):
        positions = torch.arange(len(marks), device=marks.device)
        ends += [torch.where(marks, positions, len(marks)).amin(), torch.where(marks, positions, -1).amax()]
    top, bottom, left, right = torch.stack(ends).tolist()
    return ((top, bottom), (left, right)) if top <= bottom else ((0, 0), (0, 0))


def silhouette_loss(alpha: Tensor, target: Target, window: Window) -> Tensor:
    """Compute BCE + Dice of a rendered matte, alpha [1, h, w] clamped at 1e-5, Dice smoothing 1; scalar."""
    if SILHOUETTE.takes(alpha):
        return matte_loss(alpha, target.mask, _corner_and_size(window), target.side**2)
    rendered, truth = alpha[:, *window], target.mask[:, *window]
    bce = binary_cross_entropy(rendered.clamp(1e-5, 1 - 1e-5), truth, reduction="sum") / target.side**2
    dice = 1 - (2 * (rendered * truth).sum() + 1) / (rendered.sum() + truth.sum() + 1)
    return bce + dice


def colour_losses(
    rgb: Tensor, alpha: Tensor, target: Target, background: Tensor, window: Window
) -> tuple[Tensor, Tensor]:
    """Compute L1 and 1 - SSIM of render and target over one background colour.

    Args:
        rgb: rendered colour, premultiplied, [3, h, w].
        alpha: rendered matte, [1, h, w].
        target: the image.
        background: RGB, [3].
        window: holds both silhouettes with a margin of at least 10 pixels, where the image has room.

    Returns:
        Two scalars.
    """
    area = 3 * target.side**2
    inner = _inner(window, alpha)
    if COLOUR_LOSSES.takes(rgb):
        bounds = (inner[0].start, inner[0].stop, inner[1].start, inner[1].stop)
        return colour_means(rgb, alpha, target.rgb, target.mask, background, _corner_and_size(window), bounds, area)
    if gpu.on_gpu(rgb) and window == (slice(0, rgb.shape[1]), slice(0, rgb.shape[2])):
        l1, dissimilarity = colour_sums(rgb, alpha, target.rgb, target.mask, background, C1, C2)
        return l1 / area, dissimilarity / area
    behind = background[:, None, None]
    x = rgb[:, *window] + (1 - alpha[:, *window]) * behind
    y = target.rgb[:, *window] + (1 - target.mask[:, *window]) * behind
    return (x - y).abs().sum() / area, (1 - ssim_map(x, y)[:, *inner]).sum() / area


def _corner_and_size(window: Window) -> tuple[int, int, int, int]:
    rows, columns = window
    return rows.start, columns.start, rows.stop - rows.start, columns.stop - columns.start


def _inner(window: Window, alpha: Tensor) -> Window:
    """Return the part of a window where SSIM sees no false border: five pixels in, but to the image's own edge."""
    half = WINDOW // 2
    inner = []
    for part, length in zip(window, alpha.shape[1:], strict=True):
        low = half if part.start > 0 else 0
        high = (part.stop - part.start) - (half if part.stop < length else 0)
        inner.append(slice(low, high))
    return inner[0], inner[1]


def ssim_map(x: Tensor, y: Tensor) -> Tensor:
    """Compute SSIM per pixel with zero padding, window 11, sigma 1.5 (3DGS's loss), [c, h, w] each.

    The window is separable, so the five means are products with two banded matrices.
    """
    channels, height, width = x.shape
    stacked = torch.cat((x, y, x * x, y * y, x * y))
    down, across = (blur_matrix(size, SIGMA, WINDOW // 2, x.device, x.dtype) for size in (height, width))
    blurred = down @ stacked @ across.T
    mean_x, mean_y, xx, yy, xy = blurred.split(channels)
    product, squares = mean_x * mean_y, mean_x * mean_x + mean_y * mean_y
    return ((2 * product + C1) * (2 * (xy - product) + C2)) / ((squares + C1) * (xx + yy - squares + C2))


@cache
def blur_matrix(size: int, sigma: float, radius: int, device: torch.device, dtype: torch.dtype) -> Tensor:
    """Return the banded matrix that blurs a column of pixels by a normalised Gaussian, zero padding, [size, size]."""
    position = torch.arange(size, dtype=torch.float64)
    offset = position[:, None] - position
    kernel = torch.exp(-(torch.arange(-radius, radius + 1, dtype=torch.float64) ** 2) / (2 * sigma**2)).sum()
    band = torch.exp(-(offset**2) / (2 * sigma**2)) * (offset.abs() <= radius) / kernel
    return band.to(device, dtype)


def blurred(image: Tensor, sigma: float) -> Tensor:
    """Blur by a Gaussian with zero padding, [h, w]; not at all below a third of a pixel."""
    if sigma < 0.3:
        return image
    radius = math.ceil(3 * sigma)
    rows = blur_matrix(image.shape[0], sigma, radius, image.device, image.dtype)
    columns = blur_matrix(image.shape[1], sigma, radius, image.device, image.dtype)
    return rows @ image @ columns.T
