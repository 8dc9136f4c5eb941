"""The network's weights, which come with the package."""

from functools import cache
from importlib import resources
from importlib.resources.abc import Traversable

from rewild4d.files import digest
from rewild4d.priors.heading.network import HeadingNetwork
from rewild4d.priors.learned.weights import read_weights

FILE = "weights.safetensors"


@cache
def package_weights() -> HeadingNetwork:
    """Return the network with the package's weights."""
    with resources.as_file(_file()) as path:
        return read_weights(HeadingNetwork(), path)


@cache
def package_digest() -> str:
    """Return the SHA-256 of the package's weights."""
    return digest(_file().read_bytes())


def _file() -> Traversable:
    return resources.files("rewild4d.priors.heading") / FILE
