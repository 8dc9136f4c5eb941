"""Compute PSNR and SSIM, one value per image, and the regions that they cover.

All images are float tensors in [0, 1], [B, C, H, W]; predictions and truths share size and background.

A small animal's full-frame score mostly measures how much of the image it covers, so there are four regions:
  full    every pixel
  fg      the true mask
  union   the true or the predicted mask: an animal that is too large is penalised too
  crop    the box of the true mask with a margin (`mask_box`, `crop_to_box`), for any metric
"""

import math
from typing import NamedTuple

import torch
from torch import Tensor

WINDOW = 11
"""Side of the SSIM window in pixels."""
PSNR_CAP = 100.0
"""PSNR of identical images in dB, instead of infinity, so that a mean exists."""
BOX_MARGIN = 0.1
"""Border on each side of a truth box, as a share of its longer side."""
LEAST_BOX = 32
"""Least side of a truth box in pixels (where the image has as many): LPIPS's last layer needs it."""


class Box(NamedTuple):
    """A rectangle of whole pixels, half open: rows top..bottom, columns left..right."""

    top: int
    bottom: int
    left: int
    right: int


def mask_box(mask: Tensor, margin: float = BOX_MARGIN, least: int = LEAST_BOX) -> Box | None:
    """Compute the rectangle around a mask with a margin, cut at the image's border.

    Args:
        mask: boolean, [1, H, W].
        margin: border on each side as a share of the rectangle's longer side, rounded up to whole pixels.
        least: a shorter side grows to this many pixels around its middle; near the border it is moved inwards.

    Returns:
        The box, or None where the mask is empty.

    Examples:
        >>> mask = torch.zeros(1, 64, 64, dtype=torch.bool)
        >>> mask[0, 20:30, 10:50] = True
        >>> mask_box(mask, least=1)
        Box(top=16, bottom=34, left=6, right=54)
    """
    if mask.ndim != 3 or mask.shape[0] != 1:
        raise ValueError(f"expected a mask of shape [1, H, W], got {tuple(mask.shape)}")
    rows, columns = torch.nonzero(mask[0].any(1)), torch.nonzero(mask[0].any(0))
    if not len(rows):
        return None
    spans = [(int(inside[0]), int(inside[-1]) + 1) for inside in (rows, columns)]
    border = math.ceil(margin * max(end - start for start, end in spans))
    (top, bottom), (left, right) = (
        _widened(start - border, end + border, least, size)
        for (start, end), size in zip(spans, mask.shape[1:], strict=True)
    )
    return Box(top, bottom, left, right)


def crop_to_box(images: Tensor, box: Box) -> Tensor:
    """Cut the same box out of images or masks, [..., H, W] -> [..., bottom - top, right - left].

    Examples:
        >>> crop_to_box(torch.arange(9).reshape(3, 3), Box(top=0, bottom=2, left=1, right=3)).tolist()
        [[1, 2], [4, 5]]
    """
    height, width = images.shape[-2:]
    if not (0 <= box.top < box.bottom <= height and 0 <= box.left < box.right <= width):
        raise ValueError(f"expected a box inside {width}x{height} pixels, got {box}")
    return images[..., box.top : box.bottom, box.left : box.right]


def fill_outside(images: Tensor, mask: Tensor, background: float) -> Tensor:
    """Fill everything outside a mask with one grey level, for metrics without a value per pixel (LPIPS).

    With prediction and truth filled alike, only what lies inside can differ. Filters at the mask's edge still see the
    grey level, and a mean over the frame still depends on the coverage: compare methods on the same truths, not animals
    of different size.

    Args:
        images: [B, C, H, W].
        mask: boolean, [B, 1, H, W].
        background: grey level in [0, 1].

    Examples:
        >>> fill_outside(torch.zeros(1, 1, 1, 2), torch.tensor([[[[True, False]]]]), background=0.5).tolist()
        [[[[0.0, 0.5]]]]
    """
    return images.where(_require_mask(mask, images), torch.as_tensor(background, dtype=images.dtype))


def psnr(prediction: Tensor, target: Tensor, mask: Tensor | None = None) -> Tensor:
    """Compute peak signal-to-noise ratio, 10 log10(1 / MSE), peak 1, at most `PSNR_CAP`.

    Args:
        prediction: in [0, 1], [B, C, H, W].
        target: in [0, 1], [B, C, H, W].
        mask: pixels of the mean, boolean, [B, 1, H, W]; all where None.

    Returns:
        Decibels per image, float64, [B]; NaN for an image without a pixel in the mask.

    Examples:
        >>> psnr(torch.full((1, 3, 4, 4), 0.6), torch.full((1, 3, 4, 4), 0.5)).round(decimals=4).tolist()
        [20.0]
    """
    _check_pair(prediction, target)
    squares = (prediction.double() - target.double()).square()
    if mask is None:
        error = squares.flatten(1).mean(1)
    else:
        counted = _require_mask(mask, target).to(squares)
        error = (squares * counted).flatten(1).sum(1) / (counted.flatten(1).sum(1) * target.shape[1])
    return (-10.0 * error.clamp_min(10 ** (-PSNR_CAP / 10)).log10()).where(~error.isnan(), error)


def ssim(prediction: Tensor, target: Tensor, mask: Tensor | None = None) -> Tensor:
    """Compute structural similarity (Wang et al. 2004) over the valid region.

    11x11 Gaussian window, sigma 1.5, population covariance. Equals scikit-image with gaussian_weights=True, sigma=1.5,
    use_sample_covariance=False, data_range=1.

    Args:
        prediction: in [0, 1], [B, C, H, W], at least 11 pixels each way.
        target: in [0, 1], [B, C, H, W].
        mask: boolean, [B, 1, H, W]: the mean is over the windows whose centre is inside. A window extends 5 pixels over
            the mask's edge; mask pixels within 5 pixels of the image's border have no window and do not count.

    Returns:
        Mean over the windows and the channels per image, float64, [B]; NaN for an image without a window in the mask.

    Examples:
        >>> black, white = torch.zeros(1, 1, 16, 16), torch.ones(1, 1, 16, 16)
        >>> ssim(white, white).tolist(), ssim(black, white).round(decimals=4).tolist()
        ([1.0], [0.0001])
    """
    _check_pair(prediction, target)
    if min(target.shape[2:]) < WINDOW:
        raise ValueError(f"expected images of at least 11x11 pixels for SSIM, got {target.shape[3]}x{target.shape[2]}")
    half = WINDOW // 2
    everywhere = torch.ones_like(target[:, :1], dtype=torch.bool)
    counted = (everywhere if mask is None else _require_mask(mask, target))[:, 0, half:-half, half:-half]
    return torch.stack([_ssim_of_one(x, y, where) for x, y, where in zip(prediction, target, counted, strict=True)])


def _ssim_of_one(prediction: Tensor, target: Tensor, counted: Tensor) -> Tensor:
    """Compute the SSIM of one image [C, H, W], the mean over the counted windows [H-10, W-10].

    A window that sees no difference has exactly one, so only the others are computed.
    """
    height, width = target.shape[1:]
    windows = target.shape[0] * counted.sum(dtype=torch.float64)
    differs = (prediction != target).any(0)
    if not differs.any():
        return windows / windows
    top, bottom = _span(differs.any(1), height)
    left, right = _span(differs.any(0), width)
    x, y = (image[:, top:bottom, left:right].double() for image in (prediction, target))
    mean_x, mean_y, xx, yy, xy = _blur(torch.stack((x, y, x * x, y * y, x * y)))
    c1, c2 = 0.01**2, 0.03**2
    luminance = (2 * mean_x * mean_y + c1) / (mean_x**2 + mean_y**2 + c1)
    structure = (2 * (xy - mean_x * mean_y) + c2) / (xx - mean_x**2 + yy - mean_y**2 + c2)
    where = counted[top : bottom - WINDOW + 1, left : right - WINDOW + 1]
    return 1 - ((1 - luminance * structure) * where).sum() / windows


def _span(differs: Tensor, size: int) -> tuple[int, int]:
    """Return rows (or columns) that the windows over a difference read, as a slice of at least one window."""
    rows = torch.nonzero(differs)
    first = min(max(0, int(rows[0]) - WINDOW + 1), size - WINDOW)
    return first, max(min(size, int(rows[-1]) + WINDOW), first + WINDOW)


def _blur(images: Tensor) -> Tensor:
    """Blur over the valid region as two banded products, [..., H, W] -> [..., H-10, W-10]."""
    rows, columns = (_band(size, images) for size in images.shape[-2:])
    return rows @ images @ columns.T


def _band(size: int, like: Tensor) -> Tensor:
    """Return the window shifted by one in each row, [size-10, size]."""
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


def _require_mask(mask: Tensor, images: Tensor) -> Tensor:
    expected = (images.shape[0], 1, *images.shape[2:])
    if mask.shape != expected:
        raise ValueError(f"expected a mask of shape {expected}, got {tuple(mask.shape)}")
    return mask


def _widened(start: int, end: int, least: int, size: int) -> tuple[int, int]:
    """Cut a span to [0, size) and grow it to at least ``least`` pixels where there are as many."""
    start, end = max(0, start), min(size, end)
    lack = max(0, min(least, size) - (end - start))
    start = min(max(0, start - lack // 2), size - (end - start + lack))
    return start, max(end, start + min(least, size))
