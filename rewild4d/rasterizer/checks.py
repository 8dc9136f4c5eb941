"""Check the rasterizer's input: shapes, types and values."""

import math

import numpy as np
import torch
from torch import Tensor

from rewild4d.kernels.arrays import fits

MOST_FEATURE = 2.0**100
"""Single precision ends at 3e38, and the backward pass multiplies features by gradients."""


def check_gaussians(named: dict[str, Tensor]) -> None:
    """Check shapes, types and devices of means, quats, scales, opacities and features.

    Raises:
        ValueError: names the tensor.
    """
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


def check_cameras(world_to_camera: Tensor, intrinsics: Tensor, width: int, height: int) -> None:
    """Check shapes, and the size of the image.

    Raises:
        ValueError: names the tensor.
    """
    views = world_to_camera.shape[0] if world_to_camera.ndim else 0
    if views < 1 or tuple(world_to_camera.shape[1:]) != (4, 4):
        raise ValueError(f"world_to_camera: expected shape [V, 4, 4] with V >= 1, got {list(world_to_camera.shape)}.")
    if tuple(intrinsics.shape) != (views, 3, 3):
        raise ValueError(f"intrinsics: expected shape [{views}, 3, 3], got {list(intrinsics.shape)}.")
    if width < 1 or height < 1:
        raise ValueError(f"expected an image of at least one pixel, got {width} x {height}.")


def check_values(named: dict[str, Tensor]) -> None:
    """Check that pinholes are valid and that all values are finite and not too large.

    Raises:
        ValueError: names the tensor and the index.
    """
    _check_pinholes(named["intrinsics"].tolist())
    if all(map(fits, named.values())):
        from rewild4d.kernels.magnitudes import all_below  # imports numba, which a GPU does not need

        if all_below(named.values(), MOST_FEATURE):
            return  # in a tenth of the time; otherwise the slow checks find the value
    _check_finite(named)
    _check_range(named)


def _check_pinholes(matrices: list[list[list[float]]]) -> None:
    for view, matrix in enumerate(matrices):
        (fx, skew, _), (lower, fy, _), last = matrix
        valid = fx > 0 and fy > 0 and skew == 0 and lower == 0 and last == [0, 0, 1]
        if not valid and all(map(math.isfinite, sum(matrix, []))):
            raise ValueError(
                f"intrinsics[{view}]: expected [[fx, 0, cx], [0, fy, cy], [0, 0, 1]] with positive focal lengths, "
                f"got {matrix}."
            )


def _check_finite(named: dict[str, Tensor]) -> None:
    # a sum is one fast pass and finite, unless a value is not or it overflows; NumPy's wakes no OpenMP threads
    with np.errstate(all="ignore"):
        for name, tensor in named.items():
            values = tensor.detach()
            total = float(values.numpy().sum()) if values.device.type == "cpu" else values.sum().item()
            if not math.isfinite(total) and len(bad := (~torch.isfinite(values)).nonzero()):
                index = tuple(bad[0].tolist())
                raise ValueError(f"{name}: expected finite values, got {values[index].item()} at index {list(index)}.")


def _check_range(named: dict[str, Tensor]) -> None:
    """Check channels: products of larger ones overflow in the backward pass and leave NaN."""
    for name in ("features", "background"):
        values = named[name].detach() if name in named else torch.empty(0)
        large = values.abs() > MOST_FEATURE
        if large.any():
            index = tuple(large.nonzero()[0].tolist())
            found = f"{values[index].item():g} at index {list(index)}"
            raise ValueError(f"{name}: expected magnitudes up to {MOST_FEATURE:.2g}, got {found}.")
