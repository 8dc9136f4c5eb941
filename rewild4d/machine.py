"""What a record says of the machine and of the code that made it."""

import os
import platform
import sys
from functools import cache
from importlib import metadata, resources
from pathlib import Path

import torch

from rewild4d import __version__
from rewild4d.errors import UserError
from rewild4d.files import digest
from rewild4d.kernels.switch import describe_kernels
from rewild4d.kernels.threads import thread_count
from rewild4d.registry import load_method

TOP = ("rewild4d", "rewild4d.baselines", "rewild4d.datasets", "rewild4d.leaderboard", "rewild4d.metrics")
"""Packages whose folders stand at the top of the repository."""
SHOWING = ("benchmarks", "commands", "leaderboard")
"""Packages that start runs and show results: editing a table's layout changes no result."""


@cache
def code_version() -> dict[str, str]:
    """Return the package's version and a digest of the sources that decide a result.

    The digest is part of a run's id, so that edited code never reuses an old run.
    """
    parts: list[str | bytes] = []
    for name, content in sorted(result_sources().items()):
        parts += [name, content]
    return {"version": __version__, "sources": digest(*parts)[:16]}


def result_sources() -> dict[str, bytes]:
    """Read all sources that decide a result: path below the installed package -> content."""
    found = {}
    for package in TOP:
        folder = Path(str(resources.files(package)))
        for file in folder.rglob("*"):
            name = Path(*package.split(".")[1:], file.relative_to(folder))
            if file.suffix in (".py", ".toml") and name.parts[0] not in SHOWING:
                found[name.as_posix()] = file.read_bytes()
    return found


def code_of(method: str) -> dict[str, str]:
    """`code_version`, and of a method that is not ours a digest over the sources of the package that it is from."""
    package = type(load_method(method)).__module__.partition(".")[0]
    return code_version() | ({} if package == __package__ else {"method": package_sources(package)})


@cache
def package_sources(package: str) -> str:
    """Return the digest of a loaded package's sources, or of the one file of a module."""
    module = sys.modules[package]
    folders = [Path(folder) for folder in getattr(module, "__path__", ())]
    files = [(folder, file) for folder in folders for file in folder.rglob("*") if file.suffix in (".py", ".toml")]
    if not folders and module.__file__:
        files = [(Path(module.__file__).parent, Path(module.__file__))]
    named = sorted((file.relative_to(folder).as_posix(), file.read_bytes()) for folder, file in files)
    return digest(*(part for pair in named for part in pair))[:16]


def machine(device: torch.device, rasterizer: str) -> dict[str, str]:
    """Describe processor, system, threads, backends, and the versions that decide the last digit."""
    packages = ["numpy", "numba"]
    if rasterizer in ("triton", "gsplat"):
        packages.append(rasterizer)
    # Not the metadata's: those of PyPI's wheel do not say that it is the CUDA build.
    versions = {"torch": str(torch.__version__), **{name: metadata.version(name) for name in packages}}
    return {
        "processor": _processor(),
        **({"gpu": torch.cuda.get_device_name(device)} if device.type == "cuda" else {}),
        "rasterizer": rasterizer,
        "kernels": describe_kernels(),
        "system": f"{platform.system()} {platform.machine()}",
        "python": platform.python_version(),
        "threads": str(torch.get_num_threads()),
        "kernel_threads": str(thread_count()),
        **versions,
    }


def peak_memory_mib() -> float:
    """Largest resident memory of this process so far; 0 on Windows, where Python's library does not tell it."""
    try:
        import resource
    except ImportError:
        return 0.0
    unit = 2**20 if sys.platform == "darwin" else 2**10  # of ru_maxrss: bytes on macOS, KiB elsewhere
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / unit


def pick_device(name: str) -> torch.device:
    """Return the torch device of a name ("auto" is the CPU unless a CUDA GPU is there).

    Raises:
        UserError: no such device here.
    """
    if name == "auto":
        return torch.device("cuda" if torch.cuda.is_available() else "cpu")
    if name.split(":")[0] not in ("cpu", "cuda"):
        raise UserError(f"--device: expected auto, cpu or cuda, got '{name}'.")
    if name.startswith("cuda") and not torch.cuda.is_available():
        raise UserError(f"--device {name}: torch {torch.__version__} sees no CUDA GPU here; use --device cpu.")
    return torch.device(name)


def _processor() -> str:
    info = Path("/proc/cpuinfo")
    if info.is_file():
        for line in info.read_text(encoding="utf-8", errors="replace").splitlines():
            if line.startswith("model name"):
                return f"{line.split(':', 1)[1].strip()}, {os.cpu_count()} cores"
    return f"{platform.processor() or platform.machine()}, {os.cpu_count()} cores"
