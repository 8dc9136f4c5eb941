"""Make a prior of known quality, for studies only: never the default, and named in the record.

The template is fitted to every view of each time, which fixes root and joints; then noise of a stated size is added.
"""

from collections.abc import Sequence
from dataclasses import replace

import torch

from rewild4d.contracts import Log
from rewild4d.priors.config import PriorConfig
from rewild4d.priors.fit import Animal, fit_animal, make_prior
from rewild4d.transforms import axis_angle_to_matrix
from rewild4d.types import OBJECT_DIAGONAL, Clip, Frame, Prior

JOINT_NOISE = 0.15
"""Standard deviation of every joint angle at noise 1, radians."""
ROTATION_NOISE = 0.05
"""Standard deviation of the root's rotation at noise 1, radians."""
SHIFT_NOISE = 0.01
"""Standard deviation of the root's position at noise 1, as a share of the rest diagonal."""
SHAPE_NOISE = 0.3
"""Standard deviation of every proportion at noise 1, in the spreads of the template's measures."""


def coarse_prior(
    clip: Clip, many_views: Sequence[Frame], *, noise: float, seed: int, config: PriorConfig, log: Log
) -> Prior:
    """Make a prior named "coarse-<noise>" with nearly the true root and joint angles, plus noise.

    Args:
        clip: gives the prior's frames and cameras.
        many_views: the held-out frames, with cameras; those at the clip's times are used.
        noise: factor of the standard deviations of this module.
        seed: of the noise and of the fit.
        config: of the fit.
        log: progress.
    """
    timestep_of = {round(time, 6): index for index, time in enumerate(clip.times)}
    seen = [*clip.frames, *(frame for frame in many_views if round(frame.time, 6) in timestep_of)]
    timesteps = [timestep_of[round(frame.time, 6)] for frame in seen]
    animal = fit_animal(seen, timesteps, len(clip.frames), clip.name, config, seed, log)
    provenance = f"Template fitted to all {len(seen)} views of the truth, noise {noise:g}, seed {seed}."
    return make_prior(_disturb(animal, noise, seed), clip, f"coarse-{noise:g}", provenance)


def _disturb(animal: Animal, noise: float, seed: int) -> Animal:
    """Add noise to joint angles, root motion and proportions."""
    generator = torch.Generator().manual_seed(seed)
    count = len(animal.angles)
    angles = JOINT_NOISE * noise * torch.randn(animal.angles.shape, generator=generator)
    rotations = ROTATION_NOISE * noise * torch.randn(count, 3, generator=generator)
    shifts = SHIFT_NOISE * OBJECT_DIAGONAL * noise * torch.randn(count, 3, generator=generator)
    shape = SHAPE_NOISE * noise * torch.randn(animal.shape.deviations.shape, generator=generator)
    moved = animal.object_to_world.clone()
    moved[:, :3, 3] += (moved[:, :3, :3] @ shifts.double()[..., None])[..., 0]
    moved[:, :3, :3] = moved[:, :3, :3] @ axis_angle_to_matrix(rotations.double())
    return replace(
        animal,
        shape=replace(animal.shape, deviations=animal.shape.deviations + shape),
        object_to_world=moved,
        angles=animal.angles + angles * (animal.body.spreads > 0),
    )
