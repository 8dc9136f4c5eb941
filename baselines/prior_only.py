"""The prior alone: its posed surface as Gaussians, coloured from the frames (the paper's Fauna row)."""

from dataclasses import asdict
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from rewild4d.baselines.floors_config import PRIOR_ONLY_INFO, PriorOnlyConfig
from rewild4d.contracts import Log
from rewild4d.files import load_tensors, save_tensors
from rewild4d.foreign.states import read_as
from rewild4d.priors.io import load_prior, save_prior
from rewild4d.priors.motion import (
    SurfaceSample,
    colors_from_frames,
    pose_at,
    pose_gaussians,
    quats_from_normals,
    sample_surface,
    world_camera,
)
from rewild4d.transforms import transform_splats
from rewild4d.types import Camera, Clip, Prior, Splats


class PriorOnlyReconstruction:
    """A posed, coloured template (contracts.Articulated)."""

    def __init__(
        self, prior: Prior, sample: SurfaceSample, colors: Tensor, cameras: dict[float, Camera], thickness: float
    ):
        self.prior, self.sample, self.colors, self.cameras = prior, sample, colors, cameras
        self.thickness = thickness
        self.quats = quats_from_normals(sample.normals)
        self.scales = sample.radius * torch.tensor((1.0, 1.0, thickness)).expand(len(colors), 3)
        self.weights, self.pivots, self.parents = sample.weights, prior.bones[:, 0], prior.parents

    def at(self, time: float) -> Splats:
        object_to_world, transforms = pose_at(self.prior, time)
        return transform_splats(
            pose_gaussians(self.sample, self.quats, self.scales, self.colors, transforms), object_to_world
        )

    def camera(self, time: float) -> Camera | None:
        """Return the input camera at a time, in the world; without an input frame there, the prior's."""
        return self.cameras.get(time) or world_camera(self.prior, time)

    def canonical(self) -> Splats:
        """Return the Gaussians at rest, in the object frame."""
        rest = torch.eye(4).expand(len(self.parents), 4, 4)
        return pose_gaussians(self.sample, self.quats, self.scales, self.colors, rest)

    def articulation(self, time: float) -> tuple[Tensor, Tensor]:
        """Return rest -> posed transforms, [J, 4, 4], and object_to_world, [4, 4]."""
        object_to_world, transforms = pose_at(self.prior, time)
        return transforms, object_to_world

    def save(self, folder: Path) -> None:
        save_prior(self.prior, folder / "prior.npz")
        state = {
            "sample": asdict(self.sample),
            "colors": self.colors,
            "thickness": self.thickness,
            "cameras": {time: (c.world_to_camera, c.intrinsics, c.width, c.height) for time, c in self.cameras.items()},
        }
        save_tensors(state, folder / "surface.pt")


class PriorOnly:
    """The lower bound of methods that start from the prior."""

    info = PRIOR_ONLY_INFO
    Config = PriorOnlyConfig

    def fit(
        self, clip: Clip, prior: Prior, *, config: Any, seed: int, device: torch.device, log: Log, workdir: Path | None
    ) -> PriorOnlyReconstruction:
        sample = sample_surface(prior, config.gaussians, torch.Generator().manual_seed(seed))
        colors = colors_from_frames(prior, sample, clip.frames)
        cameras = {frame.time: frame.camera for frame in clip.frames if frame.camera is not None}
        return PriorOnlyReconstruction(prior, sample, colors, cameras, config.thickness)

    def load(self, folder: Path, device: torch.device) -> PriorOnlyReconstruction:
        state = load_tensors(folder / "surface.pt")
        with read_as(folder, "prior-only"):
            cameras = {time: Camera(*values) for time, values in state["cameras"].items()}
            prior, sample = load_prior(folder / "prior.npz"), SurfaceSample(**state["sample"])
            return PriorOnlyReconstruction(prior, sample, state["colors"], cameras, state["thickness"])
