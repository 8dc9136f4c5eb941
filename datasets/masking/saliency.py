"""U²-Net-p (Qin et al. 2020, "U²-Net: Going deeper with nested U-structure"): how far each pixel stands out.

1.1 million parameters; `weights fetch` brings them. The published network has its batch normalizations folded into its
convolutions, and so has this one.
"""

import cv2
import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional

from rewild4d.metrics.weights import LoadedWeights

NAME = "u2netp"
SIDE = 320
"""Pictures are read at this width and height, whatever their own."""
MEAN, SPREAD = np.array((0.485, 0.456, 0.406), np.float32), np.array((0.229, 0.224, 0.225), np.float32)
"""Of the pictures that it learned from, red, green, blue."""


class _Conv(nn.Conv2d):
    """Convolution of 3 x 3 that keeps the size, and what is above zero of it."""

    def __init__(self, channels_in: int, channels_out: int, dilation: int = 1) -> None:
        super().__init__(channels_in, channels_out, 3, padding=dilation, dilation=dilation)

    def forward(self, x: Tensor) -> Tensor:
        return functional.relu(super().forward(x), inplace=True)


def _halved(x: Tensor) -> Tensor:
    return functional.max_pool2d(x, 2, stride=2, ceil_mode=True)


def _like(x: Tensor, other: Tensor) -> Tensor:
    return functional.interpolate(x, size=other.shape[2:], mode="bilinear", align_corners=False)


class _Block(nn.Module):
    """A small U: ``depth`` convolutions down, each at half the size of the one before, and as many less one up.

    A flat one keeps the size and dilates instead.
    """

    def __init__(self, depth: int, channels_in: int, *, flat: bool = False, middle: int = 16, out: int = 64) -> None:
        super().__init__()
        self.flat = flat
        widths = [2**level if flat else 1 for level in range(depth - 1)]
        self.first = _Conv(channels_in, out)
        self.down = nn.ModuleList(_Conv(middle if level else out, middle, width) for level, width in enumerate(widths))
        self.bottom = _Conv(middle, middle, 2 ** (depth - 1) if flat else 2)
        self.up = nn.ModuleList(
            _Conv(2 * middle, middle if level else out, width) for level, width in reversed(list(enumerate(widths)))
        )

    def forward(self, x: Tensor) -> Tensor:
        start = x = self.first(x)
        passed: list[Tensor] = []
        for level, conv in enumerate(self.down):
            x = conv(x if self.flat or not level else _halved(x))
            passed.append(x)
        x = self.bottom(x)
        for conv in self.up:
            beside = passed.pop()
            x = conv(torch.cat((x if self.flat else _like(x, beside), beside), dim=1))
        return x + start


class SaliencyNetwork(nn.Module):
    """The network: a large U of small ones. Convolutions are numbered as they are used, as in the published file."""

    def __init__(self) -> None:
        super().__init__()
        kinds = ((7, False), (6, False), (5, False), (4, False), (4, True), (4, True))
        self.down = nn.ModuleList(_Block(d, 64 if level else 3, flat=flat) for level, (d, flat) in enumerate(kinds))
        self.up = nn.ModuleList(_Block(depth, 128, flat=flat) for depth, flat in reversed(kinds[:-1]))
        self.sides = nn.ModuleList(nn.Conv2d(64, 1, 3, padding=1) for _ in kinds)
        self.last = nn.Conv2d(len(kinds), 1, 1)

    def forward(self, x: Tensor) -> Tensor:
        """Return how far each pixel stands out, 0 to 1.

        Args:
            x: pictures less `MEAN`, over `SPREAD`, [B, 3, h, w].

        Returns:
            [B, 1, h, w].
        """
        passed = [self.down[0](x)]
        for block in list(self.down)[1:]:
            passed.append(block(_halved(passed[-1])))
        x = passed.pop()
        found = [x]
        for block in self.up:
            beside = passed.pop()
            x = block(torch.cat((_like(x, beside), beside), dim=1))
            found.append(x)
        sides = [side(one) for side, one in zip(self.sides, reversed(found), strict=True)]
        return self.last(torch.cat([_like(one, sides[0]) for one in sides], dim=1)).sigmoid()


class Saliency:
    """Reads pictures of any size.

    Args:
        weights: of the network (`rewild4d.metrics.weights.load_weights("u2netp")`).
    """

    def __init__(self, weights: LoadedWeights) -> None:
        self._network = SaliencyNetwork().eval()
        # `modules` goes through the convolutions in the order in which they are used, as the published file does.
        used = [one for one in self._network.modules() if isinstance(one, nn.Conv2d)]
        for index, convolution in enumerate(used):
            for part in ("weight", "bias"):
                getattr(convolution, part).data.copy_(weights.tensors[f"{index:03d}.{part}"])
        self._network.to(memory_format=torch.channels_last)  # type: ignore[call-overload]

    def __call__(self, image: np.ndarray) -> np.ndarray:
        """Return how far each pixel stands out, 0 to 1, float32 [h, w].

        Args:
            image: uint8 [h, w, 3], red, green, blue.
        """
        height, width = image.shape[:2]
        how = cv2.INTER_AREA if max(height, width) > SIDE else cv2.INTER_LINEAR
        picture = cv2.resize(image, (SIDE, SIDE), interpolation=how).astype(np.float32)
        picture = (picture / max(float(picture.max()), 1.0) - MEAN) / SPREAD
        with torch.inference_mode():
            x = torch.from_numpy(picture.transpose(2, 0, 1)[None]).to(memory_format=torch.channels_last)
            found: np.ndarray = self._network(x)[0, 0].numpy()
        return cv2.resize(found, (width, height), interpolation=cv2.INTER_LINEAR)
