"""The toy that fits of `ours` are tried on."""

import pytest
from toys import make_toy

from rewild4d.types import Clip, Prior


@pytest.fixture(scope="module")
def toy() -> tuple[Clip, Prior]:
    """A clip of the animal, and a prior of the right shape that does not move."""
    return make_toy()
