"""Random animals that the network learns from."""

import numpy as np
import torch

from rewild4d.priors.heading.pictures import Pictures, ground_axes, said, shrunk, to_bytes
from rewild4d.priors.learned.examples import draw_sequences
from rewild4d.priors.learned.points import NAMES

SEQUENCES, FRAMES = 16, 4
"""Drawn of each animal."""


def drawn(rng: np.random.Generator) -> Pictures:
    """Draw pictures of one random animal under random cameras, `SEQUENCES` * `FRAMES`."""
    found = draw_sequences(rng, SEQUENCES, FRAMES)
    rotations, points = (value.flatten(0, 1).double() for value in (found.rotations, found.points))
    ahead = points[:, NAMES.index("withers")] - points[:, NAMES.index("hips")]
    left, away = ground_axes(rotations[:, :, 1])
    known = found.known.repeat_interleave(FRAMES)
    azimuths = torch.atan2((ahead * left).sum(1), (ahead * away).sum(1))
    return Pictures(to_bytes(shrunk(found.pictures.flatten(0, 1))), azimuths.float(), said(rotations[:, :, 1], known))
