"""Settings that follow the length of a clip, and schedules as functions of progress in [0, 1]."""

import math
from typing import Any, TypeVar

import msgspec

from rewild4d.ours.config import Config

C = TypeVar("C", bound=msgspec.Struct)


def for_clip(config: C, frames: int) -> C:
    """Raise the iterations of any method's config to ``steps_per_frame`` times the frames of a clip."""
    own: Any = config
    return msgspec.structs.replace(config, iterations=max(own.iterations, own.steps_per_frame * frames))


def for_clip_of_ours(config: Config, frames: int, *, filmed: bool = False, one_sided: bool = False) -> Config:
    """Resolve settings for a clip: fewer steps if short, a finer time code if long, `OneSide` if all frames see the
    animal from one side, and then `Footage` if its cameras are unknown.

    The result stays the same for a clip of any length.
    """
    if one_sided and config.one_side.when in (("always",) if filmed else ("always", "known")):
        config = _for_one_side(config)
    config = _for_footage(config) if filmed and config.footage.use else config
    config = _for_short(config) if frames <= config.short_frames else config
    pose = config.pose
    doublings = math.log2(frames / pose.octave_frames) if pose.octave_frames else 0.0
    pose = msgspec.structs.replace(pose, frequencies=pose.frequencies + max(0, round(doublings)), octave_frames=0)
    return for_clip(msgspec.structs.replace(config, short_frames=0, pose=pose), frames)


def _for_footage(config: Config) -> Config:
    own, prior, replace = config.footage, config.prior, msgspec.structs.replace
    blend, pull = prior.blend if own.blend is None else own.blend, prior.pull if own.pull is None else own.pull
    return replace(
        config,
        steps_per_frame=own.steps_per_frame,
        geometry=replace(config.geometry, temporal=own.temporal, rigid=own.rigid),
        prior=replace(prior, blend=blend, pull=pull, pull_until=own.pull_until),
        pose=replace(config.pose, turns=own.turns, search_limbs=own.search_limbs),
        rates=replace(config.rates, pose=own.pose, deform=own.deform, turns=own.turns_rate),
        cameras=own.cameras,
        footage=replace(own, use=False),
    )


def _for_one_side(config: Config) -> Config:
    own, replace = config.one_side, msgspec.structs.replace
    canonical = {"samples": own.samples, "thickness": own.thickness, "opacity": own.opacity, "max_scale": own.max_scale}
    return replace(
        config,
        canonical=replace(config.canonical, **canonical),
        prior=replace(config.prior, pull=own.pull, pull_until=own.pull_until, untold=own.untold),
        pose=replace(config.pose, turns=own.turns),
        geometry=replace(config.geometry, temporal=own.temporal, stray=own.stray),
        rates=replace(config.rates, colors_epsilon=own.colors_epsilon),
        density=replace(config.density, cap=own.cap),
        skin=own.skin,
        one_side=replace(own, when="never"),
    )


def _for_short(config: Config) -> Config:
    """Take the steps of a short clip; what the paper counts in steps ends at the same step."""
    steps, replace = min(config.iterations, config.short_iterations), msgspec.structs.replace
    longer = config.iterations / steps
    prior, geometry = config.prior, config.geometry
    ends = {"blend_until": prior.blend_until * longer, "pull_until": prior.pull_until * longer}
    return replace(
        config,
        iterations=steps,
        prior=replace(prior, **ends),
        geometry=replace(geometry, until=geometry.until * longer),
    )


def exponential(first: float, last: float, progress: float) -> float:
    """Interpolate geometrically."""
    return first * (last / first) ** min(max(progress, 0.0), 1.0)


def ramp(progress: float, start: float, end: float) -> float:
    """Rise linearly from zero at start to one at end."""
    if end <= start:
        return float(progress >= start)
    return min(max((progress - start) / (end - start), 0.0), 1.0)


def fade(progress: float, end: float) -> float:
    """Fall linearly from one to zero at end."""
    return 1.0 - ramp(progress, 0.0, end)


def rise_and_fall(progress: float) -> float:
    """Rise over the first tenth, and fall to zero over the last third: of a rate while poses are copied."""
    return min(1.0, 0.01 + 10 * progress, 1.5 * (1 - progress))
