"""LPIPS v0.1 (Zhang et al. 2018): a weighted distance between the features of a classifier.

d = sum over five stages of the mean over pixels of w . (f - g)^2, where f and g are the stage's features of the two
images after ReLU, divided by their length over the channels, and w are the stage's learned, non-negative weights.
"""

from collections.abc import Mapping
from typing import Literal

import torch
import torch.nn.functional as F
from torch import Tensor

Net = Literal["alex", "vgg"]

SHIFT, SCALE = (-0.030, -0.088, -0.188), (0.458, 0.448, 0.450)
"""The input's normalisation, per channel, of images in [-1, 1]."""
LENGTH_EPSILON = 1e-10
VGG_STAGES = (2, 2, 3, 3, 3)
"""Convolutions of each stage of VGG-16; features are taken after the last."""
MINIMUM_SIZE: dict[Net, int] = {"alex": 31, "vgg": 16}
"""Smaller images, in pixels either way, leave the last stage without a pixel."""


def lpips(net: Net, tensors: Mapping[str, Tensor], first: Tensor, second: Tensor) -> Tensor:
    """Compute the distance of each pair of images in [0, 1] at their own resolution, [B, 3, H, W] -> float64, [B].

    Args:
        net: the trunk; "alex" and "vgg" are two metrics, not two settings of one.
        tensors: `trunk.<i>.weight` [out, in, k, k] and `.bias` [out] of convolution i; `head.<stage>` [channels].
    """
    images = torch.cat((first, second)) * 2 - 1
    shift, scale = (images.new_tensor(x).reshape(1, 3, 1, 1) for x in (SHIFT, SCALE))
    x, distance = (images - shift) / scale, torch.zeros(len(first), dtype=torch.float64, device=images.device)
    for stage in range(5):
        x = (_alex_stage if net == "alex" else _vgg_stage)(tensors, x, stage)
        f, g = (x / (x.square().sum(1, keepdim=True).sqrt() + LENGTH_EPSILON)).chunk(2)
        distance += torch.einsum("bchw,c->bhw", (f - g).square(), tensors[f"head.{stage}"]).mean((1, 2)).double()
    return distance


def _convolve(tensors: Mapping[str, Tensor], x: Tensor, index: int, stride: int, padding: int) -> Tensor:
    return F.conv2d(x, tensors[f"trunk.{index}.weight"], tensors[f"trunk.{index}.bias"], stride, padding).relu_()


def _alex_stage(tensors: Mapping[str, Tensor], x: Tensor, stage: int) -> Tensor:
    if stage in (1, 2):
        x = F.max_pool2d(x, 3, 2)
    stride, padding = {0: (4, 2), 1: (1, 2)}.get(stage, (1, 1))
    return _convolve(tensors, x, stage, stride, padding)


def _vgg_stage(tensors: Mapping[str, Tensor], x: Tensor, stage: int) -> Tensor:
    if stage > 0:
        x = F.max_pool2d(x, 2, 2)
    first = sum(VGG_STAGES[:stage])
    for index in range(first, first + VGG_STAGES[stage]):
        x = _convolve(tensors, x, index, 1, 1)
    return x
