"""What the networks share: exact float32, the normalisation behind convolutions, and a check of the input's range."""

from collections.abc import Iterator, Mapping
from contextlib import contextmanager

import torch
import torch.nn.functional as F
from torch import Tensor

NORMALISATION_EPSILON = 1e-3
"""Added to the variance by the FID Inception and by I3D alike."""
RANGE_SLACK = 1e-3
"""How far outside [0, 1] rounding may put a rendered pixel; more is another range by mistake."""


@contextmanager
def exact_float32() -> Iterator[None]:
    """No gradients, and no TF32: it keeps ten bits of a number and moves I3D's distances by about 0.1 %."""
    convolutions, products = torch.backends.cudnn.allow_tf32, torch.backends.cuda.matmul.allow_tf32
    torch.backends.cudnn.allow_tf32 = torch.backends.cuda.matmul.allow_tf32 = False
    try:
        with torch.no_grad():
            yield
    finally:
        torch.backends.cudnn.allow_tf32, torch.backends.cuda.matmul.allow_tf32 = convolutions, products


def normalise(tensors: Mapping[str, Tensor], unit: str, x: Tensor) -> Tensor:
    """max(0, (x - mean) / sqrt(variance + 1e-3) + beta): these networks were trained without a scale.

    Args:
        tensors: `<unit>.mean`, `.variance` and `.beta`, [C].
        unit: name of the convolution in front.
        x: what the convolution gave, [B, C, ...].
    """
    mean, variance, beta = (tensors[f"{unit}.{part}"] for part in ("mean", "variance", "beta"))
    return F.batch_norm(x, mean, variance, None, beta, False, 0.0, NORMALISATION_EPSILON).relu_()


def check_range(images: Tensor) -> None:
    """Refuse 0..255 and -1..1, the usual silent mistakes, and NaN.

    Args:
        images: of any shape, meant to be in [0, 1].

    Raises:
        ValueError: a value is outside [0, 1] by more than `RANGE_SLACK`, or is not a number.
    """
    if images.numel() == 0:
        raise ValueError(f"expected at least one image, got a tensor of shape {tuple(images.shape)}")
    low, high = (float(x) for x in images.aminmax())
    if not (low >= -RANGE_SLACK and high <= 1 + RANGE_SLACK):
        raise ValueError(f"expected values in [0, 1], got {low:g} to {high:g}")
