"""Silhouettes of round Gaussians: each adds its density to the pixels that it reaches, sixteen of a row together."""

from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from rewild4d.kernels.arrays import array
from rewild4d.kernels.compiling import inlined, kernel
from rewild4d.kernels.powers import LOG2_E, exp2
from rewild4d.kernels.simd import LANES, fma, load, maximum, splat, store, take_ticket
from rewild4d.kernels.switch import Kernel
from rewild4d.kernels.tails import lanes_sum
from rewild4d.kernels.threads import run_tickets

SPLATS = Kernel("silhouettes of the template", "6736075dd066", "rewild4d.priors.silhouettes:splat")

REACH = 5.5
"""Standard deviations beyond which a Gaussian adds nothing: the density there is 3e-7 of that at its centre."""
LEAST_POWER = np.float32(-126)


class Splats(NamedTuple):
    """Gaussians in images, as the kernels read them."""

    centers: Any  # x and y in pixels, [images, n, 2]
    variances: Any  # along x and y, square pixels, [images, n, 2]
    strengths: Any  # density at the centre, [images, n]


@inlined
def _profile(center: np.float32, variance: np.float32, middles: np.ndarray, values: np.ndarray) -> tuple:
    """Set values of a Gaussian along an axis; return the first pixel that it reaches and the one past the last."""
    reach, size = REACH * np.sqrt(variance), float(len(middles))
    begin, end = int(min(max(center - reach, 0.0), size)), int(min(max(np.ceil(center + reach), 0.0), size))
    factor, lowest = splat(np.float32(-0.5 * LOG2_E) / variance), splat(LEAST_POWER)
    for first in range(begin // LANES * LANES, end, LANES):
        away = load(middles, first) + splat(-center)
        store(values, first, exp2(maximum(factor * away * away, lowest)))
    return begin, end


@kernel
def _draw(tickets: np.ndarray, splats: Splats, middles: np.ndarray, drawn: np.ndarray) -> None:
    """Set images to the sum of all densities, [images, rows * pixels of a row], with rows of len(middles) pixels."""
    row = len(middles)
    across, down = np.empty(row, np.float32), np.empty(row, np.float32)
    while True:
        image = take_ticket(tickets)
        if image >= len(drawn):
            return
        own, centers = drawn[image], splats.centers[image]
        variances, strengths = splats.variances[image], splats.strengths[image]
        own[:] = 0
        for n in range(len(strengths)):
            if not np.isfinite(strengths[n] + variances[n, 0] + variances[n, 1] + centers[n, 0] + centers[n, 1]):
                own[:] = np.nan
                break
            left, right = _profile(centers[n, 0], variances[n, 0], middles, across)
            top, bottom = _profile(centers[n, 1], variances[n, 1], middles, down)
            for first in range(left // LANES * LANES, right, LANES):
                here = splat(strengths[n]) * load(across, first)
                for y in range(top, min(bottom, len(own) // row)):
                    store(own, y * row + first, fma(splat(down[y]), here, load(own, y * row + first)))


@kernel
def _pull(
    tickets: np.ndarray, splats: Splats, middles: np.ndarray, on_drawn: np.ndarray, on_centers: np.ndarray,
    on_variances: np.ndarray, on_strengths: np.ndarray,
) -> None:  # fmt: skip
    """Set gradients of the Gaussians from those of the images that `_draw` makes."""
    row = len(middles)
    across, down = np.empty(row, np.float32), np.empty(row, np.float32)
    while True:
        image = take_ticket(tickets)
        if image >= len(on_drawn):
            return
        own, centers = on_drawn[image], splats.centers[image]
        variances, strengths = splats.variances[image], splats.strengths[image]
        for n in range(len(strengths)):
            left, right = _profile(centers[n, 0], variances[n, 0], middles, across)
            top, bottom = _profile(centers[n, 1], variances[n, 1], middles, down)
            none = splat(np.float32(0))
            whole, on_x, on_xx, on_y, on_yy = none, none, none, none, none
            for first in range(left // LANES * LANES, right, LANES):
                plain, slope, bend = none, none, none
                for y in range(top, min(bottom, len(own) // row)):
                    away = middles[y] - centers[n, 1]
                    here = splat(down[y]) * load(own, y * row + first)
                    plain = plain + here
                    slope, bend = fma(splat(away), here, slope), fma(splat(away * away), here, bend)
                shape, aside = load(across, first), load(middles, first) + splat(-centers[n, 0])
                plain = plain * shape
                whole, on_x, on_xx = whole + plain, fma(aside, plain, on_x), fma(aside * aside, plain, on_xx)
                on_y, on_yy = fma(slope, shape, on_y), fma(bend, shape, on_yy)
            on_strengths[image, n] = lanes_sum(whole)
            slopes, bends = (lanes_sum(on_x), lanes_sum(on_y)), (lanes_sum(on_xx), lanes_sum(on_yy))
            for axis in range(2):
                factor = strengths[n] / variances[n, axis]
                on_centers[image, n, axis] = factor * slopes[axis]
                on_variances[image, n, axis] = np.float32(0.5) * factor / variances[n, axis] * bends[axis]


def densities(centers: Tensor, variances: Tensor, strengths: Tensor, size: int) -> Tensor:
    """Add up the densities of round Gaussians; float32 on the CPU.

    Args:
        centers: x and y in pixels, [..., n, 2].
        variances: along both axes, square pixels, above 0, [..., n, 2].
        strengths: density at the centre, [..., n].
        size: side of the square images in pixels.

    Returns:
        The sum at the middle of each pixel, [..., size, size]; NaN in images where a number is not finite.
    """
    return _Densities.apply(centers, variances, strengths, size)


class _Densities(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, centers: Tensor, variances: Tensor, strengths: Tensor, size: int) -> Tensor:
        many, count = strengths.shape[:-1], strengths.shape[-1]
        ctx.splats = Splats(
            array(centers).reshape(-1, count, 2), array(variances).reshape(-1, count, 2),
            array(strengths).reshape(-1, count),
        )  # fmt: skip
        ctx.middles = np.arange(-(-size // LANES) * LANES, dtype=np.float32) + np.float32(0.5)
        drawn = np.empty((len(ctx.splats.strengths), size * len(ctx.middles)), np.float32)
        run_tickets(_draw, ctx.splats, ctx.middles, drawn)
        return torch.from_numpy(drawn).view(*many, size, -1)[..., :size]

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor | None, ...]:
        many, size = grad.shape[:-2], grad.shape[-1]
        own = array(torch.nn.functional.pad(grad, (0, len(ctx.middles) - size))).reshape(len(ctx.splats.strengths), -1)
        made = [np.empty_like(each) for each in ctx.splats]
        run_tickets(_pull, ctx.splats, ctx.middles, own, *made)
        return *(torch.from_numpy(each).view(*many, *each.shape[1:]) for each in made), None
