"""A prior that tests of several modules write and read."""

import pytest
import torch
from prior_files import two_frames

from rewild4d.priors.bodies.quadruped import QUADRUPED
from rewild4d.priors.fit import Animal, make_prior
from rewild4d.transforms import similarity
from rewild4d.types import Prior


@pytest.fixture
def prior() -> Prior:
    """A bent template in `two_frames`."""
    angles = 0.3 * torch.randn(2, 20, 3, generator=torch.Generator().manual_seed(0))
    matrix = similarity(0.5, torch.eye(3, dtype=torch.float64), 0.1 * torch.ones(3, dtype=torch.float64))
    poses = matrix.expand(2, 4, 4).contiguous()
    animal = Animal(QUADRUPED, QUADRUPED.proportions(), poses, angles, seen="masks", figures={"cost": 0.25})
    return make_prior(animal, two_frames(), "template", "Made by a test.")
