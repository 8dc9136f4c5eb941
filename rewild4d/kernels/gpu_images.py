"""L1 and SSIM of a render and its target on a CUDA GPU (`triton_images`), with gradients."""

import math
from functools import cache
from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

SIGMA = 1.5
"""Standard deviation of SSIM's window, pixels."""


def colour_sums(
    rgb: Tensor, alpha: Tensor, target: Tensor, mask: Tensor, background: Tensor, c1: float, c2: float
) -> tuple[Tensor, Tensor]:
    """Return the sums over pixels and channels of |x - y| and of 1 - SSIM of render and target over one background,
    differentiable in ``rgb`` and ``alpha``; twin: `ours.losses.images.colour_losses`.

    Args:
        rgb: rendered colour, premultiplied, [3, h, w].
        alpha: rendered matte, [1, h, w].
        target: premultiplied, [3, h, w].
        mask: [1, h, w].
        background: RGB, [3].
        c1: SSIM's first constant.
        c2: its second.
    """
    return _Sums.apply(rgb, alpha, target, mask, background, c1, c2)


class _Sums(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any, rgb: Tensor, alpha: Tensor, target: Tensor, mask: Tensor, background: Tensor, c1: float, c2: float
    ) -> tuple[Tensor, Tensor]:
        from rewild4d.kernels import triton_images as kernels  # needs Triton

        images = [part.contiguous() for part in (rgb, alpha, target, mask, background)]
        height, width = rgb.shape[1:]
        blocks, window = -(-height * width // kernels.BLOCK.value), _window(kernels.TAPS.value, rgb.device)
        rows, slopes = rgb.new_empty(5, 3, height, width), rgb.new_empty(3, 3, height, width)
        sums = rgb.new_empty(2, 3 * blocks)
        kernels.blur_rows[(blocks, 3)](*images, window, rows, width, height)
        kernels.compare[(blocks, 3)](rows, *images, window, slopes, sums, width, height, c1, c2)
        ctx.save_for_backward(*images, slopes)
        l1, dissimilarity = sums.sum(dim=1)
        return l1, dissimilarity

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, g_l1: Tensor, g_ssim: Tensor) -> tuple[Tensor | None, ...]:
        from rewild4d.kernels import triton_images as kernels

        *images, slopes = ctx.saved_tensors
        rgb, alpha = images[:2]
        height, width = rgb.shape[1:]
        blocks, window = -(-height * width // kernels.BLOCK.value), _window(kernels.TAPS.value, rgb.device)
        rows, v_rgb, v_alpha = torch.empty_like(slopes), torch.empty_like(rgb), torch.empty_like(alpha)
        kernels.blur_slopes[(blocks, 9)](slopes, window, rows, width, height)
        gradients = g_l1.contiguous(), g_ssim.contiguous(), v_rgb, v_alpha
        kernels.compare_backward[(blocks,)](rows, *images, window, *gradients, width, height)
        return v_rgb, v_alpha, *[None] * 5


@cache
def _window(taps: int, device: torch.device) -> Tensor:
    """Return the normalised Gaussian window, [taps]."""
    weights = [math.exp(-((k - taps // 2) ** 2) / (2 * SIGMA**2)) for k in range(taps)]
    return torch.tensor([weight / sum(weights) for weight in weights], device=device)
