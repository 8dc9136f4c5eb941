"""The density of shapes as a safetensors file, one of which comes with the package."""

from functools import cache
from importlib import resources
from importlib.resources.abc import Traversable
from pathlib import Path

from safetensors import SafetensorError
from safetensors.torch import load_file, save_file

from rewild4d.errors import UserError
from rewild4d.files import atomic, digest
from rewild4d.priors.shapes.density import ShapeDensity

FILE = "density.safetensors"


def save_density(density: ShapeDensity, path: Path) -> None:
    """Write a density."""
    with atomic(path) as scratch:
        save_file({"mean": density.mean, "whitening": density.whitening.contiguous()}, scratch)


def read_density(path: Path) -> ShapeDensity:
    """Read a density.

    Raises:
        UserError: no such file, or a damaged one.
    """
    try:
        kept = load_file(path)
        return ShapeDensity(kept["mean"], kept["whitening"])
    except (OSError, SafetensorError, KeyError) as error:
        raise UserError(f"{path}: expected a density of shapes (`prior train` writes one), but: {error}.") from error


@cache
def package_density() -> ShapeDensity:
    """Return the package's density."""
    with resources.as_file(_file()) as path:
        return read_density(path)


@cache
def package_density_digest() -> str:
    """Return the SHA-256 of the package's density."""
    return digest(_file().read_bytes())


def _file() -> Traversable:
    return resources.files("rewild4d.priors.shapes") / FILE
