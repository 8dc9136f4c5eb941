"""Learn where shapes lie: draw random animals, fit the template to each, keep their mean and covariance.

A run that was stopped goes on with the animals that are missing, and its result is the same.
"""

from collections.abc import Callable
from functools import partial
from pathlib import Path

import msgspec
import numpy as np
import torch
from sklearn.covariance import LedoitWolf
from torch import Tensor

from rewild4d.errors import UserError
from rewild4d.priors.learned.going_on import Arrays, making
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
    save_density(density_of(samples), folder / FILE)
    return folder / FILE


def _fitted(folder: Path, config: TrainingConfig, workers: int, report: Callable[[str], None]) -> Tensor:
    paths = [folder / f"{config.seed}-{row:05d}.npz" for row in range(config.animals)]
    for count, seconds in making(paths, partial(_sample, config), workers):
        if count % TOLD == 0:
            report(f"fitted {count} of {config.animals} animals, {seconds:.0f} s")
    shapes, costs = zip(*map(_read, paths), strict=True)
    good = [shape for shape, cost in zip(shapes, costs, strict=True) if cost <= FAILED]
    report(f"{len(good)} of {config.animals} fits are good; median cost {float(np.median(costs)):.3f}")
    if len(good) < 2:
        raise UserError(f"{folder}: expected 2 good fits or more, got {len(good)}: ask for more animals.")
    return torch.stack(good)


def _sample(config: TrainingConfig, row: int) -> Arrays:
    shape, cost = drawn(np.random.default_rng((STREAM, OWN + config.seed, row)))
    return {"shape": shape.numpy(), "cost": np.array(cost)}


def _read(path: Path) -> tuple[Tensor, float]:
    with np.load(path) as kept:
        return torch.from_numpy(kept["shape"]), float(kept["cost"])


def density_of(samples: Tensor) -> ShapeDensity:
    """Return the density of samples [n, D]; its covariance is drawn towards a round one as Ledoit and Wolf do."""
    values = samples.double()
    covariance = torch.from_numpy(LedoitWolf().fit(values.numpy()).covariance_)
    lower = torch.linalg.cholesky(covariance)
    whitening = torch.linalg.solve_triangular(lower, torch.eye(len(lower), dtype=torch.float64), upper=False)
    return ShapeDensity(values.mean(0).float(), whitening.float())
