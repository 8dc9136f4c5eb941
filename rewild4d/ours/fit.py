"""Training loop: warm-up, then the stage-aware losses of METHOD section 6."""

import math
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from rewild4d.contracts import Log
from rewild4d.kernels.threads import torch_on_one
from rewild4d.ours.checkpoint import fit_digest, load_checkpoint
from rewild4d.ours.coloring import initial_colors
from rewild4d.ours.config import Config
from rewild4d.ours.deform import Posed
from rewild4d.ours.gradients import all_finite, clip_gradients, require_finite
from rewild4d.ours.losses.images import WINDOW, colour_losses, silhouette_loss, union_window
from rewild4d.ours.losses.regularizers import compact_loss, neighbours, rigid_loss, smooth_loss
from rewild4d.ours.losses.skeleton import neighbour_keys, posture
from rewild4d.ours.model import Model, build_model
from rewild4d.ours.pose import blend_poses, pose_distance
from rewild4d.ours.schedule import exponential, fade, ramp
from rewild4d.ours.symmetry import Key, Supervision, Target
from rewild4d.ours.training import GaussianTraining, run_steps
from rewild4d.ours.warmup import WarmUp
from rewild4d.rasterizer import RasterInfo, rasterize
from rewild4d.types import Clip, Prior


class Training(GaussianTraining):
    """The main stage; its groups are skinning, pose and deform."""

    SAVED = ("gaussian_optimizer", "network_optimizer")
    model: Model
    config: Config

    def __init__(self, model: Model, supervision: Supervision, config: Config, generator: torch.Generator) -> None:
        groups = {
            "skinning": list(model.field.parameters()),
            "pose": list(model.network.parameters()),
            "deform": list(model.deform.parameters()),
        }
        model.field.logits.requires_grad_(config.skinning.learn)
        super().__init__(model, groups, config, supervision, generator)

    def rate(self, name: str, progress: float) -> float:
        rates = self.config.rates
        first, last = getattr(rates, name)
        return exponential(first, last, progress) * ramp(progress, 0.0, rates.rise)

    def drawn_losses(self, index: int) -> tuple[dict[str, Tensor], RasterInfo | None, Target]:
        key = self.supervision.draw(self.generator, self.config.mirrored, self.config.cameras)
        target = self.supervision.target(key)
        return *self.losses(key, target, index), target

    def losses(self, key: Key, target: Target, index: int) -> tuple[dict[str, Tensor], RasterInfo | None]:
        """Compute all weighted losses of a view at an iteration, and the render info of the deformed branch."""
        config, model = self.config, self.model
        progress = index / config.iterations
        keys, own, gaps = neighbour_keys([key], self.supervision.positions, config.geometry)
        poses = model.pose(self._times(keys, progress), keys)
        network_pose = poses
        if config.prior.blend:
            prior_pose = self.supervision.prior_pose(keys)
            poses = blend_poses(poses, *prior_pose, fade(progress, config.prior.blend_until))
        pose, transforms, skeleton = posture(model, poses, own, config.geometry, gaps)
        probabilities = model.field.probabilities()
        delta = config.geometry.tv_delta if self._varies(index) else None
        weights, variation = model.field.sample_and_vary(probabilities, model.gaussians.means, delta)
        opacities = model.gaussians.opacities()

        live, posed = model.skin(weights, pose.quats.squeeze(0), transforms.squeeze(0))
        _, pose_alpha, _ = self._render(
            live, opacities.detach(), opacities.new_zeros(len(opacities), 1), target, detach_scales=True
        )
        strength = ramp(progress, config.deform.ramp_start, config.deform.ramp_end)
        offset = float(torch.rand((), generator=self.generator)) if config.deform.sampled else 0.0
        deformed = model.deformed(pose, weights, posed, strength, offset)
        degree = min(config.canonical.sh_degree, int(progress / config.canonical.sh_every))
        colors = model.gaussians.seen_rgb(deformed.means, deformed.quats, target.eye, degree)
        rgb, alpha, info = self._render(deformed, opacities, colors, target)

        losses = self._image_losses(pose_alpha, rgb, alpha, target)
        if config.prior.pull and progress < config.prior.pull_until:
            apart = pose_distance(network_pose, *self.supervision.prior_pose(keys))
            losses["prior"] = config.prior.pull * fade(progress, config.prior.pull_until) * apart
        losses["skeleton"] = skeleton
        if delta is not None:
            losses["tv"] = config.geometry.tv * config.geometry.tv_every * variation
        losses |= self._geometry_losses(index, weights, opacities, posed, deformed)
        return losses, info

    def _times(self, keys: list[Key], progress: float) -> Tensor:
        """Return times for the code, jittered early on by a share of a frame that neighbours share."""
        pose = self.config.pose
        noise = float(torch.randn((), generator=self.generator)) * pose.time_noise
        return self.supervision.code_times(keys, noise * fade(progress, pose.time_noise_until))

    def _render(
        self, posed: Posed, opacities: Tensor, features: Tensor, target: Target, detach_scales: bool = False
    ) -> tuple[Tensor, Tensor, RasterInfo]:
        camera = target.camera
        log_scales = posed.log_scales.detach() if detach_scales else posed.log_scales
        image, alpha, info = rasterize(
            posed.means, posed.quats, self.model.gaussians.scales(log_scales), opacities, features,
            camera.world_to_camera[None], camera.intrinsics[None], camera.width, camera.height,
        )  # fmt: skip
        return image[0], alpha[0], info

    def _image_losses(self, pose_alpha: Tensor, rgb: Tensor, alpha: Tensor, target: Target) -> dict[str, Tensor]:
        """Compute L_pose and L_deform of one view."""
        weights = self.config.loss
        window = union_window([pose_alpha, alpha, target.mask], WINDOW - 1)
        background = torch.rand(3, generator=self.generator).to(rgb) if weights.random_background else rgb.new_ones(3)
        l1, dissimilarity = colour_losses(rgb, alpha, target, background, window)
        return {
            "pose_silhouette": weights.pose_silhouette * silhouette_loss(pose_alpha, target, window),
            "l1": weights.l1 * l1,
            "ssim": weights.ssim * dissimilarity,
            "silhouette": weights.silhouette * silhouette_loss(alpha, target, window),
        }

    def _varies(self, index: int) -> bool:
        """Tell whether the total variation of the skinning field counts in this step."""
        config = self.config.geometry
        lasts = index < config.until * self.config.iterations and self.config.skinning.learn
        return lasts and config.tv > 0 and index % config.tv_every == 0

    def _geometry_losses(
        self, index: int, weights: Tensor, opacities: Tensor, posed: Posed, deformed: Posed
    ) -> dict[str, Tensor]:
        """Compute compactness and smoothness while they last, and neighbour rigidity."""
        config, own = self.config.geometry, self.model.gaussians
        losses: dict[str, Tensor] = {}
        if index < config.until * self.config.iterations:
            if config.compact and index % config.compact_every == 0:
                both = compact_loss((own.means, posed.means), weights, config.compact_alpha)
                losses["compact"] = config.compact * config.compact_every * both
            if config.smooth and index % config.smooth_every == 0:
                smooth = smooth_loss(deformed, opacities, config.smooth_size, self.generator)
                losses["smooth"] = config.smooth * config.smooth_every * smooth
        if config.rigid and len(own) > 1:
            if self.near is None:
                self.near = neighbours(own.means, config.rigid_neighbours)
            losses["rigid"] = config.rigid * rigid_loss(own.means, deformed.means, self.near)
        if config.steady:
            losses["steady"] = config.steady * (deformed.log_scales - posed.log_scales).square().mean()
        return losses

    def check_gradients(self, index: int) -> None:
        """Clip the networks' gradients; raise a FloatingPointError where a gradient is not finite."""
        limit = self.config.rates.clip or math.inf
        norms = [clip_gradients(self.groups[name], limit) for name in ("pose", "deform")]
        if not all(map(math.isfinite, norms)) or not all_finite(list(self.model.gaussians.parameters())):
            require_finite(self.model, index)


def train(
    clip: Clip, prior: Prior, config: Config, seed: int, device: torch.device, log: Log, workdir: Path | None
) -> Model:
    """Fit the model to a clip; a checkpoint of the same fit in ``workdir`` is continued.

    Raises:
        UserError: the clip or the prior cannot be used.
    """
    generator = torch.Generator().manual_seed(seed)
    supervision = Supervision(clip, prior, config.image_size, device, config.loss.mean_over)
    small = Supervision(clip, prior, min(config.image_size, config.warmup.size), device)
    model = build_model(config, prior, generator).to(device)
    warmup = WarmUp(model, small, prior, config, generator)
    main = Training(model, supervision, config, generator)
    identity = fit_digest(config, clip, prior, seed)
    start, total = 0, warmup.total + config.iterations
    if saved := load_checkpoint(workdir, identity):
        start = saved["step"]
        main.restore(saved["main"])
        warmup.optimizer.load_state_dict(saved["warmup"])
        generator.set_state(saved["generator"])

    def step(index: int) -> dict[str, float]:
        if index == warmup.total:
            model.gaussians.colors.data[:, 0] = initial_colors(model, supervision)
        return warmup.step(index) if index < warmup.total else main.step(index - warmup.total)

    def state() -> dict[str, Any]:
        optimizer = warmup.optimizer.state_dict()
        return {"main": main.state(), "warmup": optimizer, "generator": generator.get_state()}

    with torch_on_one():
        run_steps(step, range(start, total), config.checkpoint_every, identity, state, log, workdir)
    model.gaussians.blur.fill_(supervision.missing_blur())
    return model
