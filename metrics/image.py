"""Image similarity: PSNR and SSIM, each as a pure function that gives one value per image, and where they look.

All images are float tensors in [0, 1], [B, C, H, W]; predictions and truths share size and background.

Four regions, because a small animal's full-frame score is mostly a figure of its coverage:
  full    every pixel
  fg      the true mask: what the animal looks like where it is
  union   the true or the predicted mask: an animal that is too large is punished too
  crop    the box of the true mask with a margin (`mask_box`, `crop_to_box`), for any metric
"""

import math
from typing import NamedTuple

import torch
from torch import Tensor

WINDOW = 11
"""Side of the SSIM window in pixels."""
PSNR_CAP = 100.0
"""Identical images have an infinite PSNR; it is reported as this many dB so that a mean exists."""
BOX_MARGIN = 0.1
"""Free border on each side of a truth box, as a share of its longer side."""
LEAST_BOX = 32
"""A truth box has at least this side in pixels (where the image has): less leaves LPIPS's last layer nothing to see."""


class Box(NamedTuple):
    """A rectangle of whole pixels, half open: rows top..bottom, columns left..right."""

    top: int
    bottom: int
    left: int
    right: int


def mask_box(mask: Tensor, margin: float = BOX_MARGIN, least: int = LEAST_BOX) -> Box | None:
    """The rectangle around a mask with a margin, cut at the image's border.

    Args:
        mask: boolean, [1, H, W].
        margin: border on each side as a share of the rectangle's longer side, rounded up to whole pixels.
        least: a shorter side grows to this many pixels around its middle; near the border it is moved inwards.

    Returns:
        The box, or None where the mask is empty.
    """
    if mask.ndim != 3 or mask.shape[0] != 1:
        raise ValueError(f"expected a mask of shape [1, H, W], got {tuple(mask.shape)}")
    rows, columns = torch.nonzero(mask[0].any(1)), torch.nonzero(mask[0].any(0))
    if not len(rows):
        return None
    spans = [(int(places[0]), int(places[-1]) + 1) for places in (rows, columns)]
    border = math.ceil(margin * max(end - start for start, end in spans))
    (top, bottom), (left, right) = (
        _widened(start - border, end + border, least, size)
        for (start, end), size in zip(spans, mask.shape[1:], strict=True)
    )
    return Box(top, bottom, left, right)


def crop_to_box(images: Tensor, box: Box) -> Tensor:
    """Cut the same box out of images or masks, [..., H, W] -> [..., bottom - top, right - left]."""
    height, width = images.shape[-2:]
    if not (0 <= box.top < box.bottom <= height and 0 <= box.left < box.right <= width):
        raise ValueError(f"expected a box inside {width}x{height} pixels, got {box}")
    return images[..., box.top : box.bottom, box.left : box.right]


def fill_outside(images: Tensor, mask: Tensor, background: float) -> Tensor:
    """One colour wherever the mask is not: how a metric without a per-pixel value (LPIPS) is held to a region.

    Prediction and truth are filled with the same mask and colour, so only what lies inside can differ. Filters that
    reach over the mask's edge still see the colour, and a map averaged over the frame still knows the coverage: the
    number compares methods on the same truths, not animals of different size.

    Args:
        images: [B, C, H, W].
        mask: boolean, [B, 1, H, W].
        background: grey level in [0, 1].
    """
    return images.where(_require_mask(mask, images), torch.as_tensor(background, dtype=images.dtype))


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
        counted = _require_mask(mask, target).to(squares)
        error = (squares * counted).flatten(1).sum(1) / (counted.flatten(1).sum(1) * target.shape[1])
    return (-10.0 * error.clamp_min(10 ** (-PSNR_CAP / 10)).log10()).where(~error.isnan(), error)


def ssim(prediction: Tensor, target: Tensor, mask: Tensor | None = None) -> Tensor:
    """Structural similarity (Wang et al. 2004): 11x11 Gaussian window, sigma 1.5, population covariance, valid region.

    Equals scikit-image with gaussian_weights=True, sigma=1.5, use_sample_covariance=False, data_range=1.

    Args:
        prediction: in [0, 1], [B, C, H, W], at least 11 pixels each way.
        target: in [0, 1], [B, C, H, W].
        mask: boolean, [B, 1, H, W]: the mean is over the map where the window's centre is inside the mask. The
            window itself reaches 5 pixels over the edge and sees the background there; mask pixels within 5 pixels of
            the image's border have no window and are not counted.

    Returns:
        Mean over the map and the channels per image, float64, [B]; NaN for an image with no counted window.
    """
    _check_pair(prediction, target)
    if min(target.shape[2:]) < WINDOW:
        raise ValueError(f"expected images of at least 11x11 pixels for SSIM, got {target.shape[3]}x{target.shape[2]}")
    half = WINDOW // 2
    everywhere = torch.ones_like(target[:, :1], dtype=torch.bool)
    counted = (everywhere if mask is None else _require_mask(mask, target))[:, 0, half:-half, half:-half]
    return torch.stack([_ssim_of_one(x, y, where) for x, y, where in zip(prediction, target, counted, strict=True)])


def _ssim_of_one(prediction: Tensor, target: Tensor, counted: Tensor) -> Tensor:
    """SSIM of one image [C, H, W], the mean over the counted windows [H-10, W-10].

    The map is exactly one wherever its window sees no difference, so only the rest is computed.
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


def _require_mask(mask: Tensor, images: Tensor) -> Tensor:
    expected = (images.shape[0], 1, *images.shape[2:])
    if mask.shape != expected:
        raise ValueError(f"expected a mask of shape {expected}, got {tuple(mask.shape)}")
    return mask


def _widened(start: int, end: int, least: int, size: int) -> tuple[int, int]:
    """The part of a span inside [0, size), grown to at least ``least`` pixels where there are as many."""
    start, end = max(0, start), min(size, end)
    lack = max(0, min(least, size) - (end - start))
    start = min(max(0, start - lack // 2), size - (end - start + lack))
    return start, max(end, start + min(least, size))
