"""Pose warm-up: poses from blurred silhouettes while the Gaussians are frozen (METHOD section 11.3).

Silhouette gradients of Gaussians under a pixel are too local to move a limb; a shrinking blur is not.
"""

import math

import torch
from torch import Tensor, nn

from rewild4d.ours.config import Config
from rewild4d.ours.losses.images import blurred
from rewild4d.ours.losses.skeleton import neighbour_keys, skeleton_losses
from rewild4d.ours.model import Model
from rewild4d.ours.pose import pose_distance
from rewild4d.ours.schedule import rise_and_fall
from rewild4d.ours.symmetry import Key, Supervision
from rewild4d.priors.motion import sample_surface
from rewild4d.rasterizer import rasterize
from rewild4d.transforms import skin_points
from rewild4d.types import Prior

OPACITY = 0.9


class WarmUp:
    """The first stage: steps 0 .. regress-1 copy the prior's poses, the others follow silhouettes.

    Attributes:
        total: number of steps.
        optimizer: Adam over the pose network alone.
    """

    def __init__(
        self, model: Model, supervision: Supervision, prior: Prior, config: Config, generator: torch.Generator
    ) -> None:
        self.model, self.supervision, self.config = model, supervision, config
        self.generator = generator
        stage = config.warmup
        self.total = stage.regress + stage.iterations
        self.optimizer = torch.optim.Adam(model.network.parameters(), lr=stage.rate, fused=True)
        surface = sample_surface(prior, stage.samples, generator)
        self.points, self.scale = surface.points.to(model.pivots.device), surface.radius
        with torch.no_grad():
            self.weights = model.field.sample(model.field.probabilities(), self.points)

    def step(self, index: int) -> dict[str, float]:
        """Take one step; return the figures for the log."""
        stage = self.config.warmup
        progress = max(0.0, (index - stage.regress) / max(1, stage.iterations))
        self._set_rate(index)
        copied = index < stage.regress
        count = stage.copies if copied else stage.views
        keys = [self.supervision.draw(self.generator, cameras=self.config.cameras) for _ in range(count)]
        own, gaps = list(range(len(keys))), None
        if not copied:
            keys, own, gaps = neighbour_keys(keys, self.supervision.positions, self.config.geometry)
        pose = self.model.pose(self.supervision.code_times(keys), keys)
        distance = pose_distance(pose, *(part.to(pose.quats) for part in self.supervision.prior_pose(keys)))
        if copied:
            loss, figures = distance, {}
        else:
            transforms = self.model.transforms(pose)
            silhouette = torch.stack([self._silhouette(keys[row], transforms[row], progress) for row in own]).mean()
            loss = silhouette + stage.pull * (1 - progress) * distance
            loss = loss + skeleton_losses(self.model, pose, transforms, self.config.geometry, gaps)
            figures = {"silhouette": float(silhouette.detach())}
        self.optimizer.zero_grad(set_to_none=True)
        loss.backward()
        limit = self.config.rates.clip or math.inf
        nn.utils.clip_grad_norm_(self.model.network.parameters(), limit, error_if_nonfinite=True)
        self.optimizer.step()
        return {"loss": float(loss.detach()), "prior_distance": float(distance.detach())} | figures

    def _set_rate(self, index: int) -> None:
        """Raise the rate over the first tenth of each part and let it fall to zero; the second part drops the first's
        moments.

        The copy ends with tiny gradients, so Adam would answer the first silhouette with a step that undoes it.
        """
        stage = self.config.warmup
        copied = index < stage.regress
        progress = index / stage.regress if copied else (index - stage.regress) / stage.iterations
        rate = stage.regress_rate if copied else stage.rate
        if index == stage.regress:
            self.optimizer.state.clear()
        for group in self.optimizer.param_groups:
            group["lr"] = rate * rise_and_fall(progress)

    def _silhouette(self, key: Key, transforms: Tensor, progress: float) -> Tensor:
        """Compute L2 (per pixel of the animal's box) + Dice of blurred mattes."""
        target = self.supervision.target(key)
        camera = target.camera
        means = skin_points(self.points, self.weights, transforms)
        count = len(means)
        quats = means.new_tensor((1.0, 0, 0, 0)).expand(count, 4)
        scales, opacities = means.new_full((count, 3), self.scale), means.new_full((count,), OPACITY)
        _, alpha, _ = rasterize(
            means, quats, scales, opacities, means.new_zeros(count, 1),
            camera.world_to_camera[None], camera.intrinsics[None], camera.width, camera.height,
        )  # fmt: skip
        # Steps of a twentieth keep the number of blur matrices small.
        sigma = self.config.warmup.blur * target.side * (1 - math.floor(20 * progress) / 20)
        rendered, truth = (blurred(image[0], round(sigma, 1)) for image in (alpha[0], target.mask))
        l2 = (rendered - truth).square().sum() / target.side**2
        return l2 + 1 - (2 * (rendered * truth).sum() + 1) / (rendered.square().sum() + truth.square().sum() + 1)
