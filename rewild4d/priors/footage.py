"""Fit a template to masks under unknown cameras.

Body proportions are shared by the clip and its mirrored copy; cameras and poses are fitted to each on its own. The
object frame is the world: `object_to_world` is the identity, and the cameras of the frames hold all motion.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from scipy.ndimage import gaussian_filter1d
from torch import Tensor

from rewild4d.contracts import Log
from rewild4d.priors.bodies.body import Body, Proportions, diagonal
from rewild4d.priors.bodies.quadruped import QUADRUPED
from rewild4d.priors.config import PriorConfig, Stage
from rewild4d.priors.heading.reading import Headings, read_headings
from rewild4d.priors.heading.turning import PACE, along, turning
from rewild4d.priors.io import seal
from rewild4d.priors.judge import measured
from rewild4d.priors.kinematics import pose
from rewild4d.priors.landmarks import Marks
from rewild4d.priors.learned.evidence import PointEvidence, indices
from rewild4d.priors.learned.reading import read
from rewild4d.priors.posed import posed_prior
from rewild4d.priors.race import Race, Steps, decided, steps_of
from rewild4d.priors.search import facings
from rewild4d.priors.silhouettes import require_mask
from rewild4d.priors.trained import UNTRAINED, Trained
from rewild4d.priors.views import FIELD_OF_VIEW, Views, fauna_camera, windows
from rewild4d.transforms import nearest_rotation, rigid
from rewild4d.types import OBJECT_DIAGONAL, Camera, Clip, Frame, Prior


@dataclass(frozen=True)
class Evidence:
    """Optional input of the fit besides the masks.

    Attributes:
        marks: keypoints in pixels of the clip's frames.
        travel: of the animal over the background, pixels (`Clip.travel`), [T - 1, 2].
    """

    marks: Marks | None = None
    travel: Tensor | None = None

    def __str__(self) -> str:
        """Name the parts for a sentence, each followed by a comma and a space."""
        points = "" if self.marks is None else f"with {len(self.marks)} keypoints, "
        return points + ("" if self.travel is None else "with the animal's travel, ")

    def mirrored(self, width: int) -> "Evidence":
        """Return the evidence of the horizontally flipped frames."""
        travel = None if self.travel is None else self.travel * self.travel.new_tensor((-1.0, 1.0))
        return Evidence(None if self.marks is None else self.marks.mirrored(width), travel)


NOTHING = Evidence()
UP = torch.tensor((0.0, 1.0, 0.0), dtype=torch.float64)
"""Of the frame in which Fauna's camera stands."""
ASCENT = 0.3
"""Motion up the image per motion away over the ground (sine of the camera's elevation, taken high: it is noisy)."""
NEAR = 0.04
"""Distance of a joint to its keypoint, in window sides, below which the cost is quadratic and above which linear."""


class FixedCamera(Race):
    """Hypotheses under Fauna's camera.

    Attributes:
        said: marks and travel.
        points: that a network found; None without one.
        headings: that a network read; None without one.
        turns: whether they tell of an animal that turns.
        boxes: windows of the frames, [T, 3].
        given: keep scale and proportions as they are.
    """

    said: Evidence
    boxes: Tensor
    guesses: Views
    points: PointEvidence | None = None
    headings: Headings | None = None
    turns: bool = False
    given: bool = False

    def free(self, stage: Stage) -> list[str]:
        names = super().free(stage)
        return [name for name in names if name not in ("scale", "shape", "relief")] if self.given else names

    def evidence(self) -> Tensor | float:
        cost = self.config.view_weight * self.guesses.roots()[..., 2, 2].mean(1).square()
        cost = cost + self.config.carriage_weight * self.guesses.carriage()
        if self.said.marks is not None and len(self.said.marks):
            cost = cost + self.config.keypoint_weight * self._off_marks(self.said.marks)
        if self.headings is not None:
            weight = self.config.turned_weight if self.turns else self.config.heading_weight
            cost = cost + weight * self.headings.distance(self.guesses.roots()[..., :3, 2])
        if self.points is not None:
            cost = cost + self.config.points_weight * self.points.distance(self.guesses.points(*indices()))
        return cost

    def _off_marks(self, found: Marks) -> Tensor:
        """Return the robust mean distance of joints to their keypoints, [B]."""
        boxes = self.boxes[found.frames]
        side = 2 * math.tan(FIELD_OF_VIEW / 2)
        wanted = (found.pixels - boxes[:, :2]) / boxes[:, 2:]
        distance = (self.guesses.projected(found) / side - wanted).square().sum(-1)
        return ((1 + distance / NEAR**2).sqrt() - 1).mean(-1)

    def verdict(self, stage: Stage) -> Tensor | float:
        return super().verdict(stage) + self.config.travel_weight * self._against_travel()

    def _against_travel(self) -> Tensor | float:
        """Return how far headings lie against (1) or along (-1) the motion over the ground, [B]."""
        if self.said.travel is None or not len(self.said.travel):
            return 0.0
        walked = self.said.travel / self.boxes[1:, 2:]
        # smoothed, since legs move the mask's centre up and down
        steps = torch.from_numpy(gaussian_filter1d(walked.numpy(), max(1.0, len(walked) / 12), axis=0, mode="nearest"))
        # motion up the image is motion away over the ground, seen from above
        ground = torch.stack((steps[:, 0], steps[:, 1] / ASCENT), dim=1)
        certainty = torch.tanh(2 * ground.sum(0).norm())
        along = (self.guesses.roots()[:, 1:, (0, 2), 2] * ground).sum((1, 2))
        return -certainty * along / ground.norm(dim=1).sum().clamp_min(1e-6)

    def run(self, stage: Stage) -> None:
        """Fit for one round; the fine ones start from every guess and its reflection in depth."""
        if stage.rasterized:
            self.guesses = self.guesses.with_depth_mirrored()
        super().run(stage)

    def rivals(self, order: list[int]) -> list[int]:
        """Return the best of each quadrant: head to the left or right, towards or away from the camera."""
        quadrants = (self.guesses.heading()[:, (0, 2)] > 0).tolist()
        best: dict[tuple[bool, ...], int] = {}
        for row in order:
            best.setdefault(tuple(quadrants[row]), row)
        return list(best.values())


def fit_footage(
    clip: Clip, *, config: PriorConfig, seed: int, log: Log, said: Evidence = NOTHING,
    trained: Trained = UNTRAINED, bodies: Sequence[Body] = (QUADRUPED,),
) -> Prior:  # fmt: skip
    """Fit the template to a clip's masks under unknown cameras, and to what networks read in its pictures.

    Shapes of random animals take no part: in films they move joints away (docs/experiments/headings.md).

    All guesses start with the turns that a network reads. Of several ``bodies`` the one that fits the clip best is
    taken. The seed is that of the frames drawn for each step of a long clip.

    Returns:
        A prior with one camera and pose per frame and for its mirror image; `quality` has the figures of
        `judge.measured`, cost, facing_margin (the lead of the best guess over the best that heads against it), turn
        (degrees, with a network), and of several bodies the figures of `decided`.

    Raises:
        UserError: no mask shows anything.
    """
    require_mask(clip.frames, clip.name)
    total = steps_of(config.stages, len(bodies)) + sum(stage.steps for stage in config.stages)
    steps = Steps(log, total)
    races = [_race(clip.name, clip.frames, said, config, seed, steps, body, trained) for body in bodies]
    race = decided(races, config.stages)
    flipped = tuple(replace(f, rgb=f.rgb.flip(-1), mask=f.mask.flip(-1)) for f in clip.frames)
    mirrored = said.mirrored(clip.frames[0].mask.shape[2])
    body = race.guesses.body
    race_flip = _race(clip.name, flipped, mirrored, config, seed, steps, body, trained, known=race.guesses)
    for stage in config.stages:
        race_flip.run(stage)
    return _prior(clip, race, race_flip, "learned" if trained.points else "template", seed)


def _race(
    case: str, frames: tuple[Frame, ...], said: Evidence, config: PriorConfig, seed: int, steps: Steps, body: Body,
    trained: Trained, known: Views | None = None,
) -> FixedCamera:  # fmt: skip
    """Return a race with all its starts; scale and proportions are those of ``known``, if given."""
    boxes = windows(frames)
    seen = [
        replace(frame, camera=fauna_camera(box, frame.mask.shape[2], frame.mask.shape[1]))
        for frame, box in zip(frames, boxes, strict=True)
    ]
    working, generator = torch.eye(4, dtype=torch.float64), torch.Generator().manual_seed(seed)
    race = FixedCamera(seen, range(len(frames)), case, working, config, generator, steps)
    race.said, race.boxes = said, boxes.float()
    if trained.points is not None:
        found = read(seen, range(len(seen)), UP, case, trained.points, known=False)
        race.points = PointEvidence.of(found, working)
    if trained.headings is not None:
        race.headings = read_headings(seen, range(len(seen)), UP, case, trained.headings, known=False)
    # known proportions need fewer starts
    count = config.yaw_starts if known is None else max(4, config.yaw_starts // 2)
    starts = Views.start(body, facings(count), torch.zeros(len(frames), 3), config.root_period)
    if race.headings is not None:
        turn = turning(race.headings, len(frames), math.radians(config.least_turn), PACE * _apart(frames))
        race.headings, race.turns = along(race.headings, turn), bool(turn.any())
        race.figures["turn"] = math.degrees(float(turn.max() - turn.min()))
        starts = starts.turned(turn)
    race.begin(starts)
    if known is not None:
        race.given = True
        rows = torch.zeros(len(starts), dtype=torch.long)
        for part in ("scale", "shape", "relief"):
            setattr(race.guesses, part, getattr(known, part)[rows])
    return race


def _apart(frames: tuple[Frame, ...]) -> float:
    """Return how far apart frames are, in 1/24 of a second; 1 for nearer ones."""
    times = torch.tensor([frame.time for frame in frames])
    return max(1.0, 24 * float(times.diff().median())) if len(times) > 1 else 1.0


def _prior(clip: Clip, race: FixedCamera, race_flip: FixedCamera, name: str, seed: int) -> Prior:
    """Return the prior of the fitted clip and its mirrored copy."""
    body, count = race.guesses.body, len(clip.frames)
    template = body.build(Proportions(race.guesses.shape[0], race.guesses.relief[0]))
    transforms, transforms_flip = (
        pose(half.guesses.joint_angles()[0], template.bones[:, 0], template.parents) for half in (race, race_flip)
    )
    quality: dict[str, float] = {}
    for suffix, half in (("", race), ("_flip", race_flip)):
        quality |= {f"{key}{suffix}": value for key, value in half.figures.items()}
        quality[f"cost{suffix}"] = float(half.costs.min())
    world, times = torch.eye(4, dtype=torch.float64).repeat(count, 1, 1), torch.tensor(clip.times, dtype=torch.float64)
    prior = posed_prior(
        template, transforms, world, object_cameras(race), times, name=name,
        provenance=f"Template ({body.name}) fitted to the {count} masks of the clip and of its mirror image, "
        f"{'and to headings that a network reads, ' if race.headings is not None else ''}"
        f"cameras unknown, {race.said}seed {seed}.",
    )  # fmt: skip
    prior = replace(prior, cameras_flip=object_cameras(race_flip), transforms_flip=transforms_flip)
    return seal(replace(prior, quality=quality | measured(prior, clip.frames)))


def object_cameras(race: FixedCamera) -> tuple[Camera, ...]:
    """Return the cameras of the best guess in the object frame, with a rest diagonal of `OBJECT_DIAGONAL`."""
    guesses = race.guesses
    size = guesses.scales()[0] * diagonal(guesses.template().vertices)[0]
    cameras = []
    for frame, root in zip(race.frames, guesses.roots()[0].double(), strict=True):
        assert frame.camera is not None
        moved = frame.camera.world_to_camera @ root
        # single precision leaves errors of 1e-7
        moved = rigid(nearest_rotation(moved[:3, :3]), moved[:3, 3] * (OBJECT_DIAGONAL / float(size)))
        cameras.append(replace(frame.camera, world_to_camera=moved))
    return tuple(cameras)
