"""What the network is shown."""

from dataclasses import dataclass

import torch
from torch import Tensor

from rewild4d.priors.learned.pictures import SIZE

SMALLER = 2
"""Pictures are those of `learned.pictures`, so many times smaller along each axis."""
STEPS = 40.0
"""Of the brightness per byte: it has zero mean and a spread of one half."""


@dataclass
class Pictures:
    """Pictures to learn from.

    Attributes:
        shown: mask and brightness as bytes, uint8, [n, 2, s, s].
        azimuths: headings (`heading.network`), radians, [n].
        cameras: sine of the angle by which each looks down, and 1; zeros where they are unknown, [n, 2].
    """

    shown: Tensor
    azimuths: Tensor
    cameras: Tensor

    def __len__(self) -> int:
        return len(self.azimuths)

    def chosen(self, rows: Tensor) -> "Pictures":
        """Return some of the pictures, int64, [m]."""
        return Pictures(*(value[rows] for value in vars(self).values()))

    def mirrored(self, rows: Tensor) -> "Pictures":
        """Return the pictures, some of them (bool, [n]) as a mirror shows them."""
        shown = torch.where(rows[:, None, None, None], self.shown.flip(-1), self.shown)
        return Pictures(shown, torch.where(rows, -self.azimuths, self.azimuths), self.cameras)


def joined(parts: list[Pictures]) -> Pictures:
    """Stack parts."""
    return Pictures(*(torch.cat([getattr(part, name) for part in parts]) for name in vars(parts[0])))


def ground_axes(ups: Tensor) -> tuple[Tensor, Tensor]:
    """Return the directions to the left and away on the ground, in the axes of cameras (x right, y down, z ahead).

    Args:
        ups: the up direction in each, unit, [n, 3].

    Returns:
        Unit vectors, [n, 3] each.
    """
    sight = torch.tensor((0.0, 0.0, 1.0)).to(ups).expand_as(ups)
    away = torch.nn.functional.normalize(sight - ups * ups[:, 2:], dim=1)
    return torch.linalg.cross(ups, away), away


def said(ups: Tensor, known: Tensor) -> Tensor:
    """Return what the network is told of cameras, whose up directions are known or not (bool, [n]), [n, 2]."""
    told = torch.stack((-ups[:, 2], torch.ones_like(ups[:, 2])), dim=1)
    return (told * known[:, None]).float()


def shrunk(pictures: Tensor) -> Tensor:
    """Return pictures of `learned.pictures` in the size that the network takes, [n, 2, 96, 96] -> [n, 2, 48, 48]."""
    assert pictures.shape[-1] == SIZE
    return torch.nn.functional.avg_pool2d(pictures, SMALLER)


def to_bytes(pictures: Tensor) -> Tensor:
    """Return pictures as bytes, [n, 2, s, s]."""
    mask, bright = 255 * pictures[:, 0], 128 + STEPS * pictures[:, 1]
    return torch.stack((mask, bright), dim=1).round().clamp(0, 255).to(torch.uint8)


def from_bytes(shown: Tensor) -> Tensor:
    """Return pictures as the network takes them, [n, 2, s, s]."""
    mask, bright = shown.float().unbind(1)
    return torch.stack((mask / 255, (bright - 128) / STEPS), dim=1)
