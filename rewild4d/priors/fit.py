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
from rewild4d.priors.config import PriorConfig
from rewild4d.priors.hypotheses import Hypotheses
from rewild4d.priors.io import seal
from rewild4d.priors.kinematics import pose
from rewild4d.priors.proportions import Proportions
from rewild4d.priors.race import Race
from rewild4d.priors.search import facings, mask_rays, single_view, trajectory, up_directions, working_frame
from rewild4d.priors.silhouettes import overlap
from rewild4d.priors.template import PARENTS, diagonal, posed_prior, quadruped
from rewild4d.transforms import camera_in_object, similarity, skin_points
from rewild4d.types import OBJECT_DIAGONAL, Clip, Frame, Prior


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
    best: list[KnownCameras] = []
    for index, up in enumerate(ups):
        working = working_frame(rays, path, up)
        race = KnownCameras(frames, moments, name, working, config, generator, log, total)
        race.gaze = single_view(rays, working)
        race.done = index * config.stages[0].steps
        local = torch.linalg.solve(working[:3, :3], (path - working[:3, 3]).T).T
        race.begin(Hypotheses.start(facings(config.yaw_starts), local.float()))
        race.run(config.stages[0])
        best.append(race)
    starts = torch.cat([race.start_costs for race in best]).tolist()
    leader = min(best, key=lambda race: float(race.costs.min()))
    leader.figures |= {"starts": float(len(starts))} | {f"start_{k:02d}_cost": cost for k, cost in enumerate(starts)}
    leader.done = len(ups) * config.stages[0].steps
    for stage in config.stages[1:]:
        leader.run(stage)
    return leader.winner()


class KnownCameras(Race):
    """Hypotheses under one choice of the up direction.

    Attributes:
        gaze: the one direction in which all cameras look, in the working frame, [3]; None where there are several.
    """

    gaze: Tensor | None = None

    def evidence(self) -> Tensor | float:
        if self.gaze is None:
            return 0.0
        return self.config.view_weight * (self.guesses.heading() @ self.gaze).square()

    def winner(self) -> Animal:
        """Return the best guess in the world, with the rest mesh's diagonal scaled to the object frame's."""
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
    posed = skin_points(template.vertices, template.weights, transforms)
    quality = {"mask_iou": overlap(list(posed), template.faces, cameras, [f.mask for f in clip.frames])}
    times = torch.tensor(clip.times, dtype=torch.float64)
    return seal(
        posed_prior(
            template, transforms, animal.object_to_world, cameras, times, name=name, provenance=provenance,
            quality=quality | animal.figures,
        )
    )  # fmt: skip
