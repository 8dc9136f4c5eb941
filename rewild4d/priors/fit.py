"""Fit a template to masks under known cameras: similarity, proportions and poses over time.

The heading is a local minimum (animals look alike from head and tail), so many headings compete, and the best reversed
one is kept until joints and proportions have settled. Kinds of body compete until joints have been fitted once.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from rewild4d.contracts import Log
from rewild4d.priors.bodies.body import Body, Proportions, diagonal
from rewild4d.priors.bodies.quadruped import QUADRUPED
from rewild4d.priors.config import PriorConfig, without_colors
from rewild4d.priors.heading.reading import Headings, read_headings
from rewild4d.priors.heading.turning import along, turning
from rewild4d.priors.hypotheses import Hypotheses
from rewild4d.priors.io import seal
from rewild4d.priors.kinematics import pose
from rewild4d.priors.learned.evidence import PointEvidence, indices
from rewild4d.priors.learned.reading import read
from rewild4d.priors.posed import posed_prior
from rewild4d.priors.race import ONE_SIDE_HANDICAP, Race, Steps, decided, steps_of
from rewild4d.priors.search import (
    WIDE_BASELINE,
    facings,
    mask_rays,
    single_view,
    spread,
    trajectory,
    up_directions,
    working_frame,
)
from rewild4d.priors.silhouettes import known_camera, overlap
from rewild4d.priors.trained import UNTRAINED, Trained
from rewild4d.transforms import camera_in_object, similarity, skin_points
from rewild4d.types import OBJECT_DIAGONAL, Clip, Frame, Prior


@dataclass(frozen=True)
class Animal:
    """Result of a fit, before cameras are attached.

    Attributes:
        body: its kind.
        shape: body proportions.
        object_to_world: float64, [T, 4, 4], of the template scaled to `OBJECT_DIAGONAL`.
        angles: axis-angle vectors in radians, [T, J, 3].
        seen: what it was fitted to, for the provenance.
        figures: cost of the best guess, its lead over the opposite heading, and costs of the starts.
    """

    body: Body
    shape: Proportions
    object_to_world: Tensor
    angles: Tensor
    seen: str
    figures: dict[str, float]


def fit_template(
    clip: Clip, *, config: PriorConfig, seed: int, log: Log, trained: Trained = UNTRAINED,
    bodies: Sequence[Body] = (QUADRUPED,),
) -> Prior:  # fmt: skip
    """Fit the template to a clip's masks under its cameras and to what networks read in its pictures, then to its
    colours too where cameras see several sides.

    The seed is that of the frames drawn for each step. Of several ``bodies`` the one that fits best is taken. All
    guesses turn over time as a network reads in the pictures; where all cameras look one way they follow its headings
    too, and shapes learned from random animals.

    Returns:
        A prior with one pose per frame; `quality` has mask_iou, cost, facing_margin, turn (degrees), starts (their
        number), start_00_cost, ... (after the first stage), and of several bodies the figures of `decided`.

    Raises:
        UserError: a frame has no camera, or no mask shows anything.
    """
    count = len(clip.frames)
    animal = fit_animal(clip.frames, range(count), count, clip.name, config, seed, log, trained, bodies)
    points = " and to points of the body that a network finds in them" if trained.points else ""
    provenance = (
        f"Template ({animal.body.name}) fitted to {animal.seen} of the clip's {count} frames{points} "
        f"under known cameras, seed {seed}."
    )
    return make_prior(animal, clip, "learned" if trained.points else "template", provenance)


def fit_animal(
    frames: Sequence[Frame], timesteps: Sequence[int], count: int, name: str, config: PriorConfig, seed: int, log: Log,
    trained: Trained = UNTRAINED, bodies: Sequence[Body] = (QUADRUPED,),
) -> Animal:  # fmt: skip
    """Fit the template to frames of ``count`` times; ``timesteps`` are indices of their times.

    There may be any number of each time; for the network of points one, in their order.
    """
    rays = mask_rays(frames, timesteps, name)
    if spread(rays.directions) < WIDE_BASELINE:  # from one side colours say nothing of depth
        config = without_colors(config)
    path = trajectory(rays, count)
    ups = up_directions(rays, config.elevations)
    steps = Steps(log, len(bodies) * len(ups) * config.stages[0].steps + steps_of(config.stages[1:], len(bodies)))

    def leader(body: Body) -> KnownCameras:
        """Return the best race of a body over the first stage, one for each up direction."""
        generator = torch.Generator().manual_seed(seed)
        races: list[KnownCameras] = []
        for up in ups:
            working = working_frame(rays, path, up)
            race = KnownCameras(frames, timesteps, name, working, config, generator, steps)
            race.view = single_view(rays, working)
            if race.view is not None:
                race.shapes, race.handicap = trained.shapes_of(body), ONE_SIDE_HANDICAP
            local = torch.linalg.solve(working[:3, :3], (path - working[:3, 3]).T).T
            if trained.points is not None:
                race.said = PointEvidence.of(read(frames, timesteps, up, name, trained.points), working)
            guesses = Hypotheses.start(body, facings(config.yaw_starts), local.float(), config.root_period)
            if trained.headings is not None:
                found = read_headings(frames, timesteps, up, name, trained.headings).in_frame(working)
                guesses.turn = turning(found, count, math.radians(config.least_turn))
                race.headings = along(found, guesses.turn) if race.view is not None else None
                race.figures["turn"] = math.degrees(float(guesses.turn.max() - guesses.turn.min()))
            race.begin(guesses)
            race.run(config.stages[0])
            races.append(race)
        starts = torch.cat([race.start_costs for race in races]).tolist()
        best = min(races, key=lambda race: float(race.costs.min()))
        best.figures |= {"starts": float(len(starts))} | {f"start_{k:02d}_cost": cost for k, cost in enumerate(starts)}
        return best

    return decided([leader(body) for body in bodies], config.stages[1:]).winner()


class KnownCameras(Race):
    """Hypotheses under one choice of the up direction.

    Attributes:
        view: the one direction in which all cameras look, in the working frame, [3]; None where there are several.
        said: points that the network found; None without it.
        headings: that a network read, where cameras look one way; None without it.
    """

    view: Tensor | None = None
    headings: Headings | None = None
    said: PointEvidence | None = None

    def evidence(self) -> Tensor | float:
        cost: Tensor | float = 0.0
        if self.view is not None:
            cost = self.config.view_weight * (self.guesses.heading() @ self.view).square()
        if self.headings is not None:
            cost = cost + self.config.heading_weight * self.headings.distance(self.guesses.roots()[..., :3, 2])
        if self.said is not None:
            cost = cost + self.config.points_weight * self.said.distance(self.guesses.points(*indices()))
        return cost

    def winner(self) -> Animal:
        """Return the best guess in the world, with the rest mesh's diagonal scaled to the object frame's."""
        best = self.guesses.select(self.costs.argmin()[None])
        shape = Proportions(best.shape[0], best.relief[0])
        rest = best.body.build(shape, unit=False).vertices
        size = best.scales().double()[0] * diagonal(rest).double() / OBJECT_DIAGONAL
        roots = best.roots().double()[0]
        local = similarity(size.expand(len(roots)), roots[:, :3, :3], roots[:, :3, 3])
        figures = {"cost": float(self.costs.min()), **self.figures}
        seen = "masks and colours" if any(stage.colors for stage in self.config.stages) else "masks"
        seen += ", and to headings that a network reads," if self.headings is not None else ""
        seen += ", turning as a network reads," if self.headings is None and bool(best.turn.any()) else ""
        seen += " near the shapes of random animals" if self.shapes is not None else ""
        return Animal(best.body, shape, self.working @ local, best.joint_angles()[0], seen, figures)


def make_prior(animal: Animal, clip: Clip, name: str, provenance: str) -> Prior:
    """Attach the clip's cameras and the mirrored half, and measure the mask IoU."""
    template = animal.body.build(animal.shape)
    transforms = pose(animal.angles, template.bones[:, 0], template.parents)
    cameras = [
        camera_in_object(known_camera(frame, clip.name), matrix)
        for frame, matrix in zip(clip.frames, animal.object_to_world, strict=True)
    ]
    posed = skin_points(template.vertices, template.weights, transforms)
    quality = {"mask_iou": overlap(list(posed), template.faces, cameras, [f.mask for f in clip.frames])}
    times = torch.tensor(clip.times, dtype=torch.float64)
    return seal(
        posed_prior(
            template, transforms, animal.object_to_world, cameras, times, name=name, provenance=provenance,
            quality=quality | animal.figures,
        )
    )  # fmt: skip
