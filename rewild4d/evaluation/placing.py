"""Lay a reconstruction on the truth before held-out views are drawn, where the input leaves that open.

One fixed camera cannot know the animal's scale: a scene that is scaled about the camera's centre has the same images.
A rigid motion after it goes further: what is lost without it is lost by heading and position, not by shape.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import torch

from rewild4d.cameras.placement import IDENTITY, Placement
from rewild4d.contracts import Reconstruction
from rewild4d.io.sampling import sample_gaussians
from rewild4d.metrics.alignment import Alignment, Undetermined, align_scale, align_sequence
from rewild4d.metrics.score import Score
from rewild4d.types import Clip, Truth


class Placed(NamedTuple):
    """How the images of a sequence are drawn.

    Attributes:
        scale: after the scale about the input camera.
        rigid: after that scale and the best rigid motion.
        found: the scale, where there is one.
        alignments: both, as a record keeps them.
    """

    scale: Placement = IDENTITY
    rigid: Placement = IDENTITY
    found: Alignment | None = None
    alignments: tuple[dict[str, Any], ...] = ()


def free_scale(reconstruction: Reconstruction, clip: Clip, truth: Truth, points: int) -> Placed:
    """Find the one scale of a sequence about the input camera's centre that lays it on the true surface.

    See `align_scale`: points of the Gaussians (`sample_gaussians`) and of the true surface, at all times of the clip.
    The scale moves the animal along the line of sight, so that it does not matter that the centres of Gaussians lie a
    little inside the surface. A free similarity would enlarge them for it, by up to an eighth: so the rigid motion
    keeps the scale.

    Args:
        reconstruction: of the clip; without any Gaussian nothing is moved.
        clip: under one fixed camera.
        truth: with a surface.
        points: drawn from each cloud.
    """
    camera = clip.frames[0].camera
    if truth.sample is None or camera is None:
        lacks = "has no geometry" if truth.sample is None else "does not know the input camera"
        return _without(f"the scale is open, and the data set {lacks}")
    predictions = [sample_gaussians(reconstruction.at(time), points, seed=0) for time in clip.times]
    if not any(map(len, predictions)):
        return Placed()
    truths = [truth.sample(time, points, 1) for time in clip.times]
    try:
        found = align_scale(predictions, truths, camera.center)
        moved = align_sequence([found.apply(cloud) for cloud in predictions], truths, up=truth.up, scale=1.0)
    except Undetermined as error:
        return _without(str(error))
    bound = ", at its bound" if found.clamped else ""
    note = f"after a scale of {found.scale:.4g}{bound} about the input camera"
    return Placed(
        Placement(found.matrix, note),
        Placement(moved.matrix @ found.matrix, f"{note} and a rigid motion"),
        found,
        (describe(found, "scale", points), describe(moved, "rigid", points)),
    )


def _without(reason: str) -> Placed:
    nowhere = IDENTITY._replace(reason=reason)
    return Placed(nowhere, nowhere)


def scale_of(alignments: Sequence[dict[str, Any]]) -> Placement:
    """Return the placement by the scale among a record's alignments, for pictures; none moves nothing."""
    found = next((one for one in alignments if one["fit"] == "scale"), None)
    return IDENTITY if found is None else Placement(torch.tensor(found["matrix"], dtype=torch.float64))


def scale_score(placed: Placed) -> Score:
    """Return the scale as a figure beside the scores; no value of it is better than another."""
    found = placed.found
    if found is None:
        return Score(None, "1", "", 0, note=f"not computed: {placed.scale.reason or 'there is nothing to scale'}")
    return Score(found.scale, "1", "", 1, [found.scale], "at its bound" if found.clamped else "")


def describe(found: Alignment, fit: str, points: int, moment: int | None = None) -> dict[str, Any]:
    """Return an alignment as a record keeps it."""
    return {
        "fit": fit, "points": points, "moment": moment, "scale": found.scale, "matrix": found.matrix.tolist(),
        "start": found.start, "iterations": found.iterations, "converged": found.converged, "clamped": found.clamped,
    }  # fmt: skip
