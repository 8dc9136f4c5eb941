"""What trainings share: files that are made once, a learning rate that warms up and cools down, and checkpoints."""

import pickle
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import torch
from torch.utils.data import DataLoader, Dataset

from rewild4d.errors import UserError
from rewild4d.files import atomic

Arrays = dict[str, np.ndarray]


class _Files(Dataset[Path]):
    """Asking for a file makes it where it is not there."""

    def __init__(self, paths: Sequence[Path], make: Callable[[int], Arrays]) -> None:
        self.paths, self.make = paths, make

    def __len__(self) -> int:
        return len(self.paths)

    def __getitem__(self, row: int) -> Path:
        path = self.paths[row]
        if not path.is_file():
            torch.set_num_threads(1)
            arrays = self.make(row)
            with atomic(path) as scratch, scratch.open("wb") as file:
                np.savez_compressed(file, **arrays)  # type: ignore[arg-type]
        return path


def making(paths: Sequence[Path], make: Callable[[int], Arrays], workers: int) -> Iterator[tuple[int, float]]:
    """Make the npz files that are not there yet, one after another in ``workers`` processes; 0 makes them in this one.

    Args:
        paths: of the files, all in one folder.
        make: returns the arrays of a file, by its index.
        workers: processes.

    Yields:
        How many files there are, and the seconds so far.
    """
    paths[0].parent.mkdir(parents=True, exist_ok=True)
    began = time.monotonic()
    for count, _ in enumerate(DataLoader(_Files(paths, make), batch_size=None, num_workers=workers), start=1):
        yield count, time.monotonic() - began


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
