"""The gradient of one tile in double precision, for tiles with hundreds of Gaussians.

A camera's gradient is a sum over all Gaussians. Where thousands overlap, their shares cancel to a thousandth, but their
common error from a transmittance in single precision does not.
"""

import math

import numpy as np

from rewild4d.kernels.compiling import inlined, kernel
from rewild4d.rasterizer.binning import BLOCK, BLOCKS, TILE
from rewild4d.rasterizer.conventions import MAX_ALPHA, MIN_TRANSMITTANCE
from rewild4d.rasterizer.projection import (
    ALONG_X,
    ALONG_Y,
    CENTER_X,
    CENTER_Y,
    DOWN,
    LOG2_MIN_ALPHA,
    LOG_OPACITY,
    RECORD,
    REST_X,
    REST_Y,
)

CROWD = 256
"""Gaussians in a tile's list above which its gradient is in double precision, if cameras need gradients."""
NOWHERE = np.iinfo(np.int64).max
"""In place of `CROWD` if they need none."""
_PIXELS = BLOCK * BLOCK


@inlined
def _alpha_at(records: np.ndarray, record: int, x: float, y: float) -> tuple:
    """Return alpha of a Gaussian at a point, its log2 before the upper cut, and the point's coordinates t and u."""
    dx = x - records[record + CENTER_X] - records[record + REST_X]
    dy = y - records[record + CENTER_Y] - records[record + REST_Y]
    t, u = records[record + ALONG_X] * dx + records[record + ALONG_Y] * dy, records[record + DOWN] * dy
    exponent = records[record + LOG_OPACITY] - t * t - u * u
    alpha = min(math.exp(exponent * math.log(2.0)), MAX_ALPHA) if exponent >= LOG2_MIN_ALPHA else 0.0
    return alpha, exponent, t, u


@inlined
def _take(left: np.ndarray, pixel: int, alpha: float) -> float:
    """Return the weight of the next Gaussian at a pixel; ``left``, the transmittance, is negative in a closed pixel."""
    before = left[pixel]
    if before <= 0 or alpha == 0:
        return 0.0
    if before * (1 - alpha) <= MIN_TRANSMITTANCE:
        left[pixel] = -before
        return 0.0
    left[pixel] = before * (1 - alpha)
    return alpha * before


@inlined
def _along(gradients: np.ndarray, pixel: int, features: np.ndarray, feature: int, channels: int) -> float:
    total = 0.0
    for channel in range(channels):
        total += gradients[channel, pixel] * features[feature + channel]
    return total


@inlined
def _place(pixel: int, tile_left: int, tile_top: int) -> tuple:
    """Return the column and row in the image of a tile's pixel, counted block by block."""
    block, lane = pixel // _PIXELS, pixel % _PIXELS
    x = tile_left + block % (TILE // BLOCK) * BLOCK + lane % BLOCK
    return x, tile_top + block // (TILE // BLOCK) * BLOCK + lane // BLOCK


@kernel
def _open(
    view: int, tile_left: int, tile_top: int, g_image: np.ndarray, left: np.ndarray, gradients: np.ndarray
) -> None:
    """Set the transmittance to 1 inside the image and 0 outside; read the gradients of the tile's pixels."""
    _, channels, height, width = g_image.shape
    for pixel in range(len(left)):
        x, y = _place(pixel, tile_left, tile_top)
        left[pixel] = 1 if x < width and y < height else 0
        for channel in range(channels):
            gradients[channel, pixel] = g_image[view, channel, y, x] if left[pixel] > 0 else 0


@kernel
def crowd_backward(
    view: int, tile_left: int, tile_top: int, slots: np.ndarray, gaussians: np.ndarray, listed_bits: np.ndarray,
    records: np.ndarray, features: np.ndarray, background: np.ndarray, g_image: np.ndarray, g_alpha: np.ndarray,
    first_channel: int, row_length: int, sums: np.ndarray,
) -> None:  # fmt: skip
    """Fill the rows of ``sums`` of one tile, as `blend_backward` of blending_backward.py does.

    Args:
        slots, gaussians: of the tile's list, front to back.
        listed_bits: the blocks of the tile where each Gaussian contributes or closes a pixel.
        first_channel: index in a row of the first channel sum.
        row_length: numbers in a row of ``sums``, which is flat like ``records`` and ``features``.
        background: [V, C]; g_image is [V, C, h, w], g_alpha [V, 1, h, w].
    """
    views, channels = g_image.shape[:2]
    count = len(records) // (RECORD * views)
    left, gradients = np.empty(BLOCKS * _PIXELS), np.empty((channels, BLOCKS * _PIXELS))
    behind, row = np.zeros(BLOCKS * _PIXELS), np.empty(row_length)
    for again in range(2):  # first the pixels' totals
        _open(view, tile_left, tile_top, g_image, left, gradients)
        for entry in range(len(slots)):
            bits, n = np.int64(listed_bits[entry]), gaussians[entry]
            record = (view * count + n) * RECORD
            row[:] = 0
            for block in range(BLOCKS):
                if not bits >> block & 1:
                    continue
                for pixel in range(block * _PIXELS, (block + 1) * _PIXELS):
                    x, y = _place(pixel, tile_left, tile_top)
                    alpha, exponent, t, u = _alpha_at(records, record, x + 0.5, y + 0.5)
                    weight = _take(left, pixel, alpha)
                    if weight == 0:
                        continue
                    along = weight * _along(gradients, pixel, features, n * channels, channels)
                    if again == 0:
                        behind[pixel] += along
                        continue
                    behind[pixel] -= along
                    for channel in range(channels):
                        row[first_channel + channel] += weight * gradients[channel, pixel]
                    if exponent <= math.log2(MAX_ALPHA):  # no gradient above the cap
                        pull = along - behind[pixel] * alpha / (1 - alpha)
                        row[0] += pull
                        row[1] += pull * t
                        row[2] += pull * u
                        row[3] += pull * t * t
                        row[4] += pull * t * u
                        row[5] += pull * u * u
            if again == 1:
                sums[slots[entry] * row_length : (slots[entry] + 1) * row_length] = row
        if again == 0:
            _add_background(view, tile_left, tile_top, background, gradients, g_alpha, left, behind)


@kernel
def _add_background(
    view: int, tile_left: int, tile_top: int, background: np.ndarray, gradients: np.ndarray, g_alpha: np.ndarray,
    left: np.ndarray, behind: np.ndarray,
) -> None:  # fmt: skip
    """Add the share of the background and alpha to the pixels' totals."""
    height, width = g_alpha.shape[2:]
    for pixel in range(len(left)):
        x, y = _place(pixel, tile_left, tile_top)
        if x < width and y < height:
            gradient = -np.float64(g_alpha[view, 0, y, x])
            for channel in range(len(gradients)):
                gradient += gradients[channel, pixel] * background[view, channel]
            behind[pixel] += abs(left[pixel]) * gradient
