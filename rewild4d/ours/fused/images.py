"""Image losses and their gradients, strip by strip: L1 and SSIM of two composed images, BCE and Dice of two mattes."""

import math
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from rewild4d.kernels.arrays import array
from rewild4d.kernels.compiling import kernel
from rewild4d.kernels.simd import LANES, divide, fma, keep_where_ge, load, maximum, splat, store, take_ticket
from rewild4d.kernels.switch import Kernel
from rewild4d.kernels.threads import run_tickets

COLOUR_LOSSES = Kernel(
    "colour losses",
    "fc12a830ed81",
    "rewild4d.ours.losses.images:colour_losses",
    "rewild4d.ours.losses.images:ssim_map",
    "rewild4d.ours.losses.images:blur_matrix",
)
SILHOUETTE = Kernel("silhouette loss", "ce00e8a2cb44", "rewild4d.ours.losses.images:silhouette_loss")

STRIP = 24
"""Rows of a unit of work; sums run over strips, so they do not depend on the number of threads."""
HALF = 5
"""Radius of SSIM's window in pixels."""
TAPS = np.exp(-(np.arange(HALF + 1) ** 2) / (2 * 1.5**2))
TAPS = (TAPS / (TAPS[0] + 2 * TAPS[1:].sum())).astype(np.float32)
C1, C2 = np.float32(0.01**2), np.float32(0.03**2)
LANE_NUMBERS = np.arange(LANES, dtype=np.float32)
LOWEST = np.float32(1e-5)
"""Distance that a matte keeps from 0 and 1 before the logarithm."""


@kernel
def _stride(width: int) -> int:
    """Return the length of a scratch row: the pixels between two vectors of zeros."""
    return (width + LANES - 1) // LANES * LANES + 2 * LANES


@kernel
def _compose(
    image: np.ndarray, matte: np.ndarray, channel: int, behind: float, window: tuple, first: int, last: int,
    rows: np.ndarray,
) -> None:  # fmt: skip
    """Compose rows first..last of the window over a background into scratch, zero beyond the window."""
    top, left, height, width = window
    stride = _stride(width)
    rows[: (last - first) * stride] = 0
    for row in range(max(first, 0), min(last, height)):
        index = (row - first) * stride + LANES
        for column in range(width):
            y, x = top + row, left + column
            rows[index + column] = image[channel, y, x] + (np.float32(1) - matte[0, y, x]) * behind


@kernel
def _blur(given: np.ndarray, index: int, step: int, taps: np.ndarray) -> Any:
    """Blur sixteen pixels along a row (step 1) or a column (step: the row's length)."""
    total = load(given, index) * splat(taps[0])
    for k in range(1, HALF + 1):
        total = fma(load(given, index - k * step) + load(given, index + k * step), splat(taps[k]), total)
    return total


@kernel
def _blur_product(a: np.ndarray, b: np.ndarray, index: int, taps: np.ndarray) -> Any:
    """Blur a product of two images horizontally, sixteen pixels."""
    total = load(a, index) * load(b, index) * splat(taps[0])
    for k in range(1, HALF + 1):
        before, after = load(a, index - k) * load(b, index - k), load(a, index + k) * load(b, index + k)
        total = fma(before + after, splat(taps[k]), total)
    return total


@kernel
def _inside(value: Any, column: Any, inner: tuple) -> Any:
    """Keep the value between the inner columns, zero elsewhere."""
    value = keep_where_ge(value, column, splat(np.float32(inner[2])))
    return keep_where_ge(value, splat(np.float32(inner[3] - 1)), column)


@kernel
def _similarity(mx: Any, my: Any, xx: Any, yy: Any, xy: Any) -> tuple:
    """Return SSIM and its gradients by the blurred x, x x and x y."""
    one, two = splat(np.float32(1)), splat(np.float32(2))
    product, squares = mx * my, fma(mx, mx, my * my)
    a, b = fma(two, product, splat(C1)), fma(two, xy - product, splat(C2))
    c, d = squares + splat(C1), xx + yy - squares + splat(C2)
    over_c, over_d = divide(one, c), divide(one, d)
    both = over_c * over_d
    value = a * b * both
    by_mean = two * my * (b - a) * both - two * mx * value * (over_c - over_d)
    return value, by_mean, splat(np.float32(0)) - value * over_d, two * a * both


@kernel
def _colour_forward(
    tickets: np.ndarray, given: tuple, window: tuple, inner: tuple, taps: np.ndarray, lanes: np.ndarray,
    grads: np.ndarray, sums: np.ndarray,
) -> None:  # fmt: skip
    """Fill grads [9, height + 10, stride] of SSIM and sums [strips, 2]: of |x - y| and of 1 - SSIM."""
    (image, matte, truth, mask, behind), (_, _, height, width) = given, window
    stride = _stride(width)
    xs, ys = np.empty((STRIP + 2 * HALF) * stride, np.float32), np.empty((STRIP + 2 * HALF) * stride, np.float32)
    blurred = np.zeros((5, (STRIP + 2 * HALF) * stride), np.float32)
    totals = np.empty(2 * LANES, np.float32)
    while True:
        strip = take_ticket(tickets)
        first = strip * STRIP
        if first >= height:
            return
        last = min(first + STRIP, height)
        apart, unlike = splat(np.float32(0)), splat(np.float32(0))
        for channel in range(3):
            _compose(image, matte, channel, behind[channel], window, first - HALF, last + HALF, xs)
            _compose(truth, mask, channel, behind[channel], window, first - HALF, last + HALF, ys)
            for index in range(LANES, (last - first + 2 * HALF) * stride - LANES, LANES):
                store(blurred[0], index, _blur(xs, index, 1, taps))
                store(blurred[1], index, _blur(ys, index, 1, taps))
                store(blurred[2], index, _blur_product(xs, xs, index, taps))
                store(blurred[3], index, _blur_product(ys, ys, index, taps))
                store(blurred[4], index, _blur_product(xs, ys, index, taps))
            for row in range(first, last):
                for column in range(LANES, stride - LANES, LANES):
                    index = (row - first + HALF) * stride + column
                    difference = load(xs, index) - load(ys, index)
                    apart = apart + maximum(difference, splat(np.float32(0)) - difference)
                    value, by_mean, by_square, by_product = _similarity(
                        _blur(blurred[0], index, stride, taps), _blur(blurred[1], index, stride, taps),
                        _blur(blurred[2], index, stride, taps), _blur(blurred[3], index, stride, taps),
                        _blur(blurred[4], index, stride, taps),
                    )  # fmt: skip
                    here = load(lanes, 0) + splat(np.float32(column - LANES))
                    target = (row + HALF) * stride + column
                    if inner[0] <= row < inner[1]:
                        unlike = unlike + _inside(splat(np.float32(1)) - value, here, inner)
                        store(grads[3 * channel], target, _inside(by_mean, here, inner))
                        store(grads[3 * channel + 1], target, _inside(by_square, here, inner))
                        store(grads[3 * channel + 2], target, _inside(by_product, here, inner))
        store(totals, 0, apart)
        store(totals, LANES, unlike)
        sums[strip, 0], sums[strip, 1] = totals[:LANES].sum(), totals[LANES:].sum()


@kernel
def _colour_backward(
    tickets: np.ndarray, given: tuple, window: tuple, taps: np.ndarray, grads: np.ndarray, g_apart: float,
    g_unlike: float, on_image: np.ndarray, on_matte: np.ndarray,
) -> None:  # fmt: skip
    """Set the gradients inside the window, given those of the two sums."""
    (image, matte, truth, mask, behind), (top, left, height, width) = given, window
    stride = _stride(width)
    xs, ys = np.empty(STRIP * stride, np.float32), np.empty(STRIP * stride, np.float32)
    blurred = np.zeros((3, (STRIP + 2 * HALF) * stride), np.float32)
    grad = np.empty(stride, np.float32)
    while True:
        strip = take_ticket(tickets)
        first = strip * STRIP
        if first >= height:
            return
        last = min(first + STRIP, height)
        for channel in range(3):
            _compose(image, matte, channel, behind[channel], window, first, last, xs)
            _compose(truth, mask, channel, behind[channel], window, first, last, ys)
            for k in range(3):
                # Slopes start five rows above the window: row r of the strip's scratch is row first + r of theirs.
                for index in range(LANES, (last - first + 2 * HALF) * stride - LANES, LANES):
                    store(blurred[k], index, _blur(grads[3 * channel + k], first * stride + index, 1, taps))
            for row in range(first, last):
                for column in range(LANES, stride - LANES, LANES):
                    index, own = (row - first + HALF) * stride + column, (row - first) * stride + column
                    total = _blur(blurred[0], index, stride, taps)
                    twice = load(xs, own) + load(xs, own)
                    total = fma(twice, _blur(blurred[1], index, stride, taps), total)
                    total = fma(load(ys, own), _blur(blurred[2], index, stride, taps), total)
                    store(grad, column, total * splat(np.float32(-g_unlike)))
                for column in range(width):
                    own = (row - first) * stride + LANES + column
                    value = grad[LANES + column]
                    if xs[own] > ys[own]:
                        value += np.float32(g_apart)
                    elif xs[own] < ys[own]:
                        value -= np.float32(g_apart)
                    on_image[channel, top + row, left + column] = value
                    on_matte[0, top + row, left + column] -= value * behind[channel]


def colour_means(
    image: Tensor, matte: Tensor, truth: Tensor, mask: Tensor, background: Tensor, window: tuple[int, int, int, int],
    inner: tuple[int, int, int, int], area: float,
) -> tuple[Tensor, Tensor]:  # fmt: skip
    """Compute `colour_losses`, divided by ``area``; float32 on the CPU, gradients for image and matte.

    ``window`` is top, left, height, width; ``inner`` are first and end row, first and end column, from the window's
    corner, of the pixels whose SSIM counts.
    """
    return _Colour.apply(image, matte, truth, mask, background, window, inner, area)


class _Colour(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any, image: Tensor, matte: Tensor, truth: Tensor, mask: Tensor, background: Tensor, window: Any,
        inner: Any, area: float,
    ) -> tuple[Tensor, Tensor]:  # fmt: skip
        given = tuple(array(tensor) for tensor in (image, matte, truth, mask, background))
        _, _, height, width = window
        grads = np.zeros((9, (height + 2 * HALF) * _stride(width)), np.float32)
        sums = np.zeros((-(-height // STRIP), 2))
        run_tickets(_colour_forward, given, window, inner, TAPS, LANE_NUMBERS, grads, sums)
        ctx.given, ctx.window, ctx.grads, ctx.area = given, window, grads, area
        apart, unlike = (sums.sum(axis=0) / area).tolist()
        return torch.tensor(apart, dtype=torch.float32), torch.tensor(unlike, dtype=torch.float32)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, by_apart: Tensor, by_unlike: Tensor) -> tuple[Tensor | None, ...]:
        image, matte = (torch.zeros(ctx.given[i].shape) for i in (0, 1))
        g_apart, g_unlike = by_apart.item() / ctx.area, by_unlike.item() / ctx.area
        given = (ctx.given, ctx.window, TAPS, ctx.grads)
        run_tickets(_colour_backward, *given, g_apart, g_unlike, image.numpy(), matte.numpy())
        return image, matte, None, None, None, None, None, None


@kernel
def _matte_forward(tickets: np.ndarray, alpha: np.ndarray, mask: np.ndarray, window: tuple, sums: np.ndarray) -> None:
    """Set sums [strips, 4] of the cross entropy, of alpha x mask, of alpha and of mask."""
    top, left, height, width = window
    # Where both are empty, which is nearly everywhere, the clamp makes the entropy a constant.
    nothing = -math.log(1.0 - LOWEST)
    while True:
        strip = take_ticket(tickets)
        if strip * STRIP >= height:
            return
        entropy, common, mine, theirs = 0.0, 0.0, 0.0, 0.0
        for row in range(strip * STRIP, min((strip + 1) * STRIP, height)):
            for column in range(width):
                a, t = alpha[0, top + row, left + column], mask[0, top + row, left + column]
                if a <= LOWEST and t == 0:
                    entropy += nothing
                else:
                    inside = min(max(a, LOWEST), np.float32(1) - LOWEST)
                    if t > 0:
                        entropy -= t * math.log(inside)
                    if t < 1:
                        entropy -= (1 - t) * math.log(np.float32(1) - inside)
                common += a * t
                mine += a
                theirs += t
        sums[strip, 0], sums[strip, 1], sums[strip, 2], sums[strip, 3] = entropy, common, mine, theirs


@kernel
def _matte_backward(
    tickets: np.ndarray, alpha: np.ndarray, mask: np.ndarray, window: tuple, g_entropy: float, by_mask: float,
    by_all: float, on_alpha: np.ndarray,
) -> None:  # fmt: skip
    """Set the gradient inside the window: of the cross entropy, plus ``by_mask`` times the mask plus ``by_all``."""
    top, left, height, width = window
    while True:
        strip = take_ticket(tickets)
        if strip * STRIP >= height:
            return
        for row in range(strip * STRIP, min((strip + 1) * STRIP, height)):
            for column in range(width):
                a, t = alpha[0, top + row, left + column], mask[0, top + row, left + column]
                grad = by_mask * t + by_all
                if LOWEST <= a <= np.float32(1) - LOWEST:
                    grad += g_entropy * ((1 - t) / (1 - a) - t / a)
                on_alpha[0, top + row, left + column] = grad


def matte_loss(alpha: Tensor, mask: Tensor, window: tuple[int, int, int, int], area: float) -> Tensor:
    """Compute `silhouette_loss` in a window (top, left, height, width); float32 on the CPU, gradient for alpha only."""
    return _Matte.apply(alpha, mask, window, area)


class _Matte(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, alpha: Tensor, mask: Tensor, window: Any, area: float) -> Tensor:
        given, sums = (array(alpha), array(mask)), np.zeros((-(-window[2] // STRIP), 4))
        run_tickets(_matte_forward, *given, window, sums)
        entropy, common, mine, theirs = sums.sum(axis=0).tolist()
        ctx.given, ctx.window, ctx.area, ctx.sums = given, window, area, (common, mine, theirs)
        return torch.tensor(entropy / area + 1 - (2 * common + 1) / (mine + theirs + 1))

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor | None, ...]:
        common, mine, theirs = ctx.sums
        whole, on_alpha = mine + theirs + 1, torch.zeros(ctx.given[0].shape)
        g = grad.item()
        parts = g / ctx.area, -2 * g / whole, g * (2 * common + 1) / whole**2
        run_tickets(_matte_backward, *ctx.given, ctx.window, *parts, on_alpha.numpy())
        return on_alpha, None, None, None
