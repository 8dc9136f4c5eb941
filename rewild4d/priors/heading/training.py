"""Train the network of headings: draw pictures of random animals, then go through them in epochs.

Both halves go on where they were stopped, and the result is the same as without the stop.
"""

import json
import math
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path

import msgspec
import numpy as np
import torch
from torch import Tensor

from rewild4d.files import atomic
from rewild4d.priors.heading.augmentation import augmented
from rewild4d.priors.heading.examples import drawn
from rewild4d.priors.heading.network import HeadingNetwork, likeliest, log_shares, shares_around, wrapped
from rewild4d.priors.heading.pictures import Pictures, from_bytes, joined
from rewild4d.priors.heading.weights import FILE
from rewild4d.priors.learned.going_on import Arrays, making, read_checkpoint, warmth
from rewild4d.priors.learned.weights import read_weights, save_weights

PART = 16
"""Animals of a file of pictures."""
CHECKED = 0.05
"""Share of the parts that measure the error and are not learned from."""
BATCH = 128
LEARNING_RATE, WEIGHT_DECAY = 2e-3, 0.02
"""Of AdamW, the first at its highest."""
GOING_ON = 0.25
"""Share of that learning rate for weights that have learned before."""
WARMUP = 200
"""Steps over which the learning rate rises."""
COOLING = 0.5
"""Last share of the steps, over which it falls to a hundredth."""
BLIND = 0.25
"""Share of the pictures that are shown without their brightness."""
STREAM = 7781
"""Start of every seed here, so that no animal is one of the zoo's seeds."""


class TrainingConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Settings of a training.

    Attributes:
        animals: to learn from.
        epochs: how often their pictures are gone through.
        seed: of the animals and of the weights.
        two_legged: share of the animals that have two legs.
        start: file of weights to start from; new ones where it is empty.
        augment: whether parts of animals are stretched, and pictures bent and lit anew (`augmentation`).
    """

    animals: int = 1600
    epochs: int = 10
    seed: int = 0
    two_legged: float = 0.0
    start: str = ""
    augment: bool = False


def train(folder: Path, config: TrainingConfig, *, workers: int, report: Callable[[str], None]) -> Path:
    """Draw what is missing, then train, or go on from the folder's checkpoint, until all epochs are done.

    Args:
        folder: for pictures/, checkpoint.pt, curve.json and weights.safetensors.
        config: settings; those of a checkpoint must be the same.
        workers: processes that draw animals.
        report: called with a line for each epoch, and now and then while pictures are drawn.

    Returns:
        The file of weights.

    Raises:
        UserError: the folder has the checkpoint of other settings, or the weights to start from cannot be read.
    """
    torch.manual_seed(config.seed)
    progress = _Progress(folder, config)
    parts = _drawn(folder / "pictures", config, workers, report)
    checked = max(1, round(CHECKED * len(parts)))
    known, given = (joined([_read(path) for path in some]) for some in (parts[:checked], parts[checked:] or parts))
    while progress.epoch < config.epochs:
        began, rows = time.monotonic(), torch.Generator().manual_seed(1000 * config.seed + progress.epoch)
        value = progress.run(given, rows)
        row = {"epoch": progress.epoch, "loss": value, **measured(progress.network, known)}
        progress.keep(row | {"seconds": time.monotonic() - began})
        report("  ".join(f"{name} {figure:.4g}" for name, figure in progress.curve[-1].items()))
    save_weights(progress.network, folder / FILE)
    return folder / FILE


def _drawn(folder: Path, config: TrainingConfig, workers: int, report: Callable[[str], None]) -> list[Path]:
    paths = [folder / f"{config.seed}-{row:05d}.npz" for row in range(math.ceil(config.animals / PART))]
    for count, seconds in making(paths, partial(_part, config), workers):
        if count % 20 == 0:
            report(f"drawn {count * PART} of {config.animals} animals, {seconds:.0f} s")
    return paths


def _part(config: TrainingConfig, row: int) -> Arrays:
    numbers = range(row * PART, min((row + 1) * PART, config.animals))
    streams = [np.random.default_rng((STREAM, config.seed, number)) for number in numbers]
    made = joined([drawn(stream, config.two_legged, stretched=config.augment) for stream in streams])
    return {name: value.numpy() for name, value in vars(made).items()}


def _read(path: Path) -> Pictures:
    with np.load(path) as kept:
        return Pictures(*(torch.from_numpy(kept[name]) for name in ("shown", "azimuths", "cameras")))


class _Progress:
    """A network, its optimizer and what has been done."""

    def __init__(self, folder: Path, config: TrainingConfig) -> None:
        self.folder, self.config = folder, config
        self.network, self.epoch = HeadingNetwork(), 0
        self.optimizer = torch.optim.AdamW(self.network.parameters(), lr=LEARNING_RATE, weight_decay=WEIGHT_DECAY)
        self.curve: list[dict[str, float]] = []
        kept = read_checkpoint(folder / "checkpoint.pt", config)
        self.rate = LEARNING_RATE * (GOING_ON if config.start else 1.0)
        if kept is None:
            if config.start:
                read_weights(self.network, Path(config.start))
            return
        self.network.load_state_dict(kept["network"])
        self.optimizer.load_state_dict(kept["optimizer"])
        self.epoch, self.curve = kept["epoch"], kept["curve"]

    def run(self, given: Pictures, rows: torch.Generator) -> float:
        """Go through all pictures once in random order; return the mean loss."""
        batches = torch.randperm(len(given), generator=rows).split(BATCH)
        total, losses = self.config.epochs * len(batches), []
        torch.manual_seed(1000 * self.config.seed + self.epoch)  # of the dropout
        self.network.train()
        for index, chosen in enumerate(batches):
            step = self.epoch * len(batches) + index
            for group in self.optimizer.param_groups:
                group["lr"] = self.rate * warmth(step, total, warmup=WARMUP, cooling=COOLING)
            shown = given.chosen(chosen)
            shown = shown.mirrored(torch.rand(len(shown), generator=rows) < 0.5)
            pictures = from_bytes(shown.shown)
            blind = torch.rand(len(shown), generator=rows) < BLIND
            if self.config.augment:
                pictures = augmented(pictures, rows)
            pictures[blind, 1] = 0
            value = _loss(self.network, pictures, shown)
            self.optimizer.zero_grad()
            value.backward()  # type: ignore[no-untyped-call]
            self.optimizer.step()
            losses.append(float(value.detach()))
        self.epoch += 1
        return float(np.mean(losses))

    def keep(self, row: dict[str, float]) -> None:
        """Add a row to the curve and write the checkpoint."""
        self.curve.append(row)
        kept = {
            "config": msgspec.to_builtins(self.config), "network": self.network.state_dict(),
            "optimizer": self.optimizer.state_dict(), "epoch": self.epoch, "curve": self.curve,
        }  # fmt: skip
        with atomic(self.folder / "checkpoint.pt") as scratch:
            torch.save(kept, scratch)
        with atomic(self.folder / "curve.json") as scratch:
            scratch.write_text(json.dumps(self.curve, indent=1))


def _loss(network: HeadingNetwork, pictures: Tensor, shown: Pictures) -> Tensor:
    return -(shares_around(shown.azimuths) * network(pictures, shown.cameras)).sum(1).mean()


def measured(network: HeadingNetwork, known: Pictures) -> dict[str, float]:
    """Return the median error in degrees, and the share of pictures with one of more than 90 degrees."""
    network.eval()
    found = [
        likeliest(log_shares(network, from_bytes(known.shown[rows]), known.cameras[rows]))
        for rows in torch.arange(len(known)).split(512)
    ]
    away = wrapped(torch.cat(found) - known.azimuths).abs().rad2deg()
    return {"degrees": float(away.median()), "reversed": float((away > 90).float().mean())}
