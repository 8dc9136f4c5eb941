"""Learn where shapes lie: draw random animals, fit the template to each, keep their mean and covariance.

A run that was stopped goes on with the animals that are missing, and its result is the same.
"""

import time
from collections.abc import Callable
from pathlib import Path

import msgspec
import numpy as np
import torch
from torch import Tensor
from torch.utils.data import DataLoader, Dataset

from rewild4d.errors import UserError
from rewild4d.files import atomic
from rewild4d.priors.shapes.density import ShapeDensity
from rewild4d.priors.shapes.examples import drawn
from rewild4d.priors.shapes.weights import FILE, save_density

STREAM, OWN = 7781, 99
"""Start of every seed here, so that no animal is one of the zoo's seeds; the second number sets them apart from those
that networks learn from."""
TOLD = 10
"""Animals from one line of progress to the next."""
FAILED = 0.25
"""Cost above which a fit is left out: the template is no likeness of the animal."""


class TrainingConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Settings of a training.

    Attributes:
        animals: to learn from.
        seed: of the animals.
    """

    animals: int = 275
    seed: int = 0


class _Samples(Dataset[Path]):
    """Files of one animal's shape each; asking for one makes it."""

    def __init__(self, folder: Path, config: TrainingConfig) -> None:
        self.folder, self.config = folder, config

    def __len__(self) -> int:
        return self.config.animals

    def __getitem__(self, row: int) -> Path:
        path = self.folder / f"{self.config.seed}-{row:05d}.npz"
        if not path.is_file():
            torch.set_num_threads(1)
            shape, cost = drawn(np.random.default_rng((STREAM, OWN + self.config.seed, row)))
            with atomic(path) as scratch, scratch.open("wb") as file:
                np.savez(file, shape=shape.numpy(), cost=cost)
        return path


def train(folder: Path, config: TrainingConfig, *, workers: int, report: Callable[[str], None]) -> Path:
    """Fit the animals that are missing, then write what all of them say.

    Args:
        folder: for samples/ and density.safetensors.
        config: settings.
        workers: processes that fit animals.
        report: called with a line now and then.

    Returns:
        The file of the density.

    Raises:
        UserError: fewer than two animals can be fitted.
    """
    samples = _fitted(folder / "samples", config, workers, report)
    save_density(ShapeDensity.of(samples), folder / FILE)
    return folder / FILE


def _fitted(folder: Path, config: TrainingConfig, workers: int, report: Callable[[str], None]) -> Tensor:
    folder.mkdir(parents=True, exist_ok=True)
    loader = DataLoader(_Samples(folder, config), batch_size=None, num_workers=workers)
    shapes, costs, began = [], [], time.monotonic()
    for path in loader:
        with np.load(path) as kept:
            shapes.append(torch.from_numpy(kept["shape"]))
            costs.append(float(kept["cost"]))
        if len(shapes) % TOLD == 0:
            report(f"fitted {len(shapes)} of {config.animals} animals, {time.monotonic() - began:.0f} s")
    good = [shape for shape, cost in zip(shapes, costs, strict=True) if cost <= FAILED]
    report(f"{len(good)} of {config.animals} fits are good; median cost {float(np.median(costs)):.3f}")
    if len(good) < 2:
        raise UserError(f"{folder}: expected 2 good fits or more, got {len(good)}: ask for more animals.")
    return torch.stack(good)
