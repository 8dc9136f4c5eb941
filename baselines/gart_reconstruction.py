"""Reconstructions by GART and GART*: canonical Gaussians, skinning weights and a pose for every frame."""

from collections.abc import Sequence
from pathlib import Path

import torch
from torch import Tensor

from rewild4d.baselines.common.splatting import STATE
from rewild4d.baselines.gart_config import GartConfig, GartStarConfig
from rewild4d.baselines.gart_refine import refine_held_out
from rewild4d.baselines.gart_skeleton import PoseTable
from rewild4d.baselines.gart_skinning import posed
from rewild4d.contracts import Log
from rewild4d.ours.canonical import Gaussians
from rewild4d.ours.checkpoint import save_fitted
from rewild4d.ours.motion import Root
from rewild4d.types import Camera, Frame, Splats

SEEN = "has seen the test image: the poses of held-out frames were fitted to those frames"


class GartReconstruction:
    """A fitted model with its frame of reference (contracts.Reconstruction).

    Attributes:
        gaussians: canonical, in the object frame.
        weights: their skinning weights, [n, J].
        poses: of the frames.
    """

    def __init__(self, gaussians: Gaussians, weights: Tensor, poses: PoseTable, config: GartConfig, root: Root) -> None:
        self.gaussians, self.poses = gaussians.requires_grad_(False), poses.requires_grad_(False)
        self.weights, self.config, self.root = weights, config, root

    @torch.no_grad()
    def at(self, time: float) -> Splats:
        """Return the Gaussians at a time in seconds in the world; poses are interpolated between frames."""
        position = self.root.position(time)
        shape = posed(self.gaussians, self.weights, *self.poses.between(position))
        return self.root.in_world(self.gaussians.splats_at(*shape), position)

    def camera(self, time: float) -> Camera | None:
        """Return the input camera at a time, in the world; between frames it interpolates."""
        return self.root.camera(time)

    def canonical(self) -> Splats:
        """Return the Gaussians at rest, in the object frame; `weights` belong to the same rows."""
        return self.gaussians.splats()

    def diagnostics(self) -> dict[str, float]:
        """Return the number of Gaussians, their mean opacity and the mean rotation of joints against the prior's."""
        return {
            "gaussians": float(len(self.gaussians)),
            "opacity_mean": float(self.gaussians.opacities().mean()),
            "turn_mean_degrees": float(torch.rad2deg(self.poses.turns.norm(dim=-1)).mean()),
        }

    def save(self, folder: Path) -> None:
        """Write the state and the settings into an existing, empty folder."""
        model = {f"gaussians.{name}": value for name, value in self.gaussians.state_dict().items()}
        state = {
            "model": model, "weights": self.weights, "poses": self.poses.state_dict(),
            "parents": self.poses.parents, "root": self.root.state(),
        }  # fmt: skip
        save_fitted(folder, STATE, state, self.config)


class GartStarReconstruction(GartReconstruction):
    """A reconstruction by `gart-star`.

    Attributes:
        marks: printed with its rows in every table.
    """

    marks: tuple[str, ...] = ()

    def refined(self, frames: Sequence[Frame], log: Log) -> "GartStarReconstruction":
        """Fit poses of held-out frames of the input view to those frames; see contracts.Reconstruction."""
        assert isinstance(self.config, GartStarConfig)
        poses, root = refine_held_out(self.gaussians, self.weights, self.poses, self.root, frames, self.config, log)
        found = GartStarReconstruction(self.gaussians, self.weights, poses, self.config, root)
        found.marks = (SEEN,)
        return found
