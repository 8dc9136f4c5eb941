"""Poses held to the prior's as far as an image does not tell them. A method of ours, not of the paper."""

from collections.abc import Iterable
from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn.functional import normalize

from rewild4d.ours.evidence import Sighting, visible_share
from rewild4d.ours.model import Model
from rewild4d.ours.symmetry import Supervision
from rewild4d.transforms import skin_points
from rewild4d.types import OBJECT_DIAGONAL

DOUBT = 0.003
"""Error of a component of the prior's places where images agree with it, over the diagonal."""
MARKS = 400
"""Points of the skin at which poses are compared."""


class Marks(NamedTuple):
    """Points of the skin that stand for the body.

    Attributes:
        points: at rest, [k, 3].
        weights: skinning weights at the start of the fit, [k, J].
        firmness: of the hold on each over the whole clip (`skin.Bond`), [k].
        shown: share of each that is drawn at the start of the fit in the frames, and in their mirror images, on the
            CPU, [2, T, k].
    """

    points: Tensor
    weights: Tensor
    firmness: Tensor
    shown: Tensor

    @classmethod
    @torch.no_grad()
    def of(cls, model: Model, firmness: Tensor | None, views: Iterable[Sighting], supervision: Supervision) -> "Marks":
        """Choose `MARKS` of the Gaussians of a model that was not trained yet.

        Args:
            model: of the fit.
            firmness: of the hold on each Gaussian, [n]; None for 1.
            views: all training views of the Gaussians; in others nothing counts as shown.
            supervision: with the views' cameras.
        """
        own = model.gaussians
        rows = torch.linspace(0, len(own) - 1, min(MARKS, len(own)), device=own.means.device).long()
        held = torch.ones_like(own.means[:, 0]) if firmness is None else firmness
        shown = torch.zeros(2, supervision.frames, len(rows))
        for view in views:
            share = visible_share(view.posed, own, supervision.target(view.key).camera)
            shown[int(view.key.view < 0), view.key.frame] = share[rows].cpu()
        points = own.means.detach()[rows].clone()
        return cls(points, model.field.sample(model.field.probabilities(), points), held[rows], shown)


def untold_loss(marks: Marks, transforms: Tensor, prior_transforms: Tensor, eye: Tensor, shown: Tensor) -> Tensor:
    """Compute how far marks are from where the prior poses them as far as an image does not tell it, against how far
    off the prior is where the image does.

    The mean over the marks of f^2 ((1 - v) |d|^2 + v (d . s)^2), with f the firmness, v the share that is shown, d the
    distance and s the line of sight: hidden ones count in full, others along that line. The square leaves poses free
    where a camera that moves has told the place from several sides. Divided by the mean square of a component of d
    across the line of sight, weighed by v, plus that of `DOUBT`: a prior whose poses the images contradict holds less.

    Args:
        marks: of the body.
        transforms: rest -> posed, [J, 4, 4].
        prior_transforms: the prior's, [J, 4, 4].
        eye: camera centre, [3].
        shown: share of each mark that the view draws, [k].
    """
    known = skin_points(marks.points, marks.weights, prior_transforms)
    apart = (skin_points(marks.points, marks.weights, transforms) - known) / OBJECT_DIAGONAL
    square, along = apart.square().sum(-1), (apart * normalize(known - eye, dim=-1)).sum(-1).square()
    told = (shown * (square - along)).sum().detach() / (2 * shown.sum()).clamp_min(1.0)
    untold = (1 - shown) * square + shown * along
    return (marks.firmness.square() * untold).mean() / (told + DOUBT**2)
