"""The small animal that tests of Artemis folders damage."""

from pathlib import Path

import pytest
from artemis_animals import write_animal


@pytest.fixture
def animal(tmp_path: Path) -> Path:
    return write_animal(tmp_path / "cat")
