"""What the network says of a clip's headings, as a term of the template fit."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from rewild4d.priors.heading.network import SECTORS, HeadingNetwork, log_shares
from rewild4d.priors.heading.pictures import from_bytes, ground_axes, said, shrunk, to_bytes
from rewild4d.priors.learned.reading import view_of
from rewild4d.priors.silhouettes import mask_box, require_mask
from rewild4d.types import Frame

DOUBT = 0.5
"""Share of the answers that may be anything: so much that none counts for more than 3 nats."""


@dataclass(frozen=True)
class Headings:
    """What the network says of each frame whose mask is not empty.

    Attributes:
        timesteps: index of each frame's time, int64, [v].
        left: direction to the camera's left on the ground, in the working frame, unit, [v, 3].
        away: direction away from the camera on the ground, likewise, [v, 3].
        scores: logarithm of each sector's share, in the mean over the frames 0 for the likeliest, [v, SECTORS].
    """

    timesteps: Tensor
    left: Tensor
    away: Tensor
    scores: Tensor

    def in_frame(self, working: Tensor) -> "Headings":
        """Return the same in another frame, given by its similarity to the present one, [4, 4]."""
        rotation = (working[:3, :3] / working[:3, :3].det().abs() ** (1 / 3)).to(self.left)
        return Headings(self.timesteps, self.left @ rotation, self.away @ rotation, self.scores)

    def distance(self, headings: Tensor) -> Tensor:
        """Return the mean over frames of the `nats` of guesses [B, T, 3], [B]."""
        return self.nats(headings).mean(1)

    def nats(self, headings: Tensor) -> Tensor:
        """Return how much less likely guesses are than the likeliest heading, in each frame.

        Args:
            headings: directions from tail to head at every time, in the frame of `left` and `away`, [B, T, 3].

        Returns:
            [B, v].
        """
        own = headings[:, self.timesteps]
        azimuths = torch.atan2((own * self.left).sum(-1), (own * self.away).sum(-1))
        place = (azimuths + math.pi) * (SECTORS / (2 * math.pi)) - 0.5
        lower = place.detach().floor()
        share, row = place - lower, lower.long()
        scores = self.scores.expand(len(own), -1, -1)
        first, second = (scores.gather(2, ((row + k) % SECTORS)[..., None])[..., 0] for k in (0, 1))
        return -((1 - share) * first + share * second)


def read_headings(
    frames: Sequence[Frame], timesteps: Sequence[int], up: Tensor, name: str, network: HeadingNetwork, *,
    known: bool = True,
) -> Headings:  # fmt: skip
    """Read the headings in frames with cameras, in the world; those with an empty mask are left out.

    Args:
        frames: with cameras.
        timesteps: indices of their times.
        up: of the world, unit, float64, [3].
        name: of the case, for errors.
        network: trained.
        known: whether the cameras' directions are; the network is not told those of made-up ones.

    Raises:
        UserError: a frame has no camera, or no mask shows anything.
    """
    require_mask(frames, name)
    kept = [(time, frame) for time, frame in zip(timesteps, frames, strict=True) if mask_box(frame.mask[0] > 0.5)]
    views = [view_of(frame, name) for _, frame in kept]
    pictures = torch.from_numpy(np.stack([picture for picture, *_ in views])).float()
    rotations = torch.from_numpy(np.stack([rotation for _, rotation, *_ in views]))
    ups = rotations @ up
    left, away = (torch.einsum("vab,va->vb", rotations, axis).float() for axis in ground_axes(ups))
    shown = from_bytes(to_bytes(shrunk(pictures)))
    shares = log_shares(network, shown, said(ups, torch.full((len(ups),), known))).exp()
    scores = ((1 - DOUBT) * shares + DOUBT / SECTORS).log()
    times = torch.tensor([time for time, _ in kept])
    return Headings(times, left, away, scores - scores.mean(0).max())
