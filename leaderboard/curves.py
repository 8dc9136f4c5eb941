"""Curves over time as inline SVG: no script, no font, no file of its own."""

import html
import re
import statistics
from collections import defaultdict
from collections.abc import Sequence
from itertools import count

from rewild4d.metrics.score import Score

WIDTH, HEIGHT = 360, 170
LEFT, RIGHT, TOP, BOTTOM = 46, 8, 22, 24
"""Margins in the picture's units."""
MOMENT = re.compile(r" at (-?[0-9.]+) s$")


def times_of(score: Score, items: Sequence[str]) -> list[float]:
    """Tell the time of each value of a score, in seconds; nothing where the items do not say.

    Args:
        score: with a value per item.
        items: labels of the items ("view 3 at 0.0417 s"); a score that has as many values as there are different
            moments is taken to have one at each of them.
    """
    times = [float(found[1]) for found in map(MOMENT.search, items) if found]
    moments = sorted(set(times))
    if len(score.per_item) == len(times) == len(items):
        return times
    return moments if len(score.per_item) == len(moments) else []


def moments(score: Score, items: Sequence[str]) -> list[tuple[float, list[float]]]:
    """Group the values of a score by their moments, in the order of time; see `times_of`.

    Where the items do not say the time, values are counted from 0.
    """
    found: dict[float, list[float]] = defaultdict(list)
    for time, value in zip(times_of(score, items) or map(float, count()), score.per_item, strict=False):
        if value is not None:
            found[time].append(value)
    return sorted(found.items())


def curve(title: str, points: Sequence[tuple[float, list[float]]]) -> str:
    """Draw the mean over the values of a moment as a line, lowest to highest as a band.

    Args:
        title: of the picture.
        points: (time, values), at least two.
    """
    times = [time for time, _ in points]
    everything = [value for _, values in points for value in values]
    low, high = min(everything), max(everything)
    span = (high - low) or 1.0
    length = (times[-1] - times[0]) or 1.0

    def place(time: float, value: float) -> str:
        x = LEFT + (WIDTH - LEFT - RIGHT) * (time - times[0]) / length
        y = HEIGHT - BOTTOM - (HEIGHT - TOP - BOTTOM) * (value - low) / span
        return f"{x:.1f},{y:.1f}"

    line = " ".join(place(time, statistics.fmean(values)) for time, values in points)
    upper = [place(time, max(values)) for time, values in points]
    lower = [place(time, min(values)) for time, values in reversed(points)]
    bottom = HEIGHT - BOTTOM
    name = html.escape(title)
    return (
        f'<svg viewBox="0 0 {WIDTH} {HEIGHT}" role="img" aria-label="{name}, {low:.4g} to {high:.4g}">'
        f'<text class="title" x="{LEFT}" y="14">{name}</text>'
        f'<path class="axis" d="M{LEFT},{TOP}V{bottom}H{WIDTH - RIGHT}" fill="none"/>'
        f'<text x="{LEFT - 5}" y="{TOP + 8}" text-anchor="end">{high:.3g}</text>'
        f'<text x="{LEFT - 5}" y="{bottom}" text-anchor="end">{low:.3g}</text>'
        f'<text x="{LEFT}" y="{HEIGHT - 8}">{times[0]:.3g}</text>'
        f'<text x="{WIDTH - RIGHT}" y="{HEIGHT - 8}" text-anchor="end">{times[-1]:.3g} s</text>'
        f'<polygon class="band" points="{" ".join(upper + lower)}"/>'
        f'<polyline class="mean" points="{line}"/></svg>'
    )
