"""GART: Gaussians on an articulated template, with learned skinning and per-frame poses; and GART*.

Paper: Lei et al., GART: Gaussian Articulated Template Models, CVPR 2024; the authors' code is under the MIT licence.
Nothing of it is copied; it is written anew from the paper and its dog profile on this package's rasterizer.

The original drives D-SMAL, a model of dogs that may not be passed on. Here the template is the prior: its 20 bones and
its surface, posed as it was fitted to this clip. Who owns a D-SMAL file can name it (`template`): a SMAL pickle
(`v_template`, `f`, `weights`, `J_regressor` or `J`, `kintree_table`; read without running what it holds) or an npz
with `vertices`, `faces`, `weights`, `joints`, `parents`; it then takes its first poses from the prior (gart_smal.py).
A run's settings name the path, so the file should not change between runs.

`gart-star` then fits the pose of each frame once more to that frame, everything else frozen: SGD, 160 steps, at a rate
of 2e-2 halved every 50. The original does so with the image it is scored on. Here that is the training camera's image
at each of the clip's moments, never a held-out view or moment; every table says that there was this second fit.

What differs from the original: positions get no gradient through the skinning grid, a Gaussian turns with the blended
quaternion of its joints instead of the blended matrix (which would shrink it), the grid is a cube, neighbours are
looked up when the Gaussians change instead of in every step, colours start from the frames, scales are logarithms with
a cap, the number of Gaussians is capped. A unit of length of the original is the template's diagonal. The schedule is
given in fractions of the original's 10k steps.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Any, ClassVar

import torch
from torch import Tensor, nn

from rewild4d.baselines.gart_config import GartConfig, GartStarConfig
from rewild4d.baselines.gart_skeleton import PoseTable, prior_poses
from rewild4d.baselines.gart_skinning import ResidualField
from rewild4d.baselines.gart_smal import template_prior
from rewild4d.baselines.saved import Root, gaussians_from_state, load_state, save_state, splats_of
from rewild4d.baselines.splatting import (
    Shape,
    SplatTraining,
    run_steps,
    surface_gaussians,
)
from rewild4d.contracts import Log, MethodInfo
from rewild4d.harmonics import C0
from rewild4d.kernels.arrays import fits
from rewild4d.kernels.threads import torch_on_one
from rewild4d.ours.canonical import REST_GAIN, Gaussians
from rewild4d.ours.checkpoint import fit_digest
from rewild4d.ours.fused.skinning import skin_both
from rewild4d.ours.geometry_losses import neighbours
from rewild4d.ours.schedule import exponential, for_clip
from rewild4d.ours.symmetry import Key, Supervision, Target, match_times
from rewild4d.rasterizer import RasterInfo
from rewild4d.transforms import skin_points, skin_quats
from rewild4d.types import OBJECT_DIAGONAL, Camera, Clip, Prior, Splats

PAPER = "Lei et al., GART: Gaussian Articulated Template Models, CVPR 2024"


class GartModel(nn.Module):
    """Canonical Gaussians, skinning field and poses."""

    def __init__(self, gaussians: Gaussians, field: ResidualField, poses: PoseTable) -> None:
        super().__init__()
        self.gaussians, self.field, self.poses = gaussians, field, poses


def posed(own: Gaussians, weights: Tensor, quats: Tensor, transforms: Tensor) -> Shape:
    """Skinned Gaussians.

    Args:
        own: canonical.
        weights: [n, J].
        quats: rotation of each joint, [J, 4].
        transforms: rest -> posed, [J, 4, 4].
    """
    scales = own.scales(own.scales_log())
    if fits(own.means):
        return Shape(*skin_both(own.means, own.quats, weights, transforms, quats)[:2], scales)
    rest = nn.functional.normalize(own.quats, dim=-1)
    return Shape(skin_points(own.means, weights, transforms), skin_quats(rest, weights, quats), scales)


class GartTraining(SplatTraining):
    """The loop's body; the steps after `GartConfig.iterations` are the star's."""

    model: GartModel

    def __init__(
        self, model: GartModel, config: GartConfig, supervision: Supervision, generator: torch.Generator
    ) -> None:
        groups = {"turns": [model.poses.turns], "shifts": [model.poses.shifts], "skinning": [model.field.residual]}
        super().__init__(model, groups, config, supervision, generator)
        self.config = config
        self.refine = config.refine if isinstance(config, GartStarConfig) else None
        self.total += self.refine.steps * supervision.frames if self.refine else 0
        self.near: Tensor | None = None
        self.weights: Tensor | None = None

    def rate(self, name: str, progress: float) -> float:
        poses = self.config.poses
        if name == "skinning":
            start = poses.skinning_start
            return 0.0 if progress < start else exponential(*poses.skinning_rate, (progress - start) / (1 - start))
        return 0.0 if progress < poses.start else poses.rate * (OBJECT_DIAGONAL if name == "shifts" else 1.0)

    def changed(self) -> None:
        self.near = None

    def state(self) -> dict[str, Any]:
        return super().state() | {"near": self.near}

    def restore(self, state: Mapping[str, Any]) -> None:
        super().restore(state)
        # Looked up anew they would be those of today's places, not of the last change's.
        self.near = state["near"]

    def step(self, index: int) -> dict[str, float]:
        done = index - self.config.iterations
        return super().step(index) if done < 0 else self._refine_step(done)

    def losses(self, index: int) -> tuple[dict[str, Tensor], RasterInfo, Target]:
        config, model = self.config, self.model
        progress = index / config.iterations
        frame = int(torch.randint(self.supervision.frames, (), generator=self.generator))
        target = self.supervision.target(Key(1, 1, frame))
        learns = progress >= config.poses.skinning_start
        counts = learns and index % config.regularisers.every == 0
        if learns:
            weights, variation = model.field(model.gaussians.means.detach(), counts)
        else:
            weights, variation = model.field.still(model.gaussians.means), None
        shape = posed(model.gaussians, weights, *model.poses(frame))
        rgb, alpha, info = self.render(shape, target, progress)
        losses = self.image_losses(rgb, alpha, target) | self._alike()
        if counts and variation is not None:
            terms = config.regularisers
            losses["residual"] = terms.every * (terms.variation * variation + terms.norm * model.field.norm())
        return losses, info, target

    def _alike(self) -> dict[str, Tensor]:
        """Neighbours alike, and no Gaussian large."""
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
        """One step of SGD on the pose of one frame; white background, as the original's."""
        assert self.refine is not None
        frame, step = divmod(done, self.refine.steps)
        model = self.model
        if self.weights is None:
            self.weights = model.field.still(model.gaussians.means)
        target = self.supervision.target(Key(1, 1, frame))
        learned = (model.poses.turns, model.poses.shifts)
        shape = posed(model.gaussians, self.weights, *model.poses(frame))
        rgb, alpha, _ = self.render(shape, target, 1.0)
        loss = torch.stack(list(self.image_losses(rgb, alpha, target, plain=True).values())).sum()
        rate = self.refine.rate * 0.5 ** (step // self.refine.halve_every)
        for parameter, slope in zip(learned, torch.autograd.grad(loss, learned), strict=True):
            if not torch.isfinite(slope).all():
                raise FloatingPointError(
                    f"frame {frame}, refinement step {step}: the gradient of its pose is not finite"
                )
            parameter.data -= rate * slope
        return {"loss": float(loss.detach()), "frame": frame}


def spread(values: Tensor, near: Tensor) -> Tensor:
    """Mean standard deviation (unbiased) of attributes among neighbours, [n, c] and [n, k] -> scalar."""
    groups = values[near]
    apart = groups - groups.mean(dim=1, keepdim=True)
    return (apart.square().sum(dim=1) / max(1, near.shape[1] - 1) + 1e-12).sqrt().mean()


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
        """The Gaussians at a time in seconds in the world; between frames the joints' rotations slerp."""
        position = self.root.position(time)
        shape = posed(self.gaussians, self.weights, *self.poses.between(position))
        return self.root.in_world(splats_of(self.gaussians, *shape), position)

    def camera(self, time: float) -> Camera | None:
        """The input camera of the frame nearest to a time."""
        return self.root.camera(time)

    def canonical(self) -> Splats:
        """The Gaussians at rest, in the object frame; `weights` belong to the same rows."""
        return self.gaussians.splats()

    def diagnostics(self) -> dict[str, float]:
        """How many Gaussians there are, how opaque, and how far poses went from the prior's."""
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


class Gart:
    """The method on the prior's skeleton (contracts.Method)."""

    name: ClassVar[str] = "gart"
    info: ClassVar[MethodInfo] = MethodInfo(
        title="GART (20 bones)", paper=PAPER, licence="MIT (written anew from the paper)"
    )
    Config: ClassVar[type[GartConfig]] = GartConfig

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
        poses = prior_poses(template, match_times(clip, prior))
        model = GartModel(gaussians, ResidualField(template, config.skinning), poses).to(device)
        training = GartTraining(model, config, supervision, generator)
        with torch_on_one():
            run_steps(training, f"{self.name} {fit_digest(config, clip, template, seed)}", log, workdir)
        weights = model.field.still(model.gaussians.means)
        return GartReconstruction(model.gaussians, weights, model.poses, config, Root.of(clip, prior))

    def load(self, folder: Path, device: torch.device) -> GartReconstruction:
        """Read back what `GartReconstruction.save` wrote."""
        state, config = load_state(folder, self.name, self.Config)
        gaussians = gaussians_from_state(state["model"], config.canonical.max_scale)
        gaussians.blur.copy_(state["model"]["gaussians.blur"])
        saved: dict[str, Any] = state["poses"]
        poses = PoseTable(saved["quats"], saved["offsets"], saved["pivots"], state["parents"])
        poses.load_state_dict(saved)
        root = Root.from_state(state["root"])
        return GartReconstruction(gaussians.to(device), state["weights"].to(device), poses.to(device), config, root)


class GartStar(Gart):
    """The method with poses refined on the scored moments (contracts.Method)."""

    name: ClassVar[str] = "gart-star"
    info: ClassVar[MethodInfo] = MethodInfo(
        title="GART* (20 bones)",
        paper=PAPER,
        licence="MIT (written anew from the paper)",
        mark="poses fitted once more to each input image",
    )
    Config: ClassVar[type[GartConfig]] = GartStarConfig
