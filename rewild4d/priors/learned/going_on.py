"""What trainings of networks share: a learning rate that warms up and cools down, and checkpoints to go on from."""

import pickle
from pathlib import Path
from typing import Any

import msgspec
import torch

from rewild4d.errors import UserError


def warmth(step: int, total: int, *, warmup: int, cooling: float) -> float:
    """Return the learning rate of a step as a share of the highest.

    It rises over ``warmup`` steps, and over the last share ``cooling`` of ``total`` steps falls to a hundredth.
    """
    left = min(1.0, (1 - step / total) / cooling)
    return min(1.0, (step + 1) / warmup) * max(left, 0.01)


def read_checkpoint(path: Path, config: msgspec.Struct) -> dict[str, Any] | None:
    """Return a training's checkpoint, None where there is none.

    Raises:
        UserError: it cannot be read, or is of other settings.
    """
    if not path.is_file():
        return None
    try:
        kept: dict[str, Any] = torch.load(path, weights_only=True)
    except (OSError, RuntimeError, EOFError, pickle.UnpicklingError) as error:
        raise UserError(f"{path}: expected a checkpoint of a training, but it cannot be read; remove it.") from error
    if kept["config"] != msgspec.to_builtins(config):
        raise UserError(f"{path}: expected a training with {msgspec.to_builtins(config)}, got {kept['config']}.")
    return kept
