"""Shared by the networks: exact float32, the normalisation after convolutions, a check of the input's range."""

from collections.abc import Iterator, Mapping
from contextlib import contextmanager

import torch
import torch.nn.functional as F
from torch import Tensor

NORMALISATION_EPSILON = 1e-3
"""Added to the variance by the FID Inception and by I3D alike."""
RANGE_SLACK = 1e-3
"""Rounding of a rendered pixel outside [0, 1] that is allowed; more is another range by mistake."""


@contextmanager
def exact_float32() -> Iterator[None]:
    """Turn off gradients and TF32, whose ten bits change I3D's distances by about 0.1 %."""
    convolutions, products = torch.backends.cudnn.allow_tf32, torch.backends.cuda.matmul.allow_tf32
    torch.backends.cudnn.allow_tf32 = torch.backends.cuda.matmul.allow_tf32 = False
    try:
        with torch.no_grad():
            yield
    finally:
        torch.backends.cudnn.allow_tf32, torch.backends.cuda.matmul.allow_tf32 = convolutions, products


def normalise(tensors: Mapping[str, Tensor], unit: str, x: Tensor) -> Tensor:
    """Compute max(0, (x - mean) / sqrt(variance + 1e-3) + beta), [B, C, ...]: these networks have no scale."""
    mean, variance, beta = (tensors[f"{unit}.{part}"] for part in ("mean", "variance", "beta"))
    return F.batch_norm(x, mean, variance, None, beta, False, 0.0, NORMALISATION_EPSILON).relu_()


def check_range(images: Tensor) -> None:
    """Raise ValueError where a value is outside [0, 1] by more than `RANGE_SLACK`: 0..255, -1..1 or NaN by mistake."""
    if images.numel() == 0:
        raise ValueError(f"expected at least one image, got a tensor of shape {tuple(images.shape)}")
    low, high = (float(x) for x in images.aminmax())
    if not (low >= -RANGE_SLACK and high <= 1 + RANGE_SLACK):
        raise ValueError(f"expected values in [0, 1], got {low:g} to {high:g}")
