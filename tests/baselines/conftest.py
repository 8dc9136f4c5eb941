"""What the tests of external programs share."""

import pytest

from rewild4d.baselines import external_alignment
from rewild4d.running.conformance import tiny_case
from rewild4d.types import Case


@pytest.fixture(scope="module")
def case() -> Case:
    """The tiny case with three frames; a module that wants all of them has its own."""
    return tiny_case(frames=3)


@pytest.fixture
def coarse_grid(monkeypatch: pytest.MonkeyPatch) -> None:
    """A coarser grid: enough for a case this small."""
    for name, value in (("AZIMUTHS", 12), ("ELEVATIONS", (20.0,)), ("SCALES", (1.0,)), ("REFINED", 2)):
        monkeypatch.setattr(external_alignment, name, value)
