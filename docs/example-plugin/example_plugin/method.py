"""A method: one Gaussian in the animal's mean colour that follows the prior."""

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import msgspec
import torch
from torch import Tensor

from rewild4d.contracts import Log, MethodInfo
from rewild4d.errors import UserError
from rewild4d.files import load_tensors, save_tensors
from rewild4d.transforms import split_similarity
from rewild4d.types import OBJECT_DIAGONAL, Camera, Clip, Prior, Splats


class BlobConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Settings; each is a flag of `run`."""

    size: float = 0.15
    """Standard deviation of the Gaussian over the animal's diagonal."""


@dataclass(frozen=True)
class BlobReconstruction:
    """One Gaussian that moves (contracts.Reconstruction).

    Attributes:
        times: seconds, [T].
        centers: in the world, [T, 3].
        scale: standard deviation, world units.
        color: RGB in [0, 1], [3].
    """

    times: Tensor
    centers: Tensor
    scale: float
    color: Tensor

    def at(self, time: float) -> Splats:
        row = int((self.times - time).abs().argmin())
        turned = torch.tensor([[1.0, 0.0, 0.0, 0.0]])
        return Splats(
            self.centers[row : row + 1], turned, torch.full((1, 3), self.scale), torch.tensor([0.95]),
            self.color[None, None],
        )  # fmt: skip

    def camera(self, time: float) -> Camera | None:
        return None  # the data set knows it

    def save(self, folder: Path) -> None:
        save_tensors(asdict(self), folder / "blob.pt")


class Blob:
    """One Gaussian (contracts.Method)."""

    info = MethodInfo(title="one Gaussian", paper="", licence="MIT", description="Follows the middle of the prior")
    Config = BlobConfig

    def fit(
        self, clip: Clip, prior: Prior, *, config: Any, seed: int, device: torch.device, log: Log, workdir: Path | None
    ) -> BlobReconstruction:
        for frame in clip.frames:
            if not frame.mask.any():
                raise UserError(f"{clip.name}: expected an animal in every frame, got none at {frame.time:.4f} s.")
        middle = torch.cat((prior.vertices.double().mean(0), torch.ones(1)))
        centers = (prior.object_to_world.double() @ middle)[:, :3].float()
        scale = float(split_similarity(prior.object_to_world[0].double())[0]) * OBJECT_DIAGONAL * config.size
        color = sum(frame.rgb.sum((1, 2)) for frame in clip.frames) / sum(frame.mask.sum() for frame in clip.frames)
        return BlobReconstruction(prior.times, centers, scale, torch.as_tensor(color))

    def load(self, folder: Path, device: torch.device) -> BlobReconstruction:
        return BlobReconstruction(**load_tensors(folder / "blob.pt"))
