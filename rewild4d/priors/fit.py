"""Fit the quadruped template to masks: similarity, facing, proportions and poses over time.

Masks and known cameras only. Facing is a local minimum (an animal seen from its head looks much like one seen from its
tail), so all turns compete and the reverse of the leader stays in the race until joints and proportions have settled.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from rewild4d.contracts import Log
from rewild4d.errors import UserError
from rewild4d.priors.config import PriorConfig, Stage
from rewild4d.priors.hypotheses import Hypotheses
from rewild4d.priors.io import seal
from rewild4d.priors.kinematics import pose
from rewild4d.priors.proportions import Proportions
from rewild4d.priors.search import (
    facings,
    mask_rays,
    match_areas,
    single_view,
    trajectory,
    up_directions,
    working_frame,
)
from rewild4d.priors.silhouettes import Targets, crop_targets, mismatch, overlap
from rewild4d.priors.template import MIRROR, PARENTS, diagonal, quadruped
from rewild4d.transforms import (
    camera_in_object,
    mirror_camera,
    mirror_transforms,
    similarity,
    skin_points,
)
from rewild4d.types import OBJECT_DIAGONAL, Clip, Frame, Prior

STILL_PARAMETERS = ("scale", "turn", "shift", "shape")


@dataclass(frozen=True)
class Animal:
    """The outcome of a fit, before cameras are attached.

    Attributes:
        shape: body proportions.
        object_to_world: float64, [T, 4, 4], of the template scaled to `OBJECT_DIAGONAL`.
        angles: axis-angle vectors in radians, [T, J, 3].
        figures: cost of the best guess, its lead over the opposite facing.
    """

    shape: Proportions
    object_to_world: Tensor
    angles: Tensor
    figures: dict[str, float]


def fit_template(clip: Clip, *, config: PriorConfig, seed: int, log: Log) -> Prior:
    """Fit the template to a clip's masks.

    Args:
        clip: frames with known world cameras; nothing else is looked at.
        config: every choice of the fit.
        seed: of the frames drawn for each step of a long clip.
        log: progress.

    Returns:
        A prior with one pose per frame; `quality` holds mask_iou, cost, facing_margin, starts (their number) and
        start_00_cost, ... (after the first stage).

    Raises:
        UserError: a frame has no camera, or no mask shows anything.
    """
    moments = list(range(len(clip.frames)))
    animal = fit_animal(clip.frames, moments, len(moments), clip.name, config, seed, log)
    provenance = f"Template fitted to the {len(moments)} masks of the clip under known cameras, seed {seed}."
    return make_prior(animal, clip, "template", provenance)


def fit_animal(
    frames: Sequence[Frame], moments: Sequence[int], count: int, name: str, config: PriorConfig, seed: int, log: Log
) -> Animal:
    """Fit the template to any number of observations of each of ``count`` moments."""
    rays = mask_rays(frames, moments, name)
    path = trajectory(rays, count)
    ups = up_directions(rays, config.elevations)
    total = len(ups) * config.stages[0].steps + sum(stage.steps for stage in config.stages[1:])
    generator = torch.Generator().manual_seed(seed)
    best: list[_Race] = []
    for index, up in enumerate(ups):
        working = working_frame(rays, path, up)
        race = _Race(frames, moments, name, working, single_view(rays, working), config, generator, log, total)
        race.done = index * config.stages[0].steps
        race.begin(path)
        race.run(config.stages[0])
        best.append(race)
    starts = torch.cat([race.start_costs for race in best]).tolist()
    leader = min(best, key=lambda race: float(race.costs.min()))
    leader.figures |= {"starts": float(len(starts))} | {f"start_{k:02d}_cost": cost for k, cost in enumerate(starts)}
    leader.done = len(ups) * config.stages[0].steps
    for stage in config.stages[1:]:
        leader.run(stage)
    return leader.winner()


def _spaced(targets: Targets, count: int) -> Targets:
    """At most ``count`` evenly spaced observations."""
    count = min(len(targets.masks), count)
    return targets.select(torch.linspace(0, len(targets.masks) - 1, count).round().long())


class _Race:
    """Hypotheses under one choice of the up direction."""

    def __init__(
        self,
        frames: Sequence[Frame],
        moments: Sequence[int],
        name: str,
        working: Tensor,
        gaze: Tensor | None,
        config: PriorConfig,
        generator: torch.Generator,
        log: Log,
        total: int,
    ) -> None:
        self.frames, self.moments, self.name = frames, moments, name
        self.working, self.gaze, self.config, self.generator = working, gaze, config, generator
        self.log, self.total, self.done = log, total, 0
        self.costs = self.start_costs = torch.zeros(0)
        self.figures: dict[str, float] = {}

    def begin(self, path: Tensor) -> None:
        """Line up all facings on the path, at the size that covers the masks' area."""
        local = torch.linalg.solve(self.working[:3, :3], (path - self.working[:3, 3]).T).T
        self.guesses = Hypotheses.start(facings(self.config.yaw_starts), local.float())
        match_areas(self.guesses, self._targets(self.config.stages[0].size), self.config.stages[0])

    def _targets(self, size: int) -> Targets:
        return crop_targets(self.frames, self.moments, self.working, size, self.name)

    def _draw(self, targets: Targets, count: int) -> Targets:
        """All observations, or a fresh sample of as many as a step may look at."""
        if len(targets.masks) <= count:
            return targets
        rows = torch.randperm(len(targets.masks), generator=self.generator)[:count]
        return targets.select(rows.sort().values)

    def _cost(self, targets: Targets, sigma: float, stage: Stage) -> Tensor:
        shape, relief, swing, root = self.guesses.penalties()
        config = self.config
        penalty = config.shape_weight * shape + config.relief_weight * relief
        penalty = penalty + config.angle_weight * swing + config.root_weight * root
        if self.gaze is not None:
            penalty = penalty + config.view_weight * (self.guesses.heading() @ self.gaze).square()
        return mismatch(self.guesses.silhouettes(targets, stage), targets, sigma) + penalty

    def run(self, stage: Stage) -> None:
        """One round of descent, then the cut."""
        targets = self._targets(stage.size)
        names = [*STILL_PARAMETERS, *("angles",) * stage.joints, *("relief",) * stage.relief]
        leaves = [getattr(self.guesses, name).detach().requires_grad_() for name in names]
        for name, leaf in zip(names, leaves, strict=True):
            setattr(self.guesses, name, leaf)
        optimizer = torch.optim.Adam(leaves, lr=self.config.learning_rate, betas=(0.9, 0.98))
        for step in range(stage.steps):
            share = step / max(stage.steps - 1, 1)
            optimizer.param_groups[0]["lr"] = self.config.learning_rate * (1 - 0.85 * share)
            sigma = stage.size * (stage.blur[0] + share * (stage.blur[1] - stage.blur[0]))
            cost = self._cost(self._draw(targets, stage.frames), sigma, stage)
            if not torch.isfinite(cost).all():
                raise FloatingPointError(f"{self.name}: the template fit's cost is not finite at step {step}: {cost}")
            optimizer.zero_grad()
            torch.autograd.backward(cost.sum(), inputs=leaves)
            optimizer.step()
            self.done += 1
            self.log(self.done, self.total, {"prior": float(cost.detach().min())})
        with torch.no_grad():
            self.costs = self._cost(_spaced(targets, 2 * stage.frames), stage.size * stage.blur[1], stage)
            if stage.joints:
                self.costs = self.costs + self.config.gait_weight * self.guesses.backward_gait()
        if not len(self.start_costs):
            self.start_costs = self.costs
        self._cut(stage.keep)

    def _cut(self, keep: int) -> None:
        """Keep the best, and the best that faces away from it while there is room."""
        order = self.costs.argsort()
        heads = self.guesses.heading().detach()
        away = [int(row) for row in order if heads[row] @ heads[order[0]] < 0]
        if away:
            self.figures["facing_margin"] = float(self.costs[away[0]] - self.costs[order[0]])
        kept = [int(row) for row in order[:keep]]
        if keep > 1 and away and away[0] not in kept:
            kept[-1] = away[0]
        rows = torch.tensor(kept)
        self.guesses, self.costs = self.guesses.select(rows), self.costs[rows]

    def winner(self) -> Animal:
        """The best guess in the world, with the rest mesh's diagonal scaled to the object frame's."""
        best = self.guesses.select(self.costs.argmin()[None])
        shape = Proportions(best.shape[0], best.relief[0])
        size = best.scales().double()[0] * diagonal(quadruped(shape, unit=False).vertices).double() / OBJECT_DIAGONAL
        roots = best.roots().double()[0]
        local = similarity(size.expand(len(roots)), roots[:, :3, :3], roots[:, :3, 3])
        figures = {"cost": float(self.costs.min()), **self.figures}
        return Animal(shape, self.working @ local, best.joint_angles()[0], figures)


def make_prior(animal: Animal, clip: Clip, name: str, provenance: str) -> Prior:
    """Attach the clip's cameras and the mirrored half, and measure the mask IoU."""
    template = quadruped(animal.shape)
    transforms = pose(animal.angles, template.bones[:, 0], PARENTS)
    cameras = []
    for frame, matrix in zip(clip.frames, animal.object_to_world, strict=True):
        if frame.camera is None:
            raise UserError(f"{clip.name}: expected a camera for every frame, but {frame.time:g} s has none.")
        cameras.append(camera_in_object(frame.camera, matrix))
    mirror = torch.tensor(MIRROR)
    posed = skin_points(template.vertices, template.weights, transforms)
    quality = {"mask_iou": overlap(list(posed), template.faces, cameras, [f.mask for f in clip.frames])}
    return seal(
        Prior(
            name=name,
            provenance=provenance,
            vertices=template.vertices,
            faces=template.faces,
            weights=template.weights,
            bones=template.bones,
            parents=torch.tensor(PARENTS),
            mirror=mirror,
            times=torch.tensor(clip.times, dtype=torch.float64),
            object_to_world=animal.object_to_world,
            cameras=tuple(cameras),
            transforms=transforms,
            cameras_flip=tuple(mirror_camera(camera) for camera in cameras),
            transforms_flip=mirror_transforms(transforms, mirror),
            quality=quality | animal.figures,
            digest="",
        )
    )
