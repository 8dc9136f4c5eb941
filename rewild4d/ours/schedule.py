"""How long a fit is, and schedules as pure functions of its progress in [0, 1]."""

from typing import Any, TypeVar

import msgspec

C = TypeVar("C", bound=msgspec.Struct)


def for_clip(config: C, frames: int) -> C:
    """The config with enough steps for a clip.

    Args:
        config: with ``iterations`` and ``steps_per_frame``, of any method.
        frames: of the clip.
    """
    own: Any = config
    return msgspec.structs.replace(config, iterations=max(own.iterations, own.steps_per_frame * frames))


def exponential(first: float, last: float, progress: float) -> float:
    """From first to last, geometrically."""
    return first * (last / first) ** min(max(progress, 0.0), 1.0)


def ramp(progress: float, start: float, end: float) -> float:
    """Zero before start, one from end on, linear between."""
    if end <= start:
        return float(progress >= start)
    return min(max((progress - start) / (end - start), 0.0), 1.0)


def fade(progress: float, end: float) -> float:
    """One at the beginning, zero from end on, linear between."""
    return 1.0 - ramp(progress, 0.0, end)
