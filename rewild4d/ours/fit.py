"""Training loop: warm-up, then the stage-aware losses of METHOD section 6."""

import math
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from rewild4d.contracts import Log
from rewild4d.kernels.threads import torch_on_one
from rewild4d.ours.canonical import Posed
from rewild4d.ours.checkpoint import fit_digest, load_checkpoint
from rewild4d.ours.coloring import initial_colors
from rewild4d.ours.config import Config
from rewild4d.ours.evidence import Sighting, pull_shares
from rewild4d.ours.gradients import all_finite, clip_gradients, norm_of, require_finite, scale_gradients
from rewild4d.ours.graphs import CudaRecorder, StepGraphs, can_record
from rewild4d.ours.inputs import StepInput
from rewild4d.ours.limbs import LimbSearch, learn_poses
from rewild4d.ours.losses.images import WINDOW, colour_losses, silhouette_loss, union_window
from rewild4d.ours.losses.regularizers import compact_loss, neighbours, random_direction, rigid_loss, smooth_loss
from rewild4d.ours.losses.skeleton import neighbour_keys, posture
from rewild4d.ours.losses.untold import Marks, untold_loss
from rewild4d.ours.model import Model, build_model, sightings
from rewild4d.ours.pose import blend_poses, joint_transforms, pose_distance
from rewild4d.ours.schedule import exponential, fade, ramp
from rewild4d.ours.symmetry import Key, Supervision, Target
from rewild4d.ours.training import GaussianTraining, run_steps
from rewild4d.ours.warmup import WarmUp
from rewild4d.rasterizer import RasterInfo, rasterize
from rewild4d.types import OBJECT_DIAGONAL, Clip, Prior

CLIPPED = ("pose", "deform")
"""Groups whose gradients are clipped."""


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
        if model.turns is not None:
            groups["turns"] = list(model.turns.parameters())
        model.field.logits.requires_grad_(config.skinning.learn)
        super().__init__(model, groups, config, supervision, generator)
        self.marks: Marks | None = None
        # Of the pull to the prior's poses, a frame each.
        self.shares = pull_shares(supervision, config.prior.pull_turn)
        self.graphs = StepGraphs(self, CudaRecorder(model.pivots.device)) if can_record(model.pivots.device) else None

    def step(self, index: int) -> dict[str, float]:
        """Take one step, from graphs where the model is on a GPU that records them."""
        return super().step(index) if self.graphs is None else self.graphs.step(index)

    def rate(self, name: str, progress: float) -> float:
        rates = self.config.rates
        if name == "turns":
            return rates.turns if progress >= self.config.pose.turns_from else 0.0
        first, last = getattr(rates, name)
        return exponential(first, last, progress) * ramp(progress, 0.0, rates.rise)

    def drawn_losses(self, index: int) -> tuple[dict[str, Tensor], RasterInfo | None, Target]:
        self.prepare()
        given = self.drawn_input(index)
        return *self.losses_of(given.to(self.model.pivots.device)), given.target

    def drawn_input(self, index: int) -> StepInput:
        """Draw a view and all else that a step takes."""
        key = self.supervision.draw(self.generator, self.config.mirrored, self.config.cameras)
        return self.input(key, self.supervision.target(key), index)

    def losses(self, key: Key, target: Target, index: int) -> tuple[dict[str, Tensor], RasterInfo | None]:
        """Compute all weighted losses of a view at an iteration, and the render info of the deformed branch."""
        self.prepare()
        return self.losses_of(self.input(key, target, index).to(self.model.pivots.device))

    def input(self, key: Key, target: Target, index: int) -> StepInput:
        """Draw and schedule what a step with a view takes; all but the target's images are on the CPU."""
        config, supervision = self.config, self.supervision
        progress, geometry = index / config.iterations, config.geometry
        keys, own, gaps = neighbour_keys([key], supervision.positions, geometry)
        codes, flipped = self.model.codes(self._times(keys, progress), keys)
        blend = fade(progress, config.prior.blend_until) if config.prior.blend else 0.0
        pull = config.prior.pull * fade(progress, config.prior.pull_until) * self.shares[key.frame]
        deform, background = config.deform, torch.ones(3)
        offset = float(torch.rand((), generator=self.generator)) if deform.sampled else 0.0
        if config.loss.random_background:
            background = torch.rand(3, generator=self.generator)
        acts = index < geometry.until * config.iterations
        smooths = acts and geometry.smooth > 0 and index % geometry.smooth_every == 0
        return StepInput(
            target, target.eye, codes, flipped, torch.tensor(own), gaps,
            prior_pose=supervision.prior_pose(keys),
            blend=blend or None,
            pull=pull or None,
            ramp=(deform.enabled and ramp(progress, deform.ramp_start, deform.ramp_end)) or None,
            offset=offset,
            background=background,
            direction=random_direction(self.generator) if smooths else None,
            degree=min(config.canonical.sh_degree, int(progress / config.canonical.sh_every)),
            varies=acts and config.skinning.learn and geometry.tv > 0 and index % geometry.tv_every == 0,
            compacts=acts and geometry.compact > 0 and index % geometry.compact_every == 0,
            marks=torch.zeros(0) if self.marks is None else self.marks.views[int(key.view < 0), key.frame],
        )  # fmt: skip

    def losses_of(self, given: StepInput) -> tuple[dict[str, Tensor], RasterInfo | None]:
        """Compute all weighted losses of an input, and the render info of the deformed branch; draw nothing."""
        config, model, target = self.config, self.model, given.target
        poses = network_pose = model.pose_of(given.codes, given.flipped)
        if given.blend is not None:
            poses = blend_poses(poses, *given.prior_pose, given.blend)
        pose, transforms, skeleton = posture(model, poses, given.row, config.geometry, given.gaps)
        if model.turns is not None:
            pose = model.turned(pose, given.codes[given.row], given.flipped[given.row])
            transforms = model.transforms(pose)
        probabilities = model.field.probabilities()
        delta = config.geometry.tv_delta if given.varies else None
        weights, variation = model.field.sample_and_vary(probabilities, model.gaussians.means, delta)
        opacities = model.gaussians.opacities()

        live, posed = model.skin(weights, pose.quats.squeeze(0), transforms.squeeze(0))
        _, pose_alpha, _ = self._render(
            live, opacities.detach(), opacities.new_zeros(len(opacities), 1), target, detach_scales=True
        )
        deformed = model.deformed(pose, weights, posed, given.ramp, given.offset)
        colors = model.gaussians.seen_rgb(deformed.means, deformed.quats, given.eye, given.degree)
        rgb, alpha, info = self._render(deformed, opacities, colors, target)

        losses = self._image_losses(pose_alpha, rgb, alpha, target, given.background)
        if given.pull is not None:
            losses["prior"] = given.pull * pose_distance(network_pose, *given.prior_pose)
        losses["skeleton"] = skeleton
        if self.marks is not None:
            quats, shifts = (part[given.row].squeeze(0) for part in given.prior_pose)
            before = joint_transforms(quats, shifts, model.pivots)
            untold = untold_loss(self.marks, transforms.squeeze(0), before, given.eye, given.marks)
            losses["untold"] = config.prior.untold * untold
        if delta is not None:
            losses["tv"] = config.geometry.tv * config.geometry.tv_every * variation
        return losses | self._geometry_losses(given, weights, opacities, posed, deformed), info

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

    def _image_losses(
        self, pose_alpha: Tensor, rgb: Tensor, alpha: Tensor, target: Target, background: Tensor
    ) -> dict[str, Tensor]:
        """Compute L_pose and L_deform of one view."""
        weights = self.config.loss
        window = union_window([pose_alpha, alpha, target.mask], WINDOW - 1)
        l1, dissimilarity = colour_losses(rgb, alpha, target, background.to(rgb), window)
        return {
            "pose_silhouette": weights.pose_silhouette * silhouette_loss(pose_alpha, target, window),
            "l1": weights.l1 * l1,
            "ssim": weights.ssim * dissimilarity,
            "silhouette": weights.silhouette * silhouette_loss(alpha, target, window),
        }

    def _geometry_losses(
        self, given: StepInput, weights: Tensor, opacities: Tensor, posed: Posed, deformed: Posed
    ) -> dict[str, Tensor]:
        """Compute compactness and smoothness where they act, and neighbour rigidity."""
        config, own = self.config.geometry, self.model.gaussians
        losses: dict[str, Tensor] = {}
        if given.compacts:
            both = compact_loss((own.means, posed.means), weights, config.compact_alpha)
            losses["compact"] = config.compact * config.compact_every * both
        if given.direction is not None:
            smooth = smooth_loss(deformed, opacities, config.smooth_size, given.direction)
            losses["smooth"] = config.smooth * config.smooth_every * smooth
        if config.rigid and len(own) > 1:
            assert self.near is not None, "`prepare` comes first"
            losses["rigid"] = config.rigid * rigid_loss(own.means, deformed.means, self.near)
        if config.steady:
            losses["steady"] = config.steady * (deformed.log_scales - posed.log_scales).square().mean()
        if config.stray:
            away = ((deformed.means - posed.means) / OBJECT_DIAGONAL).square().sum(dim=1)
            losses["stray"] = config.stray * torch.relu(away - config.stray_from**2).mean()
        return losses | self.skin_losses(opacities)

    def change_density(self, index: int) -> bool:
        changed = super().change_density(index)
        if changed and self.graphs is not None:
            self.graphs.forget()
        return changed

    def prepare(self) -> None:
        super().prepare()
        if self.config.prior.untold and self.marks is None:
            self.marks = Marks.of(self.model, self.config.skin.evidence, self.sightings(), self.supervision)
        if self.config.geometry.rigid and len(self.model.gaussians) > 1 and self.near is None:
            self.near = neighbours(self.model.gaussians.means, self.config.geometry.rigid_neighbours)

    def search_limbs(self, small: Supervision) -> None:
        """Search limbs in ``small`` images; from now on the poses that were found are the prior's."""
        config, supervision = self.config, self.supervision
        progress = config.pose.search_limbs
        strength = config.deform.enabled * ramp(progress, config.deform.ramp_start, config.deform.ramp_end)
        search, found, elsewhere = LimbSearch.of(self.model, small, strength), {}, False
        for view in (1, -1):
            if not small.frames_of(view) or (view < 0 and not config.mirrored):
                continue
            found[view], bones = search.poses(view)
            rows = int(view < 0), torch.tensor(small.frames_of(view))[:, None], torch.tensor(bones, dtype=torch.long)
            supervision.prior_quats[rows] = found[view].quats[:, bones].cpu()
            supervision.prior_shifts[rows] = found[view].shifts[:, bones].cpu()
            elsewhere = elsewhere or bool(bones)
        if elsewhere:
            learn_poses(self.model, small, found, self.generator)

    def state(self) -> dict[str, Any]:
        prior = (self.supervision.prior_quats, self.supervision.prior_shifts)
        return super().state() | {"marks": self.marks and tuple(self.marks), "prior": prior}

    def restore(self, state: Mapping[str, Any]) -> None:
        super().restore(state)
        self.supervision.prior_quats, self.supervision.prior_shifts = state["prior"]
        self.marks = state["marks"] and Marks(*state["marks"])

    def sightings(self) -> Iterator[Sighting]:
        return sightings(self.model, self.supervision, self.config.mirrored)

    def limited(self) -> Tensor:
        """Clip the networks' gradients as `check_gradients` does, without a look at a number; return whether all
        gradients are finite, a number, scalar."""
        limit, norms = self.config.rates.clip or math.inf, []
        for parameters in (*self.groups.values(), list(self.model.gaussians.parameters())):
            norms.append(norm_of(parameters))
        for name, norm in zip(self.groups, norms, strict=False):
            if name in CLIPPED and math.isfinite(limit):
                scale_gradients(self.groups[name], (limit / (norm + 1e-6)).clamp(max=1.0))
        return torch.stack(norms).isfinite().all().to(norms[0])

    def check_gradients(self, index: int) -> None:
        """Clip the networks' gradients; raise a FloatingPointError where a gradient is not finite."""
        limit = self.config.rates.clip or math.inf
        norms = [clip_gradients(self.groups[name], limit) for name in CLIPPED]
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
    model = build_model(config, prior, generator, supervision.frame_times()).to(device)
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
        if config.pose.search_limbs and index == warmup.total + round(config.pose.search_limbs * config.iterations):
            main.search_limbs(small)
        return warmup.step(index) if index < warmup.total else main.step(index - warmup.total)

    def state() -> dict[str, Any]:
        optimizer = warmup.optimizer.state_dict()
        return {"main": main.state(), "warmup": optimizer, "generator": generator.get_state()}

    with torch_on_one():
        run_steps(step, range(start, total), config.checkpoint_every, identity, state, log, workdir)
    model.gaussians.blur.fill_(supervision.missing_blur())
    return model
