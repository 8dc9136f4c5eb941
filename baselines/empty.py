"""The lower bound of every score: a reconstruction without Gaussians."""

from pathlib import Path
from typing import Any

import torch

from rewild4d.baselines.floors_config import EMPTY_INFO, EmptyConfig
from rewild4d.contracts import Log
from rewild4d.types import Camera, Clip, Prior, Splats


class EmptyReconstruction:
    """No Gaussians at any time."""

    def at(self, time: float) -> Splats:
        return Splats(torch.zeros(0, 3), torch.zeros(0, 4), torch.zeros(0, 3), torch.zeros(0), torch.zeros(0, 1, 3))

    def camera(self, time: float) -> Camera | None:
        return None

    def save(self, folder: Path) -> None:
        (folder / "empty.txt").write_text("no Gaussians\n")


class Empty:
    """A method that renders the background alone: on white, its scores are high where the animal is small."""

    info = EMPTY_INFO
    Config = EmptyConfig

    def fit(
        self, clip: Clip, prior: Prior, *, config: Any, seed: int, device: torch.device, log: Log, workdir: Path | None
    ) -> EmptyReconstruction:
        return EmptyReconstruction()

    def load(self, folder: Path, device: torch.device) -> EmptyReconstruction:
        return EmptyReconstruction()
