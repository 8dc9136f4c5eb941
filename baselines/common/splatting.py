"""What the Gaussian competitors share: Gaussians under Adam, image losses, density control, resets, a resumable loop.

Where a competitor would do what `ours` does, it reads the same code (canonical Gaussians, density control, image
losses, checkpoints of rewild4d.ours), so that differences between methods are differences of the methods.
"""

import math
from abc import ABC, abstractmethod
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import torch
from torch import Tensor, nn

from rewild4d.baselines.common.splatting_config import ImageLoss, SplatConfig
from rewild4d.contracts import Log
from rewild4d.ours.canonical import NAMES, Gaussians
from rewild4d.ours.checkpoint import load_checkpoint, save_checkpoint
from rewild4d.ours.config import Canonical
from rewild4d.ours.density import DensityControl
from rewild4d.ours.losses.images import WINDOW, colour_losses, silhouette_loss, union_window
from rewild4d.ours.schedule import exponential
from rewild4d.ours.symmetry import Supervision, Target
from rewild4d.priors.motion import colors_from_frames, pose_gaussians, quats_from_normals, sample_surface
from rewild4d.rasterizer import RasterInfo, rasterize
from rewild4d.types import Camera, Clip, Prior

LOG_EVERY = 20


class Shape(NamedTuple):
    """Gaussians at one moment: centres [n, 3], unit orientations [n, 4], standard deviations [n, 3]."""

    means: Tensor
    quats: Tensor
    scales: Tensor


def render(own: Gaussians, shape: Shape, camera: Camera, degree: int) -> tuple[Tensor, Tensor, RasterInfo]:
    """Return one view of posed Gaussians.

    Args:
        own: opacities and colours.
        shape: where they are.
        camera: in the same frame of reference.
        degree: of the harmonics that count.

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
    """Return the weighted losses of a render.

    Args:
        rgb: colour premultiplied, [3, h, w].
        alpha: matte, [1, h, w].
        target: what it is compared with.
        background: colour behind both, [3].
        weights: of the losses.
    """
    window = union_window([alpha, target.mask], WINDOW - 1)
    l1, dissimilarity = colour_losses(rgb, alpha, target, background, window)
    losses = {"l1": weights.l1 * l1, "ssim": weights.ssim * dissimilarity}
    if weights.silhouette:
        losses["silhouette"] = weights.silhouette * silhouette_loss(alpha, target, window)
    return losses


class SplatTraining(ABC):
    """The loop's body; a method says what the Gaussians of a moment are (`losses`) and what else learns.

    Attributes:
        model: all that learns; its attribute ``gaussians`` are the canonical Gaussians.
        supervision: the clip's images and cameras.
        total: number of steps.
    """

    def __init__(
        self,
        model: nn.Module,
        groups: Mapping[str, list[nn.Parameter]],
        config: SplatConfig,
        supervision: Supervision,
        generator: torch.Generator,
    ) -> None:
        self.model, self.groups, self.supervision, self.generator = model, dict(groups), supervision, generator
        self.settings, self.total = config, config.iterations
        own, rates = self.gaussians, config.rates
        self.optimizer = torch.optim.Adam(
            [
                {"params": [getattr(own, name)], "lr": 0.0 if name == "means" else getattr(rates, name)}
                for name in NAMES
            ],
            eps=1e-15,
            fused=True,
        )
        self.others = torch.optim.Adam([{"params": group} for group in groups.values()], eps=1e-8, fused=True)
        self.density = DensityControl(config.density, len(own), own.means.device)

    @property
    def gaussians(self) -> Gaussians:
        """The canonical Gaussians."""
        gaussians = self.model.gaussians
        assert isinstance(gaussians, Gaussians)
        return gaussians

    @abstractmethod
    def losses(self, index: int) -> tuple[dict[str, Tensor], RasterInfo, Target]:
        """Return the weighted losses of one drawn view, the render's info and the view."""

    @abstractmethod
    def rate(self, name: str, progress: float) -> float:
        """Return the learning rate of a group that is not the Gaussians'."""

    def step(self, index: int) -> dict[str, float]:
        """Take one iteration; return the figures for the log."""
        progress = index / self.settings.iterations
        self.optimizer.param_groups[NAMES.index("means")]["lr"] = exponential(*self.settings.rates.means, progress)
        for name, group in zip(self.groups, self.others.param_groups, strict=True):
            group["lr"] = self.rate(name, progress)
        losses, info, target = self.losses(index)
        loss = torch.stack(list(losses.values())).sum()
        if not torch.isfinite(loss):
            bad = next(name for name, value in losses.items() if not torch.isfinite(value))
            raise FloatingPointError(f"iteration {index}: loss '{bad}' is not finite")
        self.optimizer.zero_grad(set_to_none=True)
        self.others.zero_grad(set_to_none=True)
        loss.backward()
        self._check_gradients(index)
        if progress < self.settings.density.end:
            self.density.observe(info, target.side, max(target.camera.width, target.camera.height))
        self.optimizer.step()
        self.others.step()
        self._control(index)
        return {"loss": float(loss.detach()), "gaussians": len(self.gaussians)} | {
            name: float(value.detach()) for name, value in losses.items()
        }

    def render(self, shape: Shape, target: Target, progress: float) -> tuple[Tensor, Tensor, RasterInfo]:
        """Return the colour premultiplied [3, h, w], matte [1, h, w] and the info of one view."""
        canonical = self.settings.canonical
        degree = min(canonical.sh_degree, int(progress / canonical.sh_every))
        return render(self.gaussians, shape, target.camera, degree)

    def image_losses(self, rgb: Tensor, alpha: Tensor, target: Target) -> dict[str, Tensor]:
        """Return the weighted losses of a render."""
        drawn = self.settings.loss.random_background
        background = torch.rand(3, generator=self.generator).to(rgb) if drawn else rgb.new_ones(3)
        return image_losses(rgb, alpha, target, background, self.settings.loss)

    def changed(self) -> None:  # noqa: B027  (a method without per-Gaussian state has nothing to do)
        """Called after the set of Gaussians changed."""

    def _check_gradients(self, index: int) -> None:
        """A gradient that is not finite stops the fit with its name."""
        sums = {name: each.grad.sum() for name, each in self.model.named_parameters() if each.grad is not None}
        if not torch.isfinite(torch.stack(list(sums.values()))).all():
            bad = next(name for name, value in sums.items() if not torch.isfinite(value))
            raise FloatingPointError(f"iteration {index}: the gradient of '{bad}' is not finite")

    def _control(self, index: int) -> None:
        """Densify and prune, then reset opacities, where the schedule says so."""
        density, resets, total = self.settings.density, self.settings.resets, self.settings.iterations
        every = max(1, round(density.every * total))
        if density.start * total <= index < density.end * total and (index + 1) % every == 0:
            self.density.round(self.gaussians, self.optimizer, self.generator)
            if len(self.gaussians) == 0:
                raise FloatingPointError(f"iteration {index}: no Gaussian is left; every opacity fell below the limit")
            self.changed()
        if resets.every and index < resets.until * total and (index + 1) % max(1, round(resets.every * total)) == 0:
            reset_opacities(self.gaussians, self.optimizer, resets.opacity)

    def state(self) -> dict[str, Any]:
        """Return everything that a resumed fit needs."""
        return {
            "model": self.model.state_dict(),
            "optimizer": self.optimizer.state_dict(),
            "others": self.others.state_dict(),
            "density": [self.density.gradient, self.density.seen, self.density.radius],
            "generator": self.generator.get_state(),
        }

    def restore(self, state: Mapping[str, Any]) -> None:
        """Continue from `state`; the number of Gaussians may differ from the present one."""
        device = self.gaussians.means.device
        for group, name in zip(self.optimizer.param_groups, NAMES, strict=True):
            parameter = nn.Parameter(state["model"][f"gaussians.{name}"].to(device).clone())
            setattr(self.gaussians, name, parameter)
            group["params"] = [parameter]
        self.model.load_state_dict(state["model"])
        self.optimizer.load_state_dict(state["optimizer"])
        self.others.load_state_dict(state["others"])
        parts = [part.to(device).clone() for part in state["density"]]
        self.density.gradient, self.density.seen, self.density.radius = parts
        self.generator.set_state(state["generator"])


def run_steps(training: SplatTraining, identity: str, log: Log, workdir: Path | None) -> None:
    """All steps of a fit; continues from a checkpoint of the same fit in ``workdir``."""
    start = 0
    if saved := load_checkpoint(workdir, identity):
        start = saved["step"]
        training.restore(saved["training"])
    for index in range(start, training.total):
        figures = training.step(index)
        done = index + 1
        if index % LOG_EVERY == 0 or done == training.total:
            log(done, training.total, figures)
        if workdir is not None and done % training.settings.checkpoint_every == 0 and done < training.total:
            save_checkpoint(workdir, identity, {"step": done, "training": training.state()})
    training.gaussians.blur.fill_(training.supervision.missing_blur())


@torch.no_grad()
def reset_opacities(gaussians: Gaussians, optimizer: torch.optim.Optimizer, opacity: float) -> None:
    """Lower every opacity to at most ``opacity`` and forget its Adam moments."""
    logits = gaussians.logit_opacities
    logits.clamp_(max=math.log(opacity / (1 - opacity)))
    for name in ("exp_avg", "exp_avg_sq"):
        if name in optimizer.state[logits]:
            optimizer.state[logits][name].zero_()


def surface_gaussians(
    prior: Prior, clip: Clip, transforms: Tensor | None, config: Canonical, generator: torch.Generator
) -> dict[str, Tensor]:
    """Flat Gaussians on the prior's surface, coloured from the frames: the very start that `prior-only` renders.

    Args:
        prior: its rest surface is sampled, area-uniformly.
        clip: gives the colours.
        transforms: pose of the surface, [J, 4, 4]; None for the rest pose.
        config: number, thickness and opacity.
        generator: the only source of chance.

    Returns:
        The five attributes of `Gaussians` by name.
    """
    sample = sample_surface(prior, config.samples, generator)
    rest = torch.eye(4).expand(len(prior.parents), 4, 4) if transforms is None else transforms
    scales = sample.radius * torch.tensor((1.0, 1.0, config.thickness)).expand(config.samples, 3)
    rgb = colors_from_frames(prior, sample, clip.frames)
    splats = pose_gaussians(sample, quats_from_normals(sample.normals), scales, rgb, rest)
    colors = torch.zeros(config.samples, (config.sh_degree + 1) ** 2, 3)
    colors[:, 0] = rgb
    return {
        "means": splats.means,
        "quats": splats.quats,
        "log_scales": scales.log(),
        "logit_opacities": torch.full((config.samples,), math.log(config.opacity / (1 - config.opacity))),
        "colors": colors,
    }
