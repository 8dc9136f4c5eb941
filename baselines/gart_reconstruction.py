"""What GART and GART* leave behind: Gaussians at rest, skinning weights and a pose for every frame."""

from collections.abc import Sequence
from pathlib import Path

import torch
from torch import Tensor

from rewild4d.baselines.common.saved import Root, save_state, splats_of
from rewild4d.baselines.gart_config import GartConfig, GartStarConfig
from rewild4d.baselines.gart_refine import refine_moments
from rewild4d.baselines.gart_skeleton import PoseTable
from rewild4d.baselines.gart_skinning import posed
from rewild4d.contracts import Log
from rewild4d.ours.canonical import Gaussians
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
        """Return the Gaussians at a time in seconds in the world; between frames the joints' rotations slerp."""
        position = self.root.position(time)
        shape = posed(self.gaussians, self.weights, *self.poses.between(position))
        return self.root.in_world(splats_of(self.gaussians, *shape), position)

    def camera(self, time: float) -> Camera | None:
        """Return the input camera of the frame nearest to a time."""
        return self.root.camera(time)

    def canonical(self) -> Splats:
        """Return the Gaussians at rest, in the object frame; `weights` belong to the same rows."""
        return self.gaussians.splats()

    def diagnostics(self) -> dict[str, float]:
        """Return how many Gaussians there are, how opaque, and how far poses went from the prior's."""
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
        save_state(folder, state, self.config)


class GartStarReconstruction(GartReconstruction):
    """The same of `gart-star`.

    Attributes:
        marks: what every table has to say of it.
    """

    marks: tuple[str, ...] = ()

    def refined(self, frames: Sequence[Frame], log: Log) -> "GartStarReconstruction":
        """With poses of held-out frames of the input view fitted to those frames; see contracts.Reconstruction."""
        assert isinstance(self.config, GartStarConfig)
        poses, root = refine_moments(self.gaussians, self.weights, self.poses, self.root, frames, self.config, log)
        found = GartStarReconstruction(self.gaussians, self.weights, poses, self.config, root)
        found.marks = (SEEN,)
        return found
