"""Schedules as pure functions of the training's progress in [0, 1]."""


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
