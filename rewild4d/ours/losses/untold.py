"""Poses held to the prior's as far as an image does not tell them. A method of ours, not of the paper."""

from collections.abc import Iterable
from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn.functional import normalize

from rewild4d.ours.evidence import Sighting, told
from rewild4d.ours.losses.skin import firmness_of
from rewild4d.ours.model import Model
from rewild4d.ours.symmetry import Supervision
from rewild4d.transforms import skin_points
from rewild4d.types import OBJECT_DIAGONAL

DOUBT = 0.003
"""Error of a component of the prior's places where images agree with it, over the diagonal."""
MARKS = 400
"""Points of the skin at which poses are compared."""
REACH = 2
"""Frames before and after a moment that tell its pose too, because poses are smooth over time."""


class Marks(NamedTuple):
    """Points of the skin that stand for the body.

    Attributes:
        points: at rest, [k, 3].
        weights: skinning weights at the start of the fit, [k, J].
        views: of the frames, and of their mirror images, on the CPU, [2, T, 2, k]: the share of each mark that is drawn
            at the start of the fit, and the firmness of the hold on it, 1 where nothing tells the poses of its bones.
    """

    points: Tensor
    weights: Tensor
    views: Tensor

    @classmethod
    @torch.no_grad()
    def of(cls, model: Model, half: float, views: Iterable[Sighting], supervision: Supervision) -> "Marks":
        """Choose `MARKS` of the Gaussians of a model that was not trained yet.

        Args:
            model: of the fit.
            half: information at which a hold has half its weight; 0 holds all alike.
            views: all training views of the Gaussians; in others nothing counts as shown.
            supervision: with the views' cameras.
        """
        own = model.gaussians
        rows = torch.linspace(0, len(own) - 1, min(MARKS, len(own)), device=own.means.device).long()
        shown = torch.zeros(2, supervision.frames, len(rows))
        sights = torch.zeros(*shown.shape, 3)
        for view in views:
            share, sight = (part[rows].cpu() for part in view.seen(own, supervision))
            at = int(view.key.view < 0), view.key.frame
            shown[at], sights[at] = share, sight
        points = own.means.detach()[rows].clone()
        weights = model.field.sample(model.field.probabilities(), points)
        firmness = pose_firmness(told(shown, sights), weights.cpu(), half) if half else torch.ones_like(shown)
        return cls(points, weights, torch.stack((shown, firmness), dim=2))


def pose_firmness(information: Tensor, weights: Tensor, half: float) -> Tensor:
    """Return how firmly each mark is held at each moment.

    What images say of a bone's place is the mean over its marks and over `REACH` frames before and after; the smallest
    eigenvalue tells how firmly the bone is held (`skin.firmness_of`), and a mark as its bones.

    Args:
        information: of each mark in each frame (`evidence.told`), [2, T, k, 3, 3].
        weights: skinning weights, [k, J].
        half: information at which a hold has half its weight.

    Returns:
        [2, T, k].
    """
    frames = information.shape[1]
    shares = weights / weights.sum(0).clamp_min(torch.finfo(weights.dtype).tiny)
    bones = torch.einsum("gtkab,kj->gtjab", information, shares)
    near = torch.stack([
        bones[:, max(0, frame - REACH) : frame + REACH + 1].mean(1) for frame in range(frames)
    ], dim=1)  # fmt: skip
    return firmness_of(torch.linalg.eigvalsh(near)[..., 0], half) @ weights.T


def untold_loss(marks: Marks, transforms: Tensor, prior_transforms: Tensor, eye: Tensor, view: Tensor) -> Tensor:
    """Compute how far marks are from where the prior poses them as far as images do not tell it, against how far off
    the prior is where the image does.

    The mean over the marks of f^2 ((1 - v) |d|^2 + v (d . s)^2), with f the firmness, v the share that is shown, d the
    distance and s the line of sight: hidden ones count in full, others along that line. The square leaves poses free
    that frames close in time tell from several sides. Divided by the mean square of a component of d across the line of
    sight, weighed by v, plus that of `DOUBT`: a prior whose poses the images contradict holds less.

    Args:
        marks: of the body.
        transforms: rest -> posed, [J, 4, 4].
        prior_transforms: the prior's, [J, 4, 4].
        eye: camera centre, [3].
        view: v and f of each mark (`Marks.views`), [2, k].
    """
    shown, firmness = view
    known = skin_points(marks.points, marks.weights, prior_transforms)
    apart = (skin_points(marks.points, marks.weights, transforms) - known) / OBJECT_DIAGONAL
    square, along = apart.square().sum(-1), (apart * normalize(known - eye, dim=-1)).sum(-1).square()
    error = (shown * (square - along)).sum().detach() / (2 * shown.sum()).clamp_min(1.0)
    untold = (1 - shown) * square + shown * along
    return (firmness.square() * untold).mean() / (error + DOUBT**2)
