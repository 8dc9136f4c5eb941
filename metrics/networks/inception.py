"""The Inception-v3 of December 2015 that FID and KID are defined on (Szegedy et al. 2015; Heusel et al. 2017).

It differs from that of model zoos: average pools leave out the padding, the last block pools by maximum, and its
weights are from another training. Names are those of the usual PyTorch conversions.
"""

from collections.abc import Mapping

import torch
import torch.nn.functional as F
from torch import Tensor

from rewild4d.metrics.networks.layers import normalise

SIZE = 299
"""Side of the square input in pixels."""
TAPS = (64, 192, 768, 2048)
"""Layers whose features can be returned, by their dimension; 2048 is "pool3"."""
STEM = (("Conv2d_1a_3x3", 2, 0), ("Conv2d_2a_3x3", 1, 0), ("Conv2d_2b_3x3", 1, 1))
"""First convolutions: name, stride, padding."""


class Inception:
    """Forward pass of Inception-v3.

    Args:
        tensors: `<unit>.weight` [out, in, h, w]; `<unit>.mean`, `.variance`, `.beta` [out].
    """

    def __init__(self, tensors: Mapping[str, Tensor]) -> None:
        self.tensors = tensors

    def __call__(self, x: Tensor, tap: int = 2048) -> Tensor:
        """Average features over the pixels of the tap's layer; later layers are not computed.

        Args:
            x: (pixel - 128) / 128 of pixels in 0..255, [B, 3, 299, 299].
            tap: one of `TAPS`.
        """
        for name, stride, padding in STEM:
            x = self._unit(name, x, stride, padding)
        x = F.max_pool2d(x, 3, 2)
        if tap == 64:
            return x.mean((2, 3))
        x = self._unit("Conv2d_4a_3x3", self._unit("Conv2d_3b_1x1", x))
        x = F.max_pool2d(x, 3, 2)
        if tap == 192:
            return x.mean((2, 3))
        for name in ("Mixed_5b", "Mixed_5c", "Mixed_5d"):
            x = self._block_35(name, x)
        x = self._reduce_to_17(x)
        for name in ("Mixed_6b", "Mixed_6c", "Mixed_6d", "Mixed_6e"):
            x = self._block_17(name, x)
        if tap == 768:
            return x.mean((2, 3))
        x = self._reduce_to_8(x)
        x = self._block_8("Mixed_7b", x, _average(x))
        x = self._block_8("Mixed_7c", x, F.max_pool2d(x, 3, 1, 1))
        return x.mean((2, 3))

    def _unit(self, name: str, x: Tensor, stride: int = 1, padding: int | tuple[int, int] = 0) -> Tensor:
        x = F.conv2d(x, self.tensors[f"{name}.weight"], None, stride, padding)
        return normalise(self.tensors, name, x)

    def _chain(self, name: str, x: Tensor, *units: str) -> Tensor:
        """Apply units in order, each padded so that it keeps the size."""
        for unit in units:
            height, width = self.tensors[f"{name}.{unit}.weight"].shape[2:]
            x = self._unit(f"{name}.{unit}", x, 1, (height // 2, width // 2))
        return x

    def _block_35(self, name: str, x: Tensor) -> Tensor:
        branches = (
            self._chain(name, x, "branch1x1"),
            self._chain(name, x, "branch5x5_1", "branch5x5_2"),
            self._chain(name, x, "branch3x3dbl_1", "branch3x3dbl_2", "branch3x3dbl_3"),
            self._chain(name, _average(x), "branch_pool"),
        )
        return torch.cat(branches, 1)

    def _reduce_to_17(self, x: Tensor) -> Tensor:
        double = self._chain("Mixed_6a", x, "branch3x3dbl_1", "branch3x3dbl_2")
        branches = (
            self._unit("Mixed_6a.branch3x3", x, 2),
            self._unit("Mixed_6a.branch3x3dbl_3", double, 2),
            F.max_pool2d(x, 3, 2),
        )
        return torch.cat(branches, 1)

    def _block_17(self, name: str, x: Tensor) -> Tensor:
        branches = (
            self._chain(name, x, "branch1x1"),
            self._chain(name, x, *(f"branch7x7_{i}" for i in (1, 2, 3))),
            self._chain(name, x, *(f"branch7x7dbl_{i}" for i in (1, 2, 3, 4, 5))),
            self._chain(name, _average(x), "branch_pool"),
        )
        return torch.cat(branches, 1)

    def _reduce_to_8(self, x: Tensor) -> Tensor:
        third = self._chain("Mixed_7a", x, "branch3x3_1")
        seventh = self._chain("Mixed_7a", x, *(f"branch7x7x3_{i}" for i in (1, 2, 3)))
        branches = (
            self._unit("Mixed_7a.branch3x3_2", third, 2),
            self._unit("Mixed_7a.branch7x7x3_4", seventh, 2),
            F.max_pool2d(x, 3, 2),
        )
        return torch.cat(branches, 1)

    def _block_8(self, name: str, x: Tensor, pooled: Tensor) -> Tensor:
        third = self._chain(name, x, "branch3x3_1")
        double = self._chain(name, x, "branch3x3dbl_1", "branch3x3dbl_2")
        branches = (
            self._chain(name, x, "branch1x1"),
            self._chain(name, third, "branch3x3_2a"),
            self._chain(name, third, "branch3x3_2b"),
            self._chain(name, double, "branch3x3dbl_3a"),
            self._chain(name, double, "branch3x3dbl_3b"),
            self._chain(name, pooled, "branch_pool"),
        )
        return torch.cat(branches, 1)


def _average(x: Tensor) -> Tensor:
    """Average 3x3 pixels, without the padding."""
    return F.avg_pool2d(x, 3, 1, 1, count_include_pad=False)
