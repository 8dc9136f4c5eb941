"""Guards: the repository root must not shadow other people's packages, and the package must be installed."""

import os
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent
sys.path[:] = [entry for entry in sys.path if Path(entry or ".").resolve() != ROOT]

try:
    import rewild4d.datasets  # noqa: F401
except ImportError:
    pytest.exit("rewild4d is not installed: run `make test`, or `pip install -e . -c constraints.txt`.", returncode=2)

SHARED = Path(os.environ.get("REWILD4D_SHARED", ROOT.parent / "shared"))


@pytest.fixture
def rigs() -> Path:
    """Folder of real rigged animals, outside the repository; tests that need it skip where it is absent."""
    folder = SHARED / "data" / "rigs"
    if not folder.is_dir():
        pytest.skip(f"real rigs are not here ({folder}); set REWILD4D_SHARED to the folder that holds data/rigs")
    return folder


@pytest.fixture
def davis() -> Path:
    """A real DAVIS folder, outside the repository; tests that need it skip where it is absent."""
    folder = SHARED / "data" / "davis"
    if not folder.is_dir():
        pytest.skip(f"DAVIS is not here ({folder}); set REWILD4D_SHARED to the folder that holds data/davis")
    return folder
