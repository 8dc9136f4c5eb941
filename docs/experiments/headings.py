"""Measure networks of headings on random animals that none of them learned from (headings.md).

python docs/experiments/headings.py four-legs/weights.safetensors headings/weights.safetensors    # of `prior train`
"""

import math
import sys
from pathlib import Path

import numpy as np
import torch

from rewild4d.priors.heading.examples import drawn
from rewild4d.priors.heading.network import HeadingNetwork, likeliest, log_shares, wrapped
from rewild4d.priors.heading.pictures import Pictures, from_bytes, joined
from rewild4d.priors.heading.training import STREAM
from rewild4d.priors.learned.weights import read_weights

ANIMALS, SEED, TWO_LEGGED = 160, 99, 0.2
AHEAD = math.radians(25)
"""Headings this near to the direction of view are seen from ahead or behind."""


def animals() -> dict[str, Pictures]:
    """Draw animals, parted by their legs as `drawn` parts them: by the first number of each stream."""
    found: dict[str, list[Pictures]] = {"four legs": [], "two legs": []}
    for number in range(ANIMALS):
        is_two_legged = np.random.default_rng((STREAM, SEED, number)).random() < TWO_LEGGED
        made = drawn(np.random.default_rng((STREAM, SEED, number)), TWO_LEGGED)
        found["two legs" if is_two_legged else "four legs"].append(made)
    return {legs: joined(made) for legs, made in found.items()}


def figures(network: HeadingNetwork, known: Pictures) -> str:
    """Return median error in degrees and share of more than 90, of all pictures and of those from ahead or behind."""
    found = likeliest(log_shares(network, from_bytes(known.shown), known.cameras))
    away = wrapped(found - known.azimuths).abs().rad2deg()
    turned = known.azimuths.abs()
    ends = (turned < AHEAD) | (turned > math.pi - AHEAD)
    parts = (("all", torch.ones_like(ends)), ("ahead or behind", ends))
    return "; ".join(
        f"{name} ({int(part.sum())}): {away[part].median():.1f}, {100 * (away[part] > 90).float().mean():.1f} %"
        for name, part in parts
    )


if __name__ == "__main__":
    known = animals()
    for path in map(Path, sys.argv[1:]):
        for legs, pictures in known.items():
            with torch.inference_mode():
                print(f"{path}: {legs}: {figures(read_weights(HeadingNetwork(), path), pictures)}", flush=True)
