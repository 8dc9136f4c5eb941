"""A network that reads from one small masked picture which way an animal heads.

Headings are angles about the up direction, from the direction in which the camera looks (0: away from it) to the
camera's left (a quarter turn), in (-pi, pi]. The network gives the share of each of `SECTORS` even sectors, since a
silhouette looks alike from ahead and from behind.
"""

import math

import torch
from torch import Tensor, nn

SECTORS = 36
SOFTNESS = math.radians(8.0)
"""Standard deviation of the shares around the true heading that the network learns."""
WIDTH = 32
"""Channels of the first layers."""


class HeadingNetwork(nn.Module):
    """Convolutions over the picture, then a layer that knows the camera too; 1.3 million parameters."""

    def __init__(self) -> None:
        super().__init__()
        widths = (2, WIDTH, 2 * WIDTH, 4 * WIDTH, 6 * WIDTH)
        blocks = [_block(before, width) for before, width in zip(widths[:-1], widths[1:], strict=True)]
        self.layers = nn.Sequential(*blocks, nn.Flatten())
        self.head = nn.Sequential(
            nn.Linear(9 * widths[-1] + 2, 256), nn.ReLU(), nn.Dropout(0.2), nn.Linear(256, SECTORS)
        )

    def forward(self, pictures: Tensor, cameras: Tensor) -> Tensor:
        """Return the logarithms of the sectors' shares.

        Args:
            pictures: mask and brightness (`heading.pictures`), [n, 2, 48, 48].
            cameras: sine of the angle by which each looks down, and 1; zeros where they are unknown, [n, 2].

        Returns:
            [n, SECTORS].
        """
        return self.head(torch.cat((self.layers(pictures), cameras), dim=1)).log_softmax(1)  # type: ignore[no-any-return]


def _block(before: int, width: int) -> nn.Sequential:
    layers: list[nn.Module] = []
    for channels, stride in ((before, 2), (width, 1)):
        layers += [nn.Conv2d(channels, width, 3, stride, 1, bias=False), nn.BatchNorm2d(width), nn.ReLU()]
    return nn.Sequential(*layers)


@torch.no_grad()
def log_shares(network: HeadingNetwork, pictures: Tensor, cameras: Tensor) -> Tensor:
    """Return what `HeadingNetwork` says of pictures and of their mirror images, in the mean, [n, SECTORS]."""
    flipped = network(pictures.flip(-1), cameras).flip(1)
    return 0.5 * (network(pictures, cameras) + flipped)  # type: ignore[no-any-return]


def middles() -> Tensor:
    """Return the middle of each sector, radians, [SECTORS]; the mirror image of the k-th is the k-th last."""
    return (torch.arange(SECTORS) + 0.5) * (2 * math.pi / SECTORS) - math.pi


def wrapped(angles: Tensor) -> Tensor:
    """Return angles in [-pi, pi)."""
    return torch.remainder(angles + math.pi, 2 * math.pi) - math.pi


def shares_around(azimuths: Tensor) -> Tensor:
    """Return the shares that the network learns for headings [n], [n, SECTORS]."""
    away = wrapped(azimuths[:, None] - middles())
    return torch.softmax(-0.5 * (away / SOFTNESS).square(), dim=1)


def likeliest(log_shares: Tensor) -> Tensor:
    """Return the mean heading of the sectors around the likeliest one, [n, SECTORS] -> [n]."""
    best = middles()[log_shares.argmax(1)]
    away = wrapped(middles() - best[:, None])
    weights = log_shares.exp() * (away.abs() < math.radians(30.0))
    return wrapped(best + (weights * away).sum(1) / weights.sum(1))
