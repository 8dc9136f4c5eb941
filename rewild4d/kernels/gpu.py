"""Kernels for a CUDA GPU beside the rasterizer's, as functions with gradients; `on_gpu` says where they run.

Without Triton, on another device or with `--kernels torch` the torch twins run.
"""

import importlib.util
from functools import cache
from types import ModuleType
from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from rewild4d.kernels.switch import kernel_mode

SQUARINGS = 14
"""Of a covariance: its eigenvalues are raised to the power 2^14."""


def on_gpu(*tensors: Tensor) -> bool:
    """Tell whether these kernels take the tensors: float32 on a CUDA GPU, Triton is there, kernels are switched on."""
    if not all(tensor.is_cuda and tensor.dtype == torch.float32 for tensor in tensors):
        return False
    return kernel_mode() == "auto" and _has_triton()


@cache
def _has_triton() -> bool:
    return importlib.util.find_spec("triton") is not None


@cache
def _kernels() -> ModuleType:
    from rewild4d.kernels import triton_gaussians  # needs Triton

    return triton_gaussians


def _launch(kernel: Any, *arguments: Any, **constants: Any) -> None:
    """Run a kernel with a lane for each row of its first argument."""
    count = len(arguments[0])
    if count:
        kernel[(-(-count // _kernels().BLOCK.value),)](*arguments, **constants)


def multiply(a: Tensor, b: Tensor) -> Tensor:
    """Compute the Hamilton products of quaternions [n, 4]; twin: `transforms.quat_multiply`."""
    return _Multiply.apply(a, b)


class _Multiply(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, a: Tensor, b: Tensor) -> Tensor:
        a, b = a.contiguous(), b.contiguous()
        ctx.save_for_backward(a, b)
        return _product(a, b, 1, 1)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor | None, ...]:
        (a, b), (of_a, of_b), grad = ctx.saved_tensors, ctx.needs_input_grad, grad.contiguous()
        return _product(grad, b, 1, -1) if of_a else None, _product(a, grad, -1, 1) if of_b else None


def _product(a: Tensor, b: Tensor, left: int, right: int) -> Tensor:
    made = torch.empty_like(a)
    _launch(_kernels().multiply, a, b, made, len(a), LEFT=left, RIGHT=right)
    return made


def smallest_axes(quats: Tensor, log_scales: Tensor, means: Tensor, eye: Tensor) -> Tensor:
    """Return the axis of each Gaussian's smallest scale, pointing to ``eye`` [3], differentiable in the quats, [n, 3];
    twin: `losses.regularizers._normals`."""
    return _Axes.apply(quats, log_scales, means, eye)


class _Axes(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, quats: Tensor, log_scales: Tensor, means: Tensor, eye: Tensor) -> Tensor:
        quats, log_scales, means = quats.contiguous(), log_scales.contiguous(), means.contiguous()
        made = torch.empty_like(means)
        _launch(_kernels().axes, quats, log_scales, means, eye.contiguous(), made, len(quats))
        ctx.save_for_backward(quats, log_scales, made)
        return made

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor | None, ...]:
        quats, log_scales, made = ctx.saved_tensors
        v_quats = torch.empty_like(quats)
        _launch(_kernels().axes_backward, quats, log_scales, made, grad.contiguous(), v_quats, len(quats))
        return v_quats, None, None, None


def seen_rgb(
    colors: Tensor, means: Tensor, quats: Tensor, rest: Tensor, eye: Tensor, degree: int, gain: float
) -> Tensor:
    """Compute colours from a viewpoint, differentiable in the colours; twin: `canonical.Gaussians.seen_rgb`.

    Args:
        colors: RGB, then coefficients times ``gain``, [n, k, 3].
        means: [n, 3].
        quats: posed orientations, [n, 4].
        rest: orientations at rest, [n, 4].
        eye: viewpoint, [3].
        degree: of the harmonics in use, at least 1.
        gain: see ``colors``.
    """
    return _Seen.apply(colors, means.detach(), quats.detach(), rest.detach(), eye.to(means), degree, gain)


class _Seen(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any, colors: Tensor, means: Tensor, quats: Tensor, rest: Tensor, eye: Tensor, degree: int, gain: float
    ) -> Tensor:
        given = [part.contiguous() for part in (means, quats, rest, eye)]
        made, colors = torch.empty_like(given[0]), colors.contiguous()
        ctx.sizes = len(colors), colors.shape[1], gain
        ctx.used = (degree + 1) ** 2
        _launch(_kernels().colours, colors, *given, made, *ctx.sizes, USED=ctx.used)
        ctx.save_for_backward(made, *given)
        return made

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor | None, ...]:
        made, *given = ctx.saved_tensors
        count, coefficients, _ = ctx.sizes
        new = torch.empty if ctx.used == coefficients else torch.zeros
        v_colors = new(count, coefficients, 3, dtype=made.dtype, device=made.device)
        arguments = made, grad.contiguous(), *given, v_colors, *ctx.sizes
        _launch(_kernels().colours_backward, *arguments, USED=ctx.used)
        return v_colors, *[None] * 6


def splat_colors(colors: Tensor, means: Tensor, eye: Tensor) -> Tensor:
    """Return RGB of splats from a viewpoint [3], without gradients, [n, k, 3] -> [n, 3]; twin:
    `harmonics.seen_colors`."""
    colors, means = colors.contiguous(), means.contiguous()
    made = torch.empty_like(means)
    _launch(_kernels().splat_colours, colors, means, eye.contiguous(), made, len(means), USED=colors.shape[1])
    return made


def top_axes(matrices: Tensor) -> Tensor:
    """Return the unit eigenvectors of the largest eigenvalues of positive matrices [J, 3, 3], without gradients, [J,
    3]; twin: `losses.regularizers.top_axes`."""
    matrices = matrices.detach().contiguous()
    made, side = matrices.new_empty(len(matrices), 3), _kernels().SIDE.value
    _kernels().squared_axes[(-(-len(matrices) // side),)](matrices, made, len(matrices), SQUARINGS=SQUARINGS)
    return made
