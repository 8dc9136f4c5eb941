"""Train the network on rounds of fresh random animals, with a learning curve and a checkpoint from which it goes on."""

import json
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import msgspec
import numpy as np
import torch
from torch import Tensor
from torch.utils.data import DataLoader, Dataset

from rewild4d.files import atomic
from rewild4d.priors.learned.examples import draw_sequences
from rewild4d.priors.learned.going_on import read_checkpoint, warmth
from rewild4d.priors.learned.network import PointNetwork, found, loss
from rewild4d.priors.learned.pictures import Examples, joined
from rewild4d.priors.learned.weights import save_weights

ANIMALS = 8
"""Animals of a round: each has `CLIPS` sequences, which are seen plain and in a mirror."""
BATCH = 16
"""Sequences of a step."""
REPEATS = 2
"""How often the sequences of a round are gone through: a step takes less time than drawing what it learns from."""
LEARNING_RATE, WEIGHT_DECAY = 1e-3, 0.02
"""Of AdamW, the first at its highest."""
WARMUP = 200
"""Steps over which the learning rate rises."""
COOLING = 0.3
"""Last share of the steps, over which it falls to a hundredth."""
AVERAGE = 0.998
"""Decay of the running mean of the weights, which is what is kept."""
STREAM = 3881
"""Start of every seed here, so that no animal is one of the zoo's seeds."""
EVERY = 20
"""Rounds between measurements, each of which writes the checkpoint."""
CHECKED = 12
"""Animals that measure the error; drawn from numbers that no round uses."""


class TrainingConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Settings of a training.

    Attributes:
        rounds: of `ANIMALS` animals.
        seed: of all animals and of the weights.
    """

    rounds: int = 2000
    seed: int = 0


@dataclass(frozen=True)
class _Animals(Dataset[Examples]):
    """Sequences of the animal of each number."""

    seed: int
    numbers: range

    def __len__(self) -> int:
        return len(self.numbers)

    def __getitem__(self, row: int) -> Examples:
        torch.set_num_threads(1)
        return draw_sequences(np.random.default_rng((STREAM, self.seed, 1, self.numbers[row])))


@dataclass
class Training:
    """What a training has done.

    Attributes:
        network: its weights now.
        mean: running mean of its weights.
        optimizer: its state.
        round: rounds done.
        curve: a row for each measurement: round, seconds, loss of training, errors across and along the view.
    """

    network: PointNetwork
    mean: PointNetwork
    optimizer: torch.optim.Optimizer
    round: int
    curve: list[dict[str, float]]


def train(folder: Path, config: TrainingConfig, *, workers: int, report: Callable[[str], None]) -> Path:
    """Train, or go on from the folder's checkpoint, until all rounds are done.

    Args:
        folder: for checkpoint.pt, curve.json and weights.safetensors.
        config: settings; those of a checkpoint must be the same.
        workers: processes that draw animals.
        report: called with a line for each measurement.

    Returns:
        The file of weights.

    Raises:
        UserError: the folder has the checkpoint of other settings.
    """
    torch.manual_seed(config.seed)
    progress = _resumed(folder, config)
    checked = joined([draw_sequences(np.random.default_rng((STREAM, config.seed, 0, k))) for k in range(CHECKED)])
    first = progress.round * ANIMALS
    animals = _Animals(config.seed, range(first, config.rounds * ANIMALS))
    loader = DataLoader(animals, batch_size=ANIMALS, collate_fn=joined, num_workers=workers,
                        prefetch_factor=4 if workers else None)  # fmt: skip
    began = time.monotonic() - (progress.curve[-1]["seconds"] if progress.curve else 0.0)
    losses: list[float] = []
    for batch in loader:
        losses.append(_round(progress, batch, config))
        progress.round += 1
        if progress.round % EVERY == 0 or progress.round == config.rounds:
            row = {"round": progress.round, "seconds": time.monotonic() - began, "loss": float(np.mean(losses))}
            progress.curve.append(row | measured(progress.mean, checked))
            losses.clear()
            _save(progress, folder, config)
            report("  ".join(f"{name} {value:.4g}" for name, value in progress.curve[-1].items()))
    return folder / "weights.safetensors"


def _round(progress: Training, animals: Examples, config: TrainingConfig) -> float:
    """Take a step for each batch of the round's sequences, plain and mirrored; return the mean loss."""
    generator = torch.Generator().manual_seed(1000 * config.seed + progress.round)
    both = joined([animals, animals.mirrored()])
    order = torch.cat([torch.randperm(len(both.known), generator=generator) for _ in range(REPEATS)])
    steps = len(order) // BATCH
    losses = []
    for index, rows in enumerate(order.split(BATCH)):
        step = progress.round * steps + index
        for group in progress.optimizer.param_groups:
            group["lr"] = LEARNING_RATE * warmth(step, config.rounds * steps, warmup=WARMUP, cooling=COOLING)
        value = loss(found(progress.network, both.chosen(rows)), both.points[rows])
        progress.optimizer.zero_grad()
        value.backward()  # type: ignore[no-untyped-call]
        torch.nn.utils.clip_grad_norm_(progress.network.parameters(), 1.0)
        progress.optimizer.step()
        losses.append(float(value.detach()))
        _average(progress.mean, progress.network, min(AVERAGE, (1 + step) / (10 + step)))
    return float(np.mean(losses))


@torch.no_grad()
def _average(mean: PointNetwork, network: PointNetwork, decay: float) -> None:
    torch._foreach_lerp_(list(mean.parameters()), list(network.parameters()), 1 - decay)


@torch.no_grad()
def measured(network: PointNetwork, examples: Examples) -> dict[str, float]:
    """Return mean errors across and along the view, in halves of the crop, where cameras are known and not."""
    network.eval()
    parts = [found(network, examples.chosen(rows)).points for rows in torch.arange(len(examples.known)).split(BATCH)]
    away = (torch.cat(parts) - examples.points).abs()
    row: dict[str, float] = {}
    for name, rows in (("known", examples.known), ("unknown", ~examples.known)):
        if rows.any():
            row |= {f"{name}_across": _mean(away[rows][..., :2]), f"{name}_along": _mean(away[rows][..., 2])}
    network.train()
    return row


def _mean(values: Tensor) -> float:
    return float(values.mean())


def _resumed(folder: Path, config: TrainingConfig) -> Training:
    network, mean = PointNetwork(), PointNetwork()
    network = network.to(memory_format=torch.channels_last)  # type: ignore[call-overload]
    mean.load_state_dict(network.state_dict())
    optimizer = torch.optim.AdamW(network.parameters(), lr=LEARNING_RATE, weight_decay=WEIGHT_DECAY)
    progress = Training(network, mean, optimizer, 0, [])
    kept = read_checkpoint(folder / "checkpoint.pt", config)
    if kept is None:
        return progress
    network.load_state_dict(kept["network"])
    mean.load_state_dict(kept["mean"])
    optimizer.load_state_dict(kept["optimizer"])
    return replace(progress, round=kept["round"], curve=kept["curve"])


def _save(progress: Training, folder: Path, config: TrainingConfig) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    kept = {
        "config": msgspec.to_builtins(config), "network": progress.network.state_dict(),
        "mean": progress.mean.state_dict(), "optimizer": progress.optimizer.state_dict(),
        "round": progress.round, "curve": progress.curve,
    }  # fmt: skip
    with atomic(folder / "checkpoint.pt") as scratch:
        torch.save(kept, scratch)
    with atomic(folder / "curve.json") as scratch:
        scratch.write_text(json.dumps(progress.curve, indent=1))
    save_weights(progress.mean, folder / "weights.safetensors")
