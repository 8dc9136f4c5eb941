"""What only some systems have: the package imports and works without it. Run on Linux, with those calls taken away."""

import os
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

from rewild4d.files import command_words

ROOT = Path(__file__).resolve().parent.parent
WITHOUT = """
import builtins, importlib, os, sys, tempfile
from pathlib import Path
import cv2, numba, scipy, torch  # others' own affair

given = builtins.__import__

def hidden(name, where=None, *more):
    if name in ("fcntl", "resource") and (where or {}).get("__name__", "").startswith("rewild4d"):
        raise ImportError(name)
    return given(name, where, *more)

builtins.__import__ = hidden
for name in ("register_at_fork", "sched_getaffinity", "killpg", "getppid"):
    delattr(os, name)
for name in sys.argv[1:]:
    importlib.import_module(name)

from rewild4d import files, machine
assert files.fcntl is None
with tempfile.TemporaryDirectory() as folder, files.held(Path(folder), "waiting"):
    files.write_text(Path(folder, "text"), "text")
assert machine.peak_memory_mib() == 0.0
"""


def modules() -> list[str]:
    """Every module of the package."""
    packages = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["tool"]["setuptools"]["package-dir"]
    found = [f"{package}.{file.stem}" for package, folder in packages.items() for file in (ROOT / folder).glob("*.py")]
    apart = ("triton", "gsplat", "__main__")  # two need an extra; the last would run the command
    return sorted(name for name in found if not any(part in name for part in apart))


def test_every_module_imports_where_linux_calls_are_missing() -> None:
    done = subprocess.run([sys.executable, "-c", WITHOUT, *modules()], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr[-2000:]


def test_backslashes_of_a_windows_path_stay(monkeypatch: pytest.MonkeyPatch) -> None:
    command = r"""C:\py\python.exe "C:\my files\run.py" --name='C:\a b' {clip}"""
    with monkeypatch.context() as patch:
        patch.setattr(os, "name", "nt")
        words = command_words(command)
    assert words == [r"C:\py\python.exe", r"C:\my files\run.py", r"--name=C:\a b", "{clip}"]
    assert command_words(r"a\ b '#c' # d") == ["a b", "#c", "#", "d"]


def test_tables_can_be_printed_where_the_code_page_has_no_arrows() -> None:
    code = "from rewild4d.cli import _print_utf8; _print_utf8(); print('PSNR ↑')"
    environment = os.environ | {"PYTHONIOENCODING": "cp1252"}
    done = subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, check=True)
    assert done.stdout.decode().strip() == "PSNR ↑"


@pytest.mark.parametrize("chosen", [{"NUMBA_CPU_NAME": "generic"}, {"NUMBA_ENABLE_AVX": "0"}])
def test_kernels_use_no_feature_that_numba_was_told_to_leave_out(chosen: dict[str, str]) -> None:
    code = "from rewild4d.kernels import halves, matrix; print(halves.available(), matrix.ROWS)"
    environment = os.environ | chosen
    done = subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, text=True, check=True)
    assert done.stdout.split() == ["False", "4"]
