"""The one entry point: checks the input and hands it to a backend."""

import math

import numpy as np
import torch
from torch import Tensor

from rewild4d.rasterizer import backends
from rewild4d.rasterizer.conventions import EPS2D, RasterInfo

MOST_FEATURE = 2.0**100
"""Single precision ends at 3e38, and the backward pass multiplies channels by derivatives."""


def rasterize(
    means: Tensor,
    quats: Tensor,
    scales: Tensor,
    opacities: Tensor,
    features: Tensor,
    world_to_camera: Tensor,
    intrinsics: Tensor,
    width: int,
    height: int,
    *,
    background: Tensor | None = None,
    eps2d: float = EPS2D,
    antialias: bool = False,
    near: float = 0.01,
    backend: str = "auto",
) -> tuple[Tensor, Tensor, RasterInfo]:
    """Blend 3D Gaussians front to back into images (design note "The one rasterizer"; semantics of gsplat).

    Differentiable in every tensor argument. Values and gradients are the same bits for any number of threads.

    Args:
        means: centres in the world, [N, 3].
        quats: orientations, wxyz, of any length but zero (normalised here), [N, 4].
        scales: standard deviations along the Gaussian's own axes, [N, 3].
        opacities: in [0, 1], [N].
        features: any number of channels (colour, normal, depth, part), magnitudes up to `MOST_FEATURE`, [N, C].
        world_to_camera: OpenCV axes; converted to the dtype and device of ``means``, [V, 4, 4].
        intrinsics: pinhole without skew, pixel centres at +0.5; converted likewise, [V, 3, 3].
        width: image width in pixels.
        height: image height in pixels.
        background: composited behind everything, [C] or [V, C]; None leaves the features premultiplied (black).
        eps2d: variance in square pixels added to every projected Gaussian.
        antialias: scale opacity down by what ``eps2d`` adds in area, so that far objects do not grow.
        near: Gaussians whose centre is not farther than this along the camera's z are not drawn.
        backend: "numba" (float32 on the CPU), "triton" or "gsplat" (float32 on a CUDA GPU), "reference" (dense torch,
            any device and float type, small scenes only) or "auto": the process's choice (`set_default`) where it
            takes these tensors, else the fastest that does, else the reference.

    Returns:
        features [V, C, height, width], alpha [V, 1, height, width], and the info densification needs.

    Raises:
        ValueError: a shape, type, device or option is wrong, or a value is not finite or too large; names the tensor
            and the index.
    """
    named = {"means": means, "quats": quats, "scales": scales, "opacities": opacities, "features": features}
    _check_gaussians(named)
    world_to_camera, intrinsics = world_to_camera.to(means), intrinsics.to(means)
    _check_cameras(world_to_camera, intrinsics, width, height)
    views, channels = world_to_camera.shape[0], features.shape[1]
    named |= {"world_to_camera": world_to_camera, "intrinsics": intrinsics}
    if background is not None:
        if background.shape not in ((channels,), (views, channels)):
            raise ValueError(
                f"background: expected shape [{channels}] or [{views}, {channels}], got {list(background.shape)}."
            )
        background = background.to(means).expand(views, channels)
        named["background"] = background
    _check_values(named)
    if not (eps2d >= 0 and near > 0):
        raise ValueError(f"expected eps2d >= 0 and near > 0, got eps2d={eps2d} and near={near}.")
    render = backends.load(backends.resolve(backend, means.device, means.dtype))
    return render(
        means, quats, scales, opacities, features, world_to_camera, intrinsics,
        int(width), int(height), background, float(eps2d), bool(antialias), float(near),
    )  # fmt: skip


def _check_gaussians(named: dict[str, Tensor]) -> None:
    means = named["means"]
    count = means.shape[0] if means.ndim else 0
    if means.dtype not in (torch.float32, torch.float64):
        raise ValueError(f"means: expected float32 or float64, got {means.dtype}.")
    wanted = {"means": (count, 3), "quats": (count, 4), "scales": (count, 3), "opacities": (count,)}
    for name, tensor in named.items():
        shape = tuple(tensor.shape)
        if name == "features":
            if tensor.ndim != 2 or shape[0] != count or shape[1] < 1:
                raise ValueError(f"features: expected shape [{count}, C] with C >= 1, got {list(shape)}.")
        elif shape != wanted[name]:
            raise ValueError(f"{name}: expected shape {list(wanted[name])}, got {list(shape)}.")
        if tensor.dtype != means.dtype or tensor.device != means.device:
            raise ValueError(
                f"{name}: expected {means.dtype} on {means.device} as means has, got {tensor.dtype} on {tensor.device}."
            )


def _check_cameras(world_to_camera: Tensor, intrinsics: Tensor, width: int, height: int) -> None:
    views = world_to_camera.shape[0] if world_to_camera.ndim else 0
    if views < 1 or tuple(world_to_camera.shape[1:]) != (4, 4):
        raise ValueError(f"world_to_camera: expected shape [V, 4, 4] with V >= 1, got {list(world_to_camera.shape)}.")
    if tuple(intrinsics.shape) != (views, 3, 3):
        raise ValueError(f"intrinsics: expected shape [{views}, 3, 3], got {list(intrinsics.shape)}.")
    if width < 1 or height < 1:
        raise ValueError(f"expected an image of at least one pixel, got {width} x {height}.")


def _check_values(named: dict[str, Tensor]) -> None:
    """Pinholes, and that all is finite and not too large."""
    if named["means"].device.type == "cpu":
        _check_pinholes(named["intrinsics"].tolist())
    else:
        largest, pinholes = fetch(named)
        _check_pinholes(pinholes)
        if largest <= MOST_FEATURE:  # NaN is not
            return
    _check_finite(named)
    _check_range(named)


def fetch(named: dict[str, Tensor]) -> tuple[float, list[list[list[float]]]]:
    """The largest magnitude of all, NaN if anything is, and the intrinsics: in one go, as each waits for the GPU."""
    filled = [tensor.detach() for tensor in named.values() if tensor.numel()]
    norms = torch.stack([*torch._foreach_norm(filled, math.inf)])
    # A maximum of Python's, or of some of torch's kernels, passes over NaN; a sum does not.
    largest = torch.where(norms.sum().isfinite(), norms.amax(), math.nan)
    flat = torch.cat((largest[None], named["intrinsics"].detach().flatten())).tolist()
    rows = [flat[place : place + 3] for place in range(1, len(flat), 3)]
    return flat[0], [rows[place : place + 3] for place in range(0, len(rows), 3)]


def _check_pinholes(matrices: list[list[list[float]]]) -> None:
    for view, matrix in enumerate(matrices):
        (fx, skew, _), (lower, fy, _), last = matrix
        if not (fx > 0 and fy > 0 and skew == 0 and lower == 0 and last == [0, 0, 1]) and all(
            map(math.isfinite, sum(matrix, []))
        ):
            raise ValueError(
                f"intrinsics[{view}]: expected [[fx, 0, cx], [0, fy, cy], [0, 0, 1]] with positive focal lengths, "
                f"got {matrix}."
            )


def _check_finite(named: dict[str, Tensor]) -> None:
    # A sum is one fast pass and is finite unless something in it is not (or it overflows, then the slow look decides).
    # NumPy's wakes no OpenMP threads, see `cpu._zeros`.
    with np.errstate(all="ignore"):
        for name, tensor in named.items():
            values = tensor.detach()
            total = float(values.numpy().sum()) if values.device.type == "cpu" else values.sum().item()
            if not math.isfinite(total) and len(bad := (~torch.isfinite(values)).nonzero()):
                index = tuple(bad[0].tolist())
                raise ValueError(f"{name}: expected finite values, got {values[index].item()} at index {list(index)}.")


def _check_range(named: dict[str, Tensor]) -> None:
    """Channels whose products with each other's derivatives would overflow, and leave NaN in a gradient."""
    for name in ("features", "background"):
        values = named[name].detach() if name in named else torch.empty(0)
        if values.numel() and float(torch.maximum(values.max(), -values.min())) > MOST_FEATURE:
            index = tuple((values.abs() > MOST_FEATURE).nonzero()[0].tolist())
            found = f"{values[index].item():g} at index {list(index)}"
            raise ValueError(f"{name}: expected magnitudes up to {MOST_FEATURE:.2g}, got {found}.")
