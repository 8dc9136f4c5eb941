"""Random animals that the network learns from."""

import numpy as np
import torch

from rewild4d.datasets.builtin.zoo.varied import FOUR_FOOTED, TWO_LEGGED
from rewild4d.priors.heading.pictures import Pictures, ground_axes, said, shrunk, to_bytes
from rewild4d.priors.learned.examples import draw_sequences
from rewild4d.priors.learned.points import SPINE

SEQUENCES, FRAMES = 16, 4
"""Drawn of each animal."""


def drawn(rng: np.random.Generator, two_legged: float = 0.0, *, stretched: bool = False) -> Pictures:
    """Draw pictures of one random animal under random cameras, `SEQUENCES` * `FRAMES`.

    A share ``two_legged`` of the animals has two legs. Those that are ``stretched`` are wider than the zoo's kinds
    (`varied.draw_animal`).
    """
    kinds = TWO_LEGGED if two_legged and rng.random() < two_legged else FOUR_FOOTED
    found = draw_sequences(rng, SEQUENCES, FRAMES, kinds=kinds, names=SPINE, stretched=stretched)
    rotations, points = (value.flatten(0, 1).double() for value in (found.rotations, found.points))
    ahead = points[:, SPINE.index("withers")] - points[:, SPINE.index("hips")]
    left, away = ground_axes(rotations[:, :, 1])
    known = found.known.repeat_interleave(FRAMES)
    azimuths = torch.atan2((ahead * left).sum(1), (ahead * away).sum(1))
    return Pictures(to_bytes(shrunk(found.pictures.flatten(0, 1))), azimuths.float(), said(rotations[:, :, 1], known))
