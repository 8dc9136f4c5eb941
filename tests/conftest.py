"""Guards: the repository root must not shadow other people's packages, and the package must be installed. And fixtures
that tests of several folders use."""

import os
import sys
from collections.abc import Callable, Iterator
from importlib import metadata
from pathlib import Path

import pytest

if "PYTEST_XDIST_WORKER" in os.environ:
    os.environ.setdefault("OMP_NUM_THREADS", "1")  # one process a core: more threads would only wait for each other

ROOT = Path(__file__).resolve().parent.parent
sys.path[:] = [entry for entry in sys.path if Path(entry or ".").resolve() != ROOT]

try:
    import rewild4d.datasets  # noqa: F401
    from rewild4d import progress
except ImportError:
    pytest.exit("rewild4d is not installed: run `make test`, or `pip install -e . -c constraints.txt`.", returncode=2)


LONG = (
    "tests/faults/test_kills.py",
    "tests/running/test_whole_run.py",
    "tests/rasterizer/test_rasterizer_cuda.py",
    "tests/rasterizer/test_rasterizer_limits.py",
    "tests/metrics/test_networks.py",
)
"""Files that take a minute or more."""


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Put the longest files first, so that no process has one left when the others are done."""
    items.sort(key=lambda item: not item.path.as_posix().endswith(LONG))


@pytest.fixture(autouse=True)
def bars(monkeypatch: pytest.MonkeyPatch) -> None:
    """Bars are shown again after a test that ran a part of a table in this process."""
    monkeypatch.setattr(progress, "_hidden", False)


@pytest.fixture
def shared() -> Path:
    """Folder of data outside the repository, which may be absent."""
    return Path(os.environ.get("REWILD4D_SHARED", ROOT.parent / "shared"))


def real_data(shared: Path, name: str) -> Path:
    """Folder of real data; tests that need it skip where it is absent."""
    folder = shared / "data" / name
    if not folder.is_dir():
        pytest.skip(f"real data are not here ({folder}); set REWILD4D_SHARED to the folder that holds data/{name}")
    return folder


@pytest.fixture
def rigs(shared: Path) -> Path:
    """Real rigged animals."""
    return real_data(shared, "rigs")


@pytest.fixture
def davis(shared: Path) -> Path:
    """A real DAVIS folder."""
    return real_data(shared, "davis")


@pytest.fixture
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A cache folder of this test's own."""
    monkeypatch.setenv("REWILD4D_CACHE", str(tmp_path / "cache"))
    return tmp_path / "cache"


@pytest.fixture(scope="module")
def one_thread() -> Iterator[None]:
    """On tiny tensors threads only wait for each other, and on a busy machine for long."""
    import torch

    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


@pytest.fixture
def tiny_footage(one_thread: None, monkeypatch: pytest.MonkeyPatch) -> None:
    """Priors of footage are fitted in a few steps."""
    from films import TINY

    monkeypatch.setattr("rewild4d.priors.choose.FOOTAGE", TINY)


@pytest.fixture
def install(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Iterator[Callable[..., None]]:
    """Pretend that a package with these entry points and files is installed."""

    def call(*entries: tuple[str, str, str], files: dict[str, str]) -> None:
        for name, text in files.items():
            (tmp_path / name).parent.mkdir(exist_ok=True)
            (tmp_path / name).write_text(text)
        monkeypatch.syspath_prepend(str(tmp_path))
        for module in [name for name in sys.modules if name.split(".")[0] == "their_package"]:
            monkeypatch.delitem(sys.modules, module)
        made = [metadata.EntryPoint(name, value, f"rewild4d.{group}") for group, name, value in entries]
        own = metadata.entry_points

        def entry_points(*, group: str) -> object:
            return (
                [entry for entry in made if entry.group == group] if group.startswith("rewild4d.") else own(group=group)
            )

        monkeypatch.setattr(metadata, "entry_points", entry_points)
        plugged_in.cache_clear()

    from rewild4d.registry import plugged_in

    yield call
    plugged_in.cache_clear()
