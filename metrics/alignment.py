"""Align point clouds by a similarity (7 degrees of freedom) with iterated closest points.

Matches go in both directions, because one-directional matching shrinks the source onto a few targets. The worst share
of them is left out, because floaters and missing parts bias the scale. The scale stays within a factor of two of a
robust start, and there are several starts, because an animal rotated by 180 degrees is a local minimum. A reflection is
never an alignment. Matches start from points that lie evenly on each cloud, because a denser part would otherwise
decide the size and the rotation.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import permutations, product
from typing import Any

import numpy as np
import torch
from torch import Tensor

from rewild4d.metrics.clouds import Points, as_points, check_paired, is_straight
from rewild4d.metrics.icp import Moment, Track, search
from rewild4d.metrics.similarity import Map, Similarity, Undetermined, fit_matched, scale_matched, umeyama

__all__ = [
    "Alignment", "Similarity", "Undetermined", "align", "align_scale", "align_sequence", "cube_starts", "umeyama",
    "yaw_starts",
]  # fmt: skip

TRIM = 0.1
"""Share of the matches, the longest of each direction, that a fit leaves out."""
SCALE_CLAMP = (0.5, 2.0)
"""Bounds of the scale as multiples of the robust start's."""


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
    scale: float | None = None,
    iterations: int = 100,
    tolerance: float = 1e-6,
    seed: int = 0,
    even: bool = True,
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
        scale: above zero; kept instead of fitted, so that 1 gives a rigid motion.
        iterations: limit of the last stage.
        tolerance: the last stage ends when its mean squared distance changes by less than this share.
        seed: of the draws of points.
        even: match points that lie evenly on each cloud (`clouds.even_rows`), whatever its density. False matches all
            points alike, as the first protocols do.

    Raises:
        Undetermined: no time has points of both, or those of a side lie on one line at every time.
        ValueError: unequal lengths, a NaN, no start or one that is no rotation, a setting out of its range.

    Examples:
        >>> points = torch.tensor([[0.0, 0, 0], [1, 0, 0], [0, 2, 0], [0, 0, 4]])
        >>> found = align_sequence([points, points + 1], [2 * points, 2 * points + 2], trim=0.0)
        >>> round(found.scale, 3)
        2.0
    """
    if not 0 <= trim < 1 or not 0 < scale_clamp[0] <= 1 <= scale_clamp[1]:
        raise ValueError(f"expected a trim in [0, 1) and a clamp around 1, got {trim} and {scale_clamp}")
    if scale is not None and not 0 < scale < np.inf:
        raise ValueError(f"expected a finite scale above zero, got {scale}")
    moments = _moments(sources, targets, even)
    for side, name in enumerate(("source", "target")):
        if all(is_straight(pair[side].all.points) for pair in moments):
            raise Undetermined(f"the {name}'s points lie on one line, so no rotation is unique")
    rotations = starts if starts is not None else cube_starts() if up is None else yaw_starts(up)
    if not rotations:
        raise ValueError("expected at least one start, got none")
    (source, size), (target, length) = (_middle([pair[side].queries for pair in moments]) for side in (0, 1))
    first = scale or (length / size if size > 0 and length > 0 else 1.0)
    bounds = (first, first) if scale else (scale_clamp[0] * first, scale_clamp[1] * first)

    def begin(start: Tensor) -> Map:
        rotation = _checked(start)
        return Map(first, rotation, target - first * rotation @ source)

    track = search(
        moments, {name: begin(start) for name, start in rotations.items()},
        lambda x, y, share: fit_matched(x, y, share, bounds)[0],
        trim=trim, seed=seed, iterations=iterations, tolerance=tolerance, least=(1e-12 * length) ** 2,
    )  # fmt: skip
    return _alignment(track, bounds)


def align_scale(
    sources: Sequence[Tensor], targets: Sequence[Tensor], center: Tensor, *, trim: float = TRIM, seed: int = 0
) -> Alignment:
    """Find the one scale about a point by which all times of a source fit those of a target best.

    One fixed camera cannot know it: a scene that is scaled about the camera's centre has the same images. Matches are
    those of `align_sequence`, from points that lie evenly on each cloud. The search starts at the ratio of the median
    distances from the point, at .8 and at 1.25 times it, and stays within a factor of two.

    Args:
        sources: one cloud a time, each [n, 3]; times where either cloud is empty are left out.
        targets: the same times, each [m, 3].
        center: the point that stays, [3].
        trim: share of each direction's matches, the longest, that do not count, in [0, 1).
        seed: of the draws of points.

    Returns:
        The similarity x -> center + scale * (x - center).

    Raises:
        Undetermined: no time has points of both, or half of a side lies at the point itself.
        ValueError: unequal lengths, a NaN.

    Examples:
        >>> points = torch.tensor([[0.0, 0, 4], [1, 0, 4], [0, 2, 5], [0, 0, 5]])
        >>> round(align_scale([points], [3 * points], torch.zeros(3)).scale, 3)
        3.0
    """
    origin = center.detach().cpu().double()
    moments = _moments([cloud.cpu() - origin for cloud in sources], [cloud.cpu() - origin for cloud in targets], True)
    near, far = (_distance([pair[side].queries for pair in moments]) for side in (0, 1))
    if not (near > 0 and far > 0):
        raise Undetermined("half of the points lie at the centre, so no scale about it is determined")
    begin, bounds = far / near, (SCALE_CLAMP[0] * far / near, SCALE_CLAMP[1] * far / near)
    still = np.zeros(3)
    track = search(
        moments, {f"ratio x {factor:g}": Map(factor * begin, np.eye(3), still) for factor in (1.0, 0.8, 1.25)},
        lambda x, y, share: Map(scale_matched(x, y, share, bounds), np.eye(3), still),
        trim=trim, seed=seed, iterations=100, tolerance=1e-9, least=(1e-12 * far) ** 2,
    )  # fmt: skip
    found = track.map._replace(translation=(1 - track.map.scale) * origin.numpy())
    return _alignment(track._replace(map=found), bounds)


def _moments(sources: Sequence[Tensor], targets: Sequence[Tensor], even: bool) -> list[tuple[Moment, Moment]]:
    """Check both sequences, and pair them at the times where both have points."""
    check_paired(sources, targets)
    x = [as_points(cloud, "source", empty=True) for cloud in sources]
    y = [as_points(cloud, "target", empty=True) for cloud in targets]
    both = [(Moment(a, even), Moment(b, even)) for a, b in zip(x, y, strict=True) if len(a) and len(b)]
    if not both:
        raise Undetermined("there is no moment at which both the source and the target have points")
    return both


def _alignment(track: Track, bounds: tuple[float, float]) -> Alignment:
    return Alignment(
        **vars(track.map.similarity()),
        start=track.name,
        iterations=track.iterations,
        converged=track.converged,
        clamped=bounds[0] < bounds[1] and track.map.scale in bounds,
        chamfer=track.chamfer,
        chamfer_kept=track.chamfer_kept,
    )


def _checked(start: Tensor) -> Points:
    rotation: Points = start.detach().cpu().double().numpy()
    if rotation.shape != (3, 3) or not np.allclose(rotation @ rotation.T, np.eye(3), atol=1e-6):
        raise ValueError(f"expected starts that are rotations [3, 3], got {rotation.tolist()}")
    if np.linalg.det(rotation) < 0:
        raise ValueError("expected starts that are rotations, got a reflection")
    return rotation


def _distance(clouds: Sequence[Points]) -> float:
    """Compute the median over time of the median distance from the origin."""
    return float(np.median([np.median(np.linalg.norm(points, axis=1)) for points in clouds]))


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
