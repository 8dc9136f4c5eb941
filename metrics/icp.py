"""Find a map between two sequences of clouds by iterated closest points: matches both ways, never between two times."""

from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from rewild4d.metrics.clouds import Cloud, Points, even_rows
from rewild4d.metrics.similarity import Map

QUERIES = 20_000
"""Points of each side, over all times, that the last stage matches; of more, so many are drawn by the seed."""
COARSE_FRAMES = 8
"""Times of a sequence, evenly spaced, that the stages before the last use."""

Fit = Callable[[Points, Points, Points], Map]
"""(source [k, 3], target [k, 3], share [k]) -> the best map of its kind between matched points."""


class Track(NamedTuple):
    """State of one start; see `alignment.Alignment` for its figures."""

    name: str
    map: Map
    iterations: int
    converged: bool
    chamfer: float
    chamfer_kept: float


class _Matches(NamedTuple):
    """Kept pairs, [k, 3] each, their weights [k], mean squared distance, and the Chamfer of all and of these."""

    source: Points
    target: Points
    share: Points
    error: float
    chamfer: float
    chamfer_kept: float


class _Stage(NamedTuple):
    """Points and limits of one stage, and how many starts go on to the next."""

    queries: int
    iterations: int
    tolerance: float
    keep: int


class Moment:
    """One side at one time: all points, that are matched to, and those that are matched.

    Examples:
        >>> line = np.linspace(0, 1, 5)[:, None] * np.array([1.0, 0, 0])
        >>> len(Moment(np.concatenate((line, line)), even=True).queries)
        5
    """

    def __init__(self, points: Points, even: bool) -> None:
        self.all = Cloud(points)
        self.queries = points[even_rows(points)] if even else points


def search(
    moments: list[tuple[Moment, Moment]],
    starts: Mapping[str, Map],
    fit: Fit,
    *,
    trim: float,
    seed: int,
    iterations: int,
    tolerance: float,
    least: float,
) -> Track:
    """Run all starts on few points, the best few on more, and the best one on up to `QUERIES` a side.

    Args:
        moments: source and target at each time.
        starts: by name.
        fit: the best map between matched points.
        trim: share of each direction's matches, the longest, that do not count.
        seed: of the draws of points.
        iterations: limit of the last stage.
        tolerance: the last stage ends when its mean squared distance changes by less than this share.
        least: a change of the mean squared distance that is none.
    """
    tracks = [Track(name, found, 0, False, np.inf, np.inf) for name, found in starts.items()]
    last = _Stage(QUERIES, iterations, tolerance, 1)
    for stage in (_Stage(300, 20, 1e-3, 4), _Stage(1000, 60, 1e-4, 1), last):
        matcher = _Matcher(moments, stage.queries, None if stage is last else COARSE_FRAMES, seed)
        done = [_run(track, matcher, stage, fit, trim, least) for track in tracks]
        tracks = sorted(done, key=lambda track: track.chamfer_kept)[: stage.keep]
    return tracks[0]


def _run(track: Track, matcher: "_Matcher", stage: _Stage, fit: Fit, trim: float, least: float) -> Track:
    """Match and fit until the squared distance stays the same."""
    found, previous = track.map, np.inf
    for count in range(stage.iterations + 1):
        got = matcher.matches(found, trim)
        still = abs(previous - got.error) <= stage.tolerance * got.error + least
        if still or count == stage.iterations:
            break
        found = fit(got.source, got.target, got.share)
        previous = got.error
    return Track(track.name, found, track.iterations + count, still, got.chamfer, got.chamfer_kept)


class _Matcher:
    """Matches of some points of each time, drawn once, with all points of the other side."""

    def __init__(self, moments: Sequence[tuple[Moment, Moment]], queries: int, frames: int | None, seed: int) -> None:
        kept = min(len(moments), frames or len(moments))
        chosen = [moments[round(i)] for i in np.linspace(0, len(moments) - 1, kept)]
        rng = np.random.default_rng(seed)
        each = max(1, queries // kept)
        self._pairs = [(source.all, target.all) for source, target in chosen]
        self._drawn = [tuple(_draw(side.queries, each, rng) for side in pair) for pair in chosen]

    def matches(self, found: Map, trim: float) -> _Matches:
        """Find the matches under a map."""
        forward: list[tuple[Points, Points, Points]] = []
        backward: list[tuple[Points, Points, Points]] = []
        for (source, target), (x, y) in zip(self._pairs, self._drawn, strict=True):
            distances, nearest = target.nearest(found(x))
            forward.append((x, nearest, distances))
            # A similarity keeps the order of distances, so the source's own tree serves every iteration.
            distances, nearest = source.nearest(found.inverse(y))
            backward.append((nearest, y, found.scale * distances))
        kept, means = [], []
        for direction in (forward, backward):
            x, y, distances = (np.concatenate(part) for part in zip(*direction, strict=True))
            means.append(float(distances.mean()))
            count = max(1, round((1 - trim) * len(distances)))
            near = np.argpartition(distances, count - 1)[:count]
            kept.append((x[near], y[near], np.full(count, 0.5 / count), distances[near]))
        x, y, share, distances = (np.concatenate(part) for part in zip(*kept, strict=True))
        return _Matches(x, y, share, float(share @ distances**2), sum(means) / 2, float(share @ distances))


def _draw(points: Points, count: int, rng: np.random.Generator) -> Points:
    rows: NDArray[np.intp] = rng.permutation(len(points))[:count]
    return points[np.sort(rows)]
