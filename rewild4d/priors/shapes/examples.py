"""Shapes to learn from: the quadruped, fitted to the masks of random animals that are seen from all around."""

import math
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from rewild4d.datasets.builtin.zoo.varied import VariedAnimal, draw_animal, draw_clip
from rewild4d.priors.bodies.quadruped import QUADRUPED
from rewild4d.priors.config import PriorConfig, Stage
from rewild4d.priors.fit import KnownCameras
from rewild4d.priors.hypotheses import Hypotheses
from rewild4d.priors.learned.drawing import draw
from rewild4d.priors.race import Steps
from rewild4d.priors.search import mask_rays, trajectory, working_frame
from rewild4d.transforms import look_at
from rewild4d.types import Camera, Frame

VIEWS, SIZE = 8, 112
"""Cameras around each moment, and the side of their pictures in pixels."""
MOMENTS = (0, 3, 6)
"""Frames of a clip that are seen."""
OPENING = math.radians(40.0)
"""Field of view of each camera."""
UP = torch.tensor((0.0, 1.0, 0.0), dtype=torch.float64)
"""In the frame of the animals' bodies."""
SETTINGS = PriorConfig(
    stages=(
        Stage(size=32, steps=40, blur=(0.08, 0.04), keep=1, joints=False),
        Stage(size=48, steps=80, blur=(0.05, 0.03), keep=1),
        Stage(size=64, steps=120, blur=(0.04, 0.015), keep=1),
        Stage(size=80, steps=180, blur=(0.02, 0.006), keep=1, frames=12, rasterized=True, relief=True),
    ),
    shape_weight=0.01,
    relief_weight=0.004,
    root_period=1,
)
"""Of a fit that all sides speak to, so that little has to be said of what is usual."""


@dataclass(frozen=True)
class Seen:
    """An animal in pictures.

    Attributes:
        frames: its masks under their cameras, `VIEWS` of each moment.
        moments: index of each frame's moment.
        ahead: mean direction of its trunk, [3].
    """

    frames: list[Frame]
    moments: list[int]
    ahead: Tensor


def drawn(rng: np.random.Generator) -> tuple[Tensor, float]:
    """Draw an animal; see `fitted`."""
    return fitted(seen(draw_animal(rng), rng))


def seen(animal: VariedAnimal, rng: np.random.Generator) -> Seen:
    """Show an animal at a few moments of a random clip to cameras around it."""
    transforms = draw_clip(animal, 24, rng)[list(MOMENTS)]
    posed = [animal.surface.posed(moved) for moved in transforms]
    middle = np.mean([vertices.mean(axis=0) for vertices in posed], axis=0)
    radius = max(float(np.linalg.norm(vertices - middle, axis=1).max()) for vertices in posed)
    frames, faces = [], animal.surface.faces.astype(np.int32)
    for moment, vertices in enumerate(posed):
        start = rng.uniform(0, 2 * math.pi)
        for view in range(VIEWS):
            camera = _camera(middle, radius, start + 2 * math.pi * view / VIEWS, math.radians(rng.uniform(-10, 50)))
            mask = _mask(vertices, faces, camera)
            frames.append(Frame(moment / 12, camera, mask.expand(3, -1, -1), mask))
    trunk = transforms[:, animal.skeleton.names.index("spine.1"), :3, 2].mean(axis=0)
    return Seen(frames, [moment for moment in range(len(posed)) for _ in range(VIEWS)], torch.from_numpy(trunk))


def _camera(middle: np.ndarray, radius: float, yaw: float, tilt: float) -> Camera:
    sight = np.array((math.sin(yaw) * math.cos(tilt), math.sin(tilt), math.cos(yaw) * math.cos(tilt)))
    center = torch.from_numpy(middle)
    eye = center + torch.from_numpy(sight) * radius / math.sin(OPENING / 2)
    focal = 0.95 * SIZE / 2 / math.tan(OPENING / 2)  # so that it keeps off the picture's edges
    intrinsics = torch.tensor(((focal, 0.0, SIZE / 2), (0.0, focal, SIZE / 2), (0.0, 0.0, 1.0)), dtype=torch.float64)
    return Camera(look_at(eye, center, UP), intrinsics, SIZE, SIZE)


def _mask(vertices: np.ndarray, faces: np.ndarray, camera: Camera) -> Tensor:
    pixels, depths = camera.project(torch.from_numpy(vertices))
    points = torch.cat((pixels / SIZE, depths[:, None]), dim=1).numpy().astype(np.float32)
    return torch.from_numpy(draw(points, faces, np.ones(len(points), np.float32), SIZE)[:1])


def fitted(shown: Seen) -> tuple[Tensor, float]:
    """Fit the quadruped to what is shown, its heading given.

    Returns:
        Its shape, proportions before relief, [P + 4 S], and the cost of the fit.
    """
    count = 1 + max(shown.moments)
    rays = mask_rays(shown.frames, shown.moments, "random animal")
    path = trajectory(rays, count)
    working = working_frame(rays, path, UP)
    steps = Steps(lambda *_: None, sum(stage.steps for stage in SETTINGS.stages))
    generator = torch.Generator().manual_seed(0)
    race = KnownCameras(shown.frames, shown.moments, "random animal", working, SETTINGS, generator, steps)
    ahead = torch.linalg.solve(working[:3, :3], shown.ahead)
    along, across = torch.nn.functional.normalize(ahead[[2, 0]], dim=0).tolist()
    facing = torch.tensor(((along, 0.0, across), (0.0, 1.0, 0.0), (-across, 0.0, along)))
    local = torch.linalg.solve(working[:3, :3], (path - working[:3, 3]).T).T
    race.begin(Hypotheses.start(QUADRUPED, facing[None], local.float(), SETTINGS.root_period))
    for stage in SETTINGS.stages:
        race.run(stage)
    return torch.cat((race.guesses.shape[0], race.guesses.relief[0].flatten())), float(race.costs[0])
