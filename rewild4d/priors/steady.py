"""Filter frames whose camera is far from the others', as where the heading is reversed for a while.

DBSCAN (Ester et al. 1996) clusters the direction of the camera's centre and its translation; the largest cluster stays
(METHOD, section 2). The clip and its mirror image are filtered on their own, and a frame that is steady in one of them
is trained from that one (paper, "Robustness to Unstable Camera Estimation").
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from rewild4d.priors.io import seal
from rewild4d.priors.motion import pose_at
from rewild4d.transforms import mirror_camera, mirror_matrix
from rewild4d.types import Camera, Prior

EPS, NEIGHBOURS = 0.25, 3
"""DBSCAN's eps and min_samples (a point counts itself)."""
GAP = 2
"""Most missing frames in a row that are interpolated."""
SMOOTH = frozenset({"template", "learned"})
"""Names of priors whose cameras the fit moves smoothly: one that is far from the others tells of a fast turn."""
TRANSLATION_RANGE = 0.11
"""Range of Fauna's translation along the view over its camera's distance: 1.1 of 10 units."""


@dataclass(frozen=True)
class Filtered:
    """A prior without the frames whose camera was filtered out.

    Attributes:
        prior: with the kept rows; `Prior.steady` marks those that one sequence alone can be trained from.
        kept: rows of the original prior.
        notes: what was changed, a sentence each.
    """

    prior: Prior
    kept: tuple[int, ...]
    notes: tuple[str, ...]


def clusters(points: Tensor, eps: float = EPS, neighbours: int = NEIGHBOURS) -> Tensor:
    """Return the DBSCAN cluster of each point [n, d], from 0, -1 for noise, int64, [n]."""
    from sklearn.cluster import DBSCAN  # takes a second to import

    return torch.from_numpy(DBSCAN(eps=eps, min_samples=neighbours).fit_predict(points.numpy()))


def steady(cameras: Sequence[Camera], times: Tensor) -> Tensor:
    """Return which cameras, in the object frame, belong to the largest cluster, or all where there is none, bool, [T].

    Up to `GAP` missing frames between ``times`` (seconds, [T]), such as held-out ones, are interpolated.
    """
    matrices = torch.stack([camera.world_to_camera.double() for camera in cameras])
    centers = -(matrices[:, :3, :3].transpose(1, 2) @ matrices[:, :3, 3:])[..., 0]
    distance = matrices[:, 2, 3].median()
    shifts = (matrices[:, :3, 3] - matrices[:, :3, 3].median(0).values) / (TRANSLATION_RANGE * distance)
    features = torch.cat((torch.nn.functional.normalize(centers, dim=1), shifts), dim=1)
    labels = clusters(torch.cat((features, _between(features, times))))[: len(features)]
    if bool((labels < 0).all()):
        return torch.ones(len(cameras), dtype=torch.bool)
    return labels == labels[labels >= 0].mode().values


def _between(features: Tensor, times: Tensor) -> Tensor:
    """Interpolate points for up to `GAP` frames that are missing between neighbours, [m, d]."""
    gaps = times.diff()
    missing = (gaps / gaps.median()).round().long() - 1 if len(gaps) else gaps.long()
    parts = [
        torch.lerp(features[row], features[row + 1], k / (count + 1))
        for row, count in enumerate(missing.tolist())
        if count <= GAP
        for k in range(1, count + 1)
    ]
    return torch.stack(parts) if parts else features[:0]


def without_hops(prior: Prior) -> Filtered:
    """Remove frames whose camera is steady in neither sequence, and mark those that are steady in one alone.

    The other sequence's camera and pose of a marked frame become mirror images of the steady one's, so that every row
    can be rendered and interpolated; a fit is not trained from them. `object_to_world`, which belongs to the plain
    camera, is interpolated where that camera is not steady. A sequence in which less than half of the cameras agree is
    not filtered, and a note says so; nor is a `SMOOTH` prior.
    """
    if prior.name in SMOOTH:
        return Filtered(prior, tuple(range(len(prior.times))), ())
    plain, flipped = steady(prior.cameras, prior.times), steady(prior.cameras_flip, prior.times)
    count, undecided = len(plain), []
    for each, what in ((plain, ""), (flipped, "mirrored ")):
        if 2 * int(each.sum()) < count:
            share = f"{int(each.sum())} of {count}"
            undecided.append(f"no {what}camera left out: the largest group that agrees is {share} frames")
            each[:] = True
    kept, both = plain | flipped, plain & flipped
    rows = tuple(torch.nonzero(kept)[:, 0].tolist())
    sides = [(list(prior.cameras), prior.transforms.clone()), (list(prior.cameras_flip), prior.transforms_flip.clone())]
    for own, other, good in ((sides[0], sides[1], plain), (sides[1], sides[0], flipped)):
        for row in torch.nonzero(kept & ~good)[:, 0].tolist():
            own[0][row] = mirror_camera(other[0][row])
            own[1][row] = mirror_matrix(other[1][row, prior.mirror])
    smaller = replace(
        prior,
        times=prior.times[kept],
        object_to_world=_roots(prior, plain)[kept],
        cameras=tuple(sides[0][0][row] for row in rows),
        transforms=sides[0][1][kept],
        cameras_flip=tuple(sides[1][0][row] for row in rows),
        transforms_flip=sides[1][1][kept],
        steady=None if bool(both.all()) else torch.stack((plain, flipped))[:, kept],
    )
    changes = (
        (~kept, "left out: the camera is far from those of the other frames, and so is that of the mirror image"),
        (kept & ~plain, "trained from the mirrored sequence alone: the camera is far from those of the other frames"),
        (kept & ~flipped, "trained from the plain sequence alone: the camera of the mirrored one is far off"),
    )
    notes = [_told(torch.nonzero(which)[:, 0].tolist(), count, what) for which, what in changes if bool(which.any())]
    return Filtered(seal(smaller), rows, (*notes, *undecided))


def _roots(prior: Prior, good: Tensor) -> Tensor:
    """Interpolate object_to_world from the good rows to all, [T] -> [T, 4, 4]."""
    known = replace(
        prior,
        times=prior.times[good],
        object_to_world=prior.object_to_world[good],
        transforms=prior.transforms[good],
    )
    return torch.stack([pose_at(known, time)[0] for time in prior.times.tolist()])


def _told(rows: list[int], count: int, what: str) -> str:
    """Return the sentence about some rows."""
    shown = ", ".join(map(str, rows[:12])) + (", ..." if len(rows) > 12 else "")
    return f"{len(rows)} of {count} frames {what}: {shown}"
