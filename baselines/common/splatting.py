"""Train Gaussian competitors: rendering, image losses, opacity resets, a resumable loop.

What a competitor has in common with `ours` (canonical Gaussians, steps, density control, image losses, checkpoints) is
the code of rewild4d.ours, so that scores differ by the methods alone.
"""

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import torch
from torch import Tensor
from torch.optim import Optimizer

from rewild4d.baselines.common.splatting_config import ImageLoss, SplatConfig
from rewild4d.contracts import Log
from rewild4d.ours.canonical import Gaussians, attributes, start_surface
from rewild4d.ours.checkpoint import load_checkpoint
from rewild4d.ours.config import Canonical
from rewild4d.ours.losses.images import WINDOW, colour_losses, silhouette_loss, union_window
from rewild4d.ours.symmetry import Key, Target
from rewild4d.ours.training import GaussianTraining, run_steps
from rewild4d.priors.motion import colors_from_frames, pose_gaussians, quats_from_normals
from rewild4d.rasterizer import RasterInfo, rasterize
from rewild4d.types import Camera, Clip, Prior

STATE = "state.pt"
"""File of a saved reconstruction's state."""


class Shape(NamedTuple):
    """Gaussians at one time: centres [n, 3], unit orientations [n, 4], standard deviations [n, 3]."""

    means: Tensor
    quats: Tensor
    scales: Tensor


def render(own: Gaussians, shape: Shape, camera: Camera, degree: int) -> tuple[Tensor, Tensor, RasterInfo]:
    """Render posed Gaussians.

    Args:
        own: opacities and colours.
        shape: posed.
        camera: in the same frame of reference.
        degree: of the harmonics in use.

    Returns:
        Colour premultiplied [3, h, w], matte [1, h, w], the rasterizer's info.
    """
    image, alpha, info = rasterize(
        *shape, own.opacities(), own.seen_rgb(shape.means, shape.quats, camera.center, degree),
        camera.world_to_camera[None], camera.intrinsics[None], camera.width, camera.height,
    )  # fmt: skip
    return image[0], alpha[0], info


def image_losses(
    rgb: Tensor, alpha: Tensor, target: Target, background: Tensor, weights: ImageLoss
) -> dict[str, Tensor]:
    """Compute the weighted losses of a render.

    Args:
        rgb: colour premultiplied, [3, h, w].
        alpha: matte, [1, h, w].
        target: image and matte that it is compared with.
        background: colour behind both, [3].
        weights: of the losses.
    """
    window = union_window([alpha, target.mask], WINDOW - 1)
    l1, dissimilarity = colour_losses(rgb, alpha, target, background, window)
    losses = {"l1": weights.l1 * l1, "ssim": weights.ssim * dissimilarity}
    if weights.silhouette:
        losses["silhouette"] = weights.silhouette * silhouette_loss(alpha, target, window)
    return losses


class SplatTraining(GaussianTraining):
    """One fit with image losses and opacity resets."""

    config: SplatConfig

    @property
    def total(self) -> int:
        """Number of steps."""
        return self.config.iterations

    def step(self, index: int) -> dict[str, float]:
        """Take one step, then reset opacities where the schedule says so; return the figures for the log."""
        figures = super().step(index)
        resets, total = self.config.resets, self.config.iterations
        if resets.every and index < resets.until * total and (index + 1) % max(1, round(resets.every * total)) == 0:
            reset_opacities(self.gaussians, self.optimizer, resets.opacity)
        return figures

    def render(self, shape: Shape, target: Target, progress: float) -> tuple[Tensor, Tensor, RasterInfo]:
        """Render a view with the harmonics in use at ``progress``; see `render`."""
        canonical = self.config.canonical
        degree = min(canonical.sh_degree, int(progress / canonical.sh_every))
        return render(self.gaussians, shape, target.camera, degree)

    def draw(self, mirrored: float) -> Key:
        """Draw one of the frames of the plain sequence, or in a share of the draws its mirror image, at time -t."""
        frames = self.supervision.frames_of(1) or list(range(self.supervision.frames))
        frame = frames[int(torch.randint(len(frames), (), generator=self.generator))]
        flip = mirrored and float(torch.rand((), generator=self.generator)) < mirrored
        return Key(1, -1 if flip else 1, frame)

    def image_losses(self, rgb: Tensor, alpha: Tensor, target: Target) -> dict[str, Tensor]:
        """Compute `image_losses` over the background that the settings ask for."""
        drawn = self.config.loss.random_background
        background = torch.rand(3, generator=self.generator).to(rgb) if drawn else rgb.new_ones(3)
        return image_losses(rgb, alpha, target, background, self.config.loss)

    def state(self) -> dict[str, Any]:
        return super().state() | {"generator": self.generator.get_state()}

    def restore(self, state: Mapping[str, Any]) -> None:
        super().restore(state)
        self.generator.set_state(state["generator"])


def run_training(training: SplatTraining, identity: str, log: Log, workdir: Path | None) -> None:
    """Take all steps of a fit; a checkpoint of the same fit in ``workdir`` is continued."""
    start = 0
    if saved := load_checkpoint(workdir, identity):
        start = saved["step"]
        training.restore(saved["training"])

    def state() -> dict[str, Any]:
        return {"training": training.state()}

    every = training.config.checkpoint_every
    run_steps(training.step, range(start, training.total), every, identity, state, log, workdir)
    training.gaussians.blur.fill_(training.supervision.missing_blur())


@torch.no_grad()
def reset_opacities(gaussians: Gaussians, optimizer: Optimizer, opacity: float) -> None:
    """Lower every opacity to at most ``opacity`` and zero its Adam moments."""
    logits = gaussians.logit_opacities
    logits.clamp_(max=math.log(opacity / (1 - opacity)))
    for name in ("exp_avg", "exp_avg_sq"):
        if name in optimizer.state[logits]:
            optimizer.state[logits][name].zero_()


def surface_gaussians(
    prior: Prior, clip: Clip, transforms: Tensor | None, config: Canonical, generator: torch.Generator
) -> dict[str, Tensor]:
    """Place flat Gaussians on the prior's surface, coloured from the frames, as `prior-only` renders them.

    Args:
        prior: its rest surface is sampled, area-uniformly.
        clip: its frames give the colours.
        transforms: pose of the surface, [J, 4, 4]; None for the rest pose.
        config: number, thickness and opacity.
        generator: the only source of randomness.

    Returns:
        The five attributes of `Gaussians` by name.
    """
    sample = start_surface(prior, config, generator)
    rest = torch.eye(4).expand(len(prior.parents), 4, 4) if transforms is None else transforms
    scales = sample.radius * torch.tensor((1.0, 1.0, config.thickness)).expand(len(sample.points), 3)
    rgb = colors_from_frames(prior, sample, clip.frames)
    splats = pose_gaussians(sample, quats_from_normals(sample.normals), scales, rgb, rest)
    return attributes(splats.means, splats.quats, scales.log(), rgb, config)
