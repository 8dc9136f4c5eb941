"""A prior of known quality, for studies that turn it like a knob: never the default, and named in the record.

The same fitter sees every view of each moment, which pins root and joints down for any skeleton; stated noise is added.
"""

from collections.abc import Sequence
from dataclasses import replace

import torch

from rewild4d.contracts import Log
from rewild4d.priors.config import PriorConfig
from rewild4d.priors.fit import Animal, fit_animal, make_prior
from rewild4d.priors.hypotheses import ANGLE_SPREADS
from rewild4d.transforms import axis_angle_to_matrix
from rewild4d.types import OBJECT_DIAGONAL, Clip, Frame, Prior

JOINT_NOISE = 0.15
"""Standard deviation of every joint angle at noise 1, radians."""
TURN_NOISE = 0.05
"""Standard deviation of the root's rotation at noise 1, radians."""
SHIFT_NOISE = 0.01
"""Standard deviation of the root's position at noise 1, as a share of the rest diagonal."""
SHAPE_NOISE = 0.3
"""Standard deviation of every proportion at noise 1, in spreads."""


def coarse_prior(
    clip: Clip, many_views: Sequence[Frame], *, noise: float, seed: int, config: PriorConfig, log: Log
) -> Prior:
    """Make the template with nearly the true root and joint angles, plus noise.

    Args:
        clip: what the method sees; the prior's frames and cameras are its.
        many_views: the held-out frames of the same moments, with cameras.
        noise: 0 adds nothing; 1 adds the standard deviations of this module.
        seed: of the noise and of the fit.
        config: of the fit.
        log: progress.

    Returns:
        A prior named "coarse-<noise>".
    """
    moment_of = {round(time, 6): index for index, time in enumerate(clip.times)}
    seen = [*clip.frames, *(frame for frame in many_views if round(frame.time, 6) in moment_of)]
    moments = [moment_of[round(frame.time, 6)] for frame in seen]
    animal = fit_animal(seen, moments, len(clip.frames), clip.name, config, seed, log)
    provenance = f"Template fitted to all {len(seen)} views of the truth, noise {noise:g}, seed {seed}."
    return make_prior(_disturb(animal, noise, seed), clip, f"coarse-{noise:g}", provenance)


def _disturb(animal: Animal, noise: float, seed: int) -> Animal:
    generator = torch.Generator().manual_seed(seed)
    moments, joints = animal.angles.shape[:2]
    angles = JOINT_NOISE * noise * torch.randn(moments, joints, 3, generator=generator)
    turns = TURN_NOISE * noise * torch.randn(moments, 3, generator=generator)
    shifts = SHIFT_NOISE * OBJECT_DIAGONAL * noise * torch.randn(moments, 3, generator=generator)
    shape = SHAPE_NOISE * noise * torch.randn(animal.shape.deviations.shape, generator=generator)
    moved = animal.object_to_world.clone()
    moved[:, :3, 3] += (moved[:, :3, :3] @ shifts.double()[..., None])[..., 0]
    moved[:, :3, :3] = moved[:, :3, :3] @ axis_angle_to_matrix(turns.double())
    return replace(
        animal,
        shape=replace(animal.shape, deviations=animal.shape.deviations + shape),
        object_to_world=moved,
        angles=animal.angles + angles * (ANGLE_SPREADS > 0),
    )
