"""GART: Gaussians on an articulated template, with learned skinning and per-frame poses; and GART*.

Paper: Lei et al., GART: Gaussian Articulated Template Models, CVPR 2024. Written anew from the paper and its dog
profile on this package's rasterizer; nothing is copied from the authors' code (MIT).

The original drives D-SMAL, a model of dogs that may not be distributed. Here the template is the prior: its 20 bones
and its surface, with the poses fitted to this clip. The setting `template` names the file of a D-SMAL that a user owns
(gart_smal.py); its initial poses follow the prior's. Settings hold the path alone, so the file must not change between
runs.

`gart-star` then fits the pose of each frame once more to that frame, everything else frozen: SGD, 160 steps, at a rate
of 2e-2 halved every 50. Where views are held out, the fit uses the training camera's image of each frame, as the
original does there, and never a held-out view. Where frames of a video are held out, the fit does not see them; the
evaluation then fits their poses to them (`GartStarReconstruction.refined`), and every table says that the row has seen
the test images.

As in the paper of `ours`, the frames' mirror images are seen too, at time -t: each has a pose of its own, which starts
from the prior's pose of the flipped frame. The results have the poses of the frames alone.

Differences from the original: positions get no gradient through the skinning grid; a Gaussian rotates by the blended
quaternion of its joints, not by the blended matrix, which would shrink it; the grid is a cube; neighbours are searched
when the set of Gaussians changes, not in every step; colours start from the frames; scales are logarithms with a cap;
the number of Gaussians is capped. Settings `skin` hold them to the template as in `ours` and are off by default. The
original's unit of length is the template's diagonal here. The schedule is in fractions of the original's 10k steps.
"""

from collections.abc import Iterator
from pathlib import Path
from typing import Any, ClassVar

import torch
from torch import Tensor, nn

from rewild4d.baselines.common.splatting import STATE, SplatTraining, run_training, surface_gaussians
from rewild4d.baselines.gart_config import INFO, STAR_INFO, GartConfig, GartStarConfig
from rewild4d.baselines.gart_reconstruction import GartReconstruction, GartStarReconstruction
from rewild4d.baselines.gart_refine import refine_step
from rewild4d.baselines.gart_skeleton import PoseTable, prior_poses
from rewild4d.baselines.gart_skinning import ResidualField, posed
from rewild4d.baselines.gart_smal import template_prior
from rewild4d.contracts import Log, MethodInfo
from rewild4d.foreign.states import read_as
from rewild4d.harmonics import C0
from rewild4d.kernels.threads import torch_on_one
from rewild4d.ours.canonical import REST_GAIN, Gaussians, Posed
from rewild4d.ours.checkpoint import fit_digest, load_fitted
from rewild4d.ours.evidence import Sighting, training_views
from rewild4d.ours.losses.regularizers import neighbours
from rewild4d.ours.motion import Root
from rewild4d.ours.schedule import exponential, for_clip
from rewild4d.ours.symmetry import Key, Supervision, Target, match_times
from rewild4d.rasterizer import RasterInfo
from rewild4d.types import OBJECT_DIAGONAL, Clip, Prior


class GartModel(nn.Module):
    """Canonical Gaussians, skinning field, poses of the frames, and of their mirror images where these are seen."""

    def __init__(
        self, gaussians: Gaussians, field: ResidualField, poses: PoseTable, flipped: PoseTable | None = None
    ) -> None:
        super().__init__()
        self.gaussians, self.field, self.poses, self.flipped = gaussians, field, poses, flipped


class GartTraining(SplatTraining):
    """One fit; the steps after `GartConfig.iterations` refine the poses of the star."""

    model: GartModel
    config: GartConfig

    def __init__(
        self, model: GartModel, config: GartConfig, supervision: Supervision, generator: torch.Generator
    ) -> None:
        tables = [table for table in (model.poses, model.flipped) if table is not None]
        groups = {
            "turns": [table.turns for table in tables],
            "shifts": [table.shifts for table in tables],
            "skinning": [model.field.residual],
        }
        super().__init__(model, groups, config, supervision, generator)
        self.weights: Tensor | None = None

    @property
    def total(self) -> int:
        refine = self.config.refine.steps if isinstance(self.config, GartStarConfig) else 0
        return super().total + refine * self.supervision.frames

    def rate(self, name: str, progress: float) -> float:
        poses = self.config.poses
        if name == "skinning":
            start = poses.skinning_start
            return 0.0 if progress < start else exponential(*poses.skinning_rate, (progress - start) / (1 - start))
        return 0.0 if progress < poses.start else poses.rate * (OBJECT_DIAGONAL if name == "shifts" else 1.0)

    def sightings(self) -> Iterator[Sighting]:
        weights = self.model.field.still(self.model.gaussians.means)
        for key, share in training_views(self.supervision, self.config.mirrored):
            shape = posed(self.model.gaussians, weights, *self._table(key)(key.frame))
            yield Sighting(key, share, Posed(shape.means, shape.quats, self.gaussians.scales_log()))

    def _table(self, key: Key) -> PoseTable:
        table = self.model.poses if key.view > 0 else self.model.flipped
        assert table is not None, "mirror images are drawn, so they have poses"
        return table

    def step(self, index: int) -> dict[str, float]:
        done = index - self.config.iterations
        return super().step(index) if done < 0 else self._refine_step(done)

    def drawn_losses(self, index: int) -> tuple[dict[str, Tensor], RasterInfo, Target]:
        self.prepare()
        config, model = self.config, self.model
        progress = index / config.iterations
        key = self.draw(config.mirrored)
        target, table = self.supervision.target(key), self._table(key)
        learns = config.skinning.learn and progress >= config.poses.skinning_start
        regularised = learns and index % config.regularisers.every == 0
        if learns:
            weights, variation = model.field(model.gaussians.means.detach(), regularised)
        else:
            weights, variation = model.field.still(model.gaussians.means), None
        shape = posed(model.gaussians, weights, *table(key.frame))
        rgb, alpha, info = self.render(shape, target, progress)
        losses = self.image_losses(rgb, alpha, target) | self._alike() | self.skin_losses(self.gaussians.opacities())
        if regularised and variation is not None:
            terms = config.regularisers
            losses["residual"] = terms.every * (terms.variation * variation + terms.norm * model.field.norm())
        return losses, info, target

    def _alike(self) -> dict[str, Tensor]:
        """Compute the loss of attributes that differ among neighbours, and of large Gaussians."""
        own, config = self.model.gaussians, self.config.regularisers
        if self.near is None:
            others = neighbours(own.means, min(config.neighbours, len(own)) - 1).to(own.means.device)
            self.near = torch.cat((torch.arange(len(own), device=others.device)[:, None], others), dim=1)
        scales = own.scales_log().exp() / OBJECT_DIAGONAL
        total = config.small * scales.amax(-1).square().mean()
        colors = torch.cat((own.colors[:, :1] / C0, own.colors[:, 1:] / REST_GAIN), dim=1).flatten(1)
        for weight, values in (
            (config.quats, own.quats),
            (config.scales, scales),
            (config.opacities, own.opacities()[:, None]),
            (config.colors, colors),
        ):
            if weight:
                total = total + weight * spread(values, self.near)
        return {"alike": total}

    def _refine_step(self, done: int) -> dict[str, float]:
        """Take a step of SGD on the pose of one frame."""
        assert isinstance(self.config, GartStarConfig)
        model, (frame, step) = self.model, divmod(done, self.config.refine.steps)
        if self.weights is None:
            self.weights = model.field.still(model.gaussians.means)
        target = self.supervision.target(Key(1, 1, frame))
        loss = refine_step(model.gaussians, self.weights, model.poses, frame, target, step, self.config)
        return {"loss": loss, "frame": frame}


def spread(values: Tensor, near: Tensor) -> Tensor:
    """Return the mean standard deviation (unbiased) of attributes among neighbours, [n, c] and [n, k] -> scalar."""
    groups = values[near]
    apart = groups - groups.mean(dim=1, keepdim=True)
    return (apart.square().sum(dim=1) / max(1, near.shape[1] - 1) + 1e-12).sqrt().mean()


class Gart:
    """The method on the prior's skeleton (contracts.Method)."""

    name: ClassVar[str] = "gart"
    info: ClassVar[MethodInfo] = INFO
    Config: ClassVar[type[GartConfig]] = GartConfig
    Result: ClassVar[type[GartReconstruction]] = GartReconstruction

    def fit(
        self,
        clip: Clip,
        prior: Prior,
        *,
        config: GartConfig,
        seed: int,
        device: torch.device,
        log: Log,
        workdir: Path | None,
    ) -> GartReconstruction:
        """Reconstruct from the clip and the prior; see contracts.Method."""
        config = for_clip(config, len(clip.frames))
        generator = torch.Generator().manual_seed(seed)
        supervision = Supervision(clip, prior, config.image_size, device)
        template = template_prior(Path(config.template), prior) if config.template else prior
        values = surface_gaussians(template, clip, None, config.canonical, generator)
        gaussians = Gaussians(values, config.canonical.max_scale)
        rows = match_times(clip, prior)
        poses, flipped = (prior_poses(template, rows, mirrored=side) for side in (False, True))
        field = ResidualField(template, config.skinning)
        model = GartModel(gaussians, field, poses, flipped if config.mirrored else None).to(device)
        training = GartTraining(model, config, supervision, generator)
        with torch_on_one():
            run_training(training, f"{self.name} {fit_digest(config, clip, template, seed)}", log, workdir)
        weights = model.field.still(model.gaussians.means)
        return self.Result(model.gaussians, weights, model.poses, config, Root.of(clip, prior))

    def load(self, folder: Path, device: torch.device) -> GartReconstruction:
        """Read back what `GartReconstruction.save` wrote."""
        state, config = load_fitted(folder, STATE, self.name, self.Config)
        with read_as(folder, self.name):
            gaussians = Gaussians.from_state(state["model"], config.canonical.max_scale)
            gaussians.blur.copy_(state["model"]["gaussians.blur"])
            saved: dict[str, Any] = state["poses"]
            poses = PoseTable(saved["quats"], saved["offsets"], saved["pivots"], state["parents"])
            poses.load_state_dict(saved)
            root = Root.from_state(state["root"])
            return self.Result(gaussians.to(device), state["weights"].to(device), poses.to(device), config, root)


class GartStar(Gart):
    """The method with the poses of all scored frames fitted once more to the input view (contracts.Method)."""

    name: ClassVar[str] = "gart-star"
    info: ClassVar[MethodInfo] = STAR_INFO
    Config: ClassVar[type[GartConfig]] = GartStarConfig
    Result: ClassVar[type[GartReconstruction]] = GartStarReconstruction
