"""Align point clouds by a similarity (7 degrees of freedom) with iterated closest points.

Matches go in both directions, because one-directional matching shrinks the source onto a few targets. The worst share
of them is left out, because floaters and missing parts bias the scale. The scale stays within a factor of two of a
robust start, and there are several starts, because an animal rotated by 180 degrees is a local minimum. A reflection is
never an alignment.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import permutations, product
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from rewild4d.metrics.clouds import Cloud, Points, as_points, check_paired, is_straight
from rewild4d.metrics.similarity import Map, Similarity, Undetermined, fit_matched, umeyama

__all__ = ["Alignment", "Similarity", "Undetermined", "align", "align_sequence", "cube_starts", "umeyama", "yaw_starts"]

TRIM = 0.1
"""Share of the matches, the longest of each direction, that a fit leaves out."""
SCALE_CLAMP = (0.5, 2.0)
"""Bounds of the scale as multiples of the robust start's."""
QUERIES = 20_000
"""Points of each side, over all times, that the last stage matches; of more, so many are drawn by the seed."""
COARSE_FRAMES = 8
"""Times of a sequence, evenly spaced, that the stages before the last use."""


@dataclass(frozen=True)
class Alignment(Similarity):
    """The similarity that maps a source to a target, and how it was found.

    Attributes:
        start: name of the start that won.
        iterations: of the winner, over all stages.
        converged: whether the last stage ended before its limit of iterations.
        clamped: whether the scale is at a bound.
        chamfer: mean of the two directions' mean distances after the alignment, over all points that the last stage
            matched, in the target's unit.
        chamfer_kept: the same over the matches that ``trim`` keeps; the start with the lowest one wins.
    """

    start: str
    iterations: int
    converged: bool
    clamped: bool
    chamfer: float
    chamfer_kept: float


def yaw_starts(up: Tensor, count: int = 4) -> dict[str, Tensor]:
    """Return rotations about an axis by equal steps from zero.

    Args:
        up: any length above zero, [3].
        count: number of rotations.

    Returns:
        Name ("yaw 90") -> rotation, float64, [3, 3].

    Examples:
        >>> list(yaw_starts(torch.tensor([0.0, 1.0, 0.0])))
        ['yaw 0', 'yaw 90', 'yaw 180', 'yaw 270']
    """
    length = float(up.double().norm())
    if up.shape != (3,) or not 0 < length < float("inf"):
        raise ValueError(f"expected an up direction [3] that is not zero, got {up.tolist()}")
    x, y, z = (up.double().cpu() / length).tolist()
    cross = torch.tensor(((0, -z, y), (z, 0, -x), (-y, x, 0)), dtype=torch.float64)
    eye = torch.eye(3, dtype=torch.float64)
    rotations = {}
    for step in range(count):
        angle = torch.tensor(2 * np.pi * step / count, dtype=torch.float64)
        rotations[f"yaw {360 * step / count:g}"] = eye + angle.sin() * cross + (1 - angle.cos()) * cross @ cross
    return rotations


def cube_starts() -> dict[str, Tensor]:
    """Return the 24 rotations of a cube, for frames that share no axis: name ("cube 0" is none) -> float64, [3, 3].

    Examples:
        >>> len(cube_starts())
        24
    """
    rotations: dict[str, Tensor] = {}
    for order in permutations(range(3)):
        for signs in product((1.0, -1.0), repeat=3):
            matrix = torch.eye(3, dtype=torch.float64)[list(order)] * torch.tensor(signs, dtype=torch.float64)
            if float(torch.linalg.det(matrix)) > 0:
                rotations[f"cube {len(rotations)}"] = matrix
    return rotations


def align(source: Tensor, target: Tensor, **settings: Any) -> Alignment:
    """Align one cloud to another: `align_sequence` of one time.

    Args:
        source: finite, [n, 3].
        target: finite, [m, 3].
        settings: keywords of `align_sequence`.

    Examples:
        >>> points = torch.tensor([[0.0, 0, 0], [1, 0, 0], [0, 2, 0], [0, 0, 4]])
        >>> found = align(points, 2 * points + 1, trim=0.0)
        >>> round(found.scale, 3), round(found.chamfer, 3)
        (2.0, 0.0)
    """
    return align_sequence([source], [target], **settings)


def align_sequence(
    sources: Sequence[Tensor],
    targets: Sequence[Tensor],
    *,
    up: Tensor | None = None,
    starts: Mapping[str, Tensor] | None = None,
    trim: float = TRIM,
    scale_clamp: tuple[float, float] = SCALE_CLAMP,
    iterations: int = 100,
    tolerance: float = 1e-6,
    seed: int = 0,
) -> Alignment:
    """Align all times of a source with those of a target by one similarity, by iterated closest points.

    Matches go both ways and never between two times; each direction has half of the weight. All starts run on few
    points, the best few on more, the best one on up to `QUERIES` a side. Deterministic.

    Args:
        sources: one cloud a time, each [n, 3]; times where either cloud is empty are left out.
        targets: the same times, each [m, 3].
        up: direction in the frame that the two share, [3]; the starts then rotate about it by 0, 90, 180 and 270
            degrees. Where None, the starts are the 24 rotations of a cube.
        starts: named rotations to start from instead, each [3, 3].
        trim: share of each direction's matches, the longest, that do not count, in [0, 1).
        scale_clamp: bounds of the scale as multiples of the robust start's.
        iterations: limit of the last stage.
        tolerance: the last stage ends when its mean squared distance changes by less than this share.
        seed: of the draws of points.

    Raises:
        Undetermined: no time has points of both, or those of a side lie on one line at every time.
        ValueError: unequal lengths, a NaN, no start or one that is no rotation, a setting out of its range.

    Examples:
        >>> points = torch.tensor([[0.0, 0, 0], [1, 0, 0], [0, 2, 0], [0, 0, 4]])
        >>> found = align_sequence([points, points + 1], [2 * points, 2 * points + 2], trim=0.0)
        >>> round(found.scale, 3)
        2.0
    """
    check_paired(sources, targets)
    if not 0 <= trim < 1 or not 0 < scale_clamp[0] <= 1 <= scale_clamp[1]:
        raise ValueError(f"expected a trim in [0, 1) and a clamp around 1, got {trim} and {scale_clamp}")
    x = [as_points(cloud, "source", empty=True) for cloud in sources]
    y = [as_points(cloud, "target", empty=True) for cloud in targets]
    both = [(a, b) for a, b in zip(x, y, strict=True) if len(a) and len(b)]
    if not both:
        raise Undetermined("there is no moment at which both the source and the target have points")
    for side, name in enumerate(("source", "target")):
        if all(is_straight(pair[side]) for pair in both):
            raise Undetermined(f"the {name}'s points lie on one line, so no rotation is unique")
    chosen = starts if starts is not None else cube_starts() if up is None else yaw_starts(up)
    if not chosen:
        raise ValueError("expected at least one start, got none")
    return _Search(both, trim, scale_clamp, seed).best(chosen, iterations, tolerance)


class _Track(NamedTuple):
    """State of one start."""

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


def _middle(clouds: Sequence[Points]) -> tuple[Points, float]:
    """Return a centre [3] and a size that floaters do not move.

    The size is the median over time of the median distance from each time's own median, so that the animal's walk
    does not count. The centre is the mean of the points within three sizes of it.
    """
    medians = [np.median(points, axis=0) for points in clouds]
    radii = [np.linalg.norm(points - middle, axis=1) for points, middle in zip(clouds, medians, strict=True)]
    size = float(np.median([np.median(radius) for radius in radii]))
    near = [points[radius <= 3 * np.median(radius)] for points, radius in zip(clouds, radii, strict=True)]
    return np.mean([points.mean(axis=0) for points in near], axis=0), size


class _Search:
    """Iterated closest points over the times of a sequence."""

    def __init__(self, pairs: list[tuple[Points, Points]], trim: float, clamp: tuple[float, float], seed: int) -> None:
        self._clouds = [(Cloud(x), Cloud(y)) for x, y in pairs]
        self._trim, self._seed = trim, seed
        self._source, self._target = (_middle([pair[side] for pair in pairs]) for side in (0, 1))
        start = self._target[1] / self._source[1] if self._source[1] > 0 and self._target[1] > 0 else 1.0
        self._start_scale = start
        self._bounds = (clamp[0] * start, clamp[1] * start)

    def best(self, starts: Mapping[str, Tensor], iterations: int, tolerance: float) -> Alignment:
        tracks = [_Track(name, self._begin(rotation), 0, False, np.inf, np.inf) for name, rotation in starts.items()]
        last = _Stage(QUERIES, iterations, tolerance, 1)
        for stage in (_Stage(300, 20, 1e-3, 4), _Stage(1000, 60, 1e-4, 1), last):
            matcher = _Matcher(self._clouds, stage.queries, None if stage is last else COARSE_FRAMES, self._seed)
            done = [self._run(track, matcher, stage) for track in tracks]
            tracks = sorted(done, key=lambda track: track.chamfer_kept)[: stage.keep]
        won = tracks[0]
        return Alignment(
            **vars(won.map.similarity()),
            start=won.name,
            iterations=won.iterations,
            converged=won.converged,
            clamped=won.map.scale in self._bounds,
            chamfer=won.chamfer,
            chamfer_kept=won.chamfer_kept,
        )

    def _begin(self, start: Tensor) -> Map:
        """Map the source's centre and size to the target's under a rotation."""
        rotation = start.detach().cpu().double().numpy()
        if rotation.shape != (3, 3) or not np.allclose(rotation @ rotation.T, np.eye(3), atol=1e-6):
            raise ValueError(f"expected starts that are rotations [3, 3], got {rotation.tolist()}")
        if np.linalg.det(rotation) < 0:
            raise ValueError("expected starts that are rotations, got a reflection")
        return Map(self._start_scale, rotation, self._target[0] - self._start_scale * rotation @ self._source[0])

    def _run(self, track: _Track, matcher: "_Matcher", stage: _Stage) -> _Track:
        """Match and fit until the squared distance stays the same."""
        found, previous, least = track.map, np.inf, (1e-12 * self._target[1]) ** 2
        for count in range(stage.iterations + 1):
            got = matcher.matches(found, self._trim)
            still = abs(previous - got.error) <= stage.tolerance * got.error + least
            if still or count == stage.iterations:
                break
            found, _ = fit_matched(got.source, got.target, got.share, self._bounds)
            previous = got.error
        return _Track(track.name, found, track.iterations + count, still, got.chamfer, got.chamfer_kept)


class _Matcher:
    """Matches of some points of each time, drawn once, with all points of the other side."""

    def __init__(self, clouds: list[tuple[Cloud, Cloud]], queries: int, frames: int | None, seed: int) -> None:
        kept = min(len(clouds), frames or len(clouds))
        self._pairs = [clouds[round(i)] for i in np.linspace(0, len(clouds) - 1, kept)]
        rng = np.random.default_rng(seed)
        each = max(1, queries // kept)
        self._drawn = [tuple(_draw(cloud.points, each, rng) for cloud in pair) for pair in self._pairs]

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
