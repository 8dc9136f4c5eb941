"""How well a prior's joints agree with annotated ones, and whether its head is where the animal's is."""

from collections.abc import Sequence

import torch
from torch import Tensor

from rewild4d.priors.landmarks import FRONT, LANDMARKS, REAR, Marks, landmark_pixels
from rewild4d.types import Frame, Prior

CORRECT = 0.2
"""A joint is correct within this share of the longer side of the mask's bounding box."""


def joint_scores(prior: Prior, frames: Sequence[Frame], found: Marks) -> dict[str, float]:
    """Share of joints near their annotation, and of frames in which front and rear lie the right way round.

    Args:
        prior: one row per frame.
        frames: with masks.
        found: annotated points; their moments are rows.

    Returns:
        pck: share of the points within `CORRECT` of the box (Yang & Ramanan 2013), over all points; facing: share of
        the frames with both ends annotated in which the direction from the mean rear point to the mean front point
        agrees within 90 degrees in the image; and how many points and frames that are. Empty without points.
    """
    if not len(found):
        return {}
    drawn = landmark_pixels(prior, found)
    sides = torch.tensor([_longer_side(frames[int(row)].mask[0]) for row in found.moments])
    near = (drawn - found.pixels).norm(dim=1) <= CORRECT * sides
    front, rear = _among(found, FRONT), _among(found, REAR)
    agree = []
    for moment in found.moments.unique():
        here = found.moments == moment
        if (here & front).any() and (here & rear).any():
            wanted, got = (
                points[here & front].double().mean(0) - points[here & rear].double().mean(0)
                for points in (found.pixels, drawn)
            )
            agree.append(float(wanted @ got > 0))
    scores = {"pck": float(near.double().mean()), "pck_points": float(len(found))}
    if agree:
        scores |= {"facing": sum(agree) / len(agree), "facing_frames": float(len(agree))}
    return scores


def _longer_side(mask: Tensor) -> float:
    rows, columns = torch.nonzero(mask > 0.5, as_tuple=True)
    if not len(rows):
        return 0.0
    return float(max(rows.max() - rows.min(), columns.max() - columns.min()) + 1)


def _among(found: Marks, names: Sequence[str]) -> Tensor:
    """Which marks are one of the named landmarks, bool, [m]."""
    places = {LANDMARKS[name] for name in names}
    marks = zip(found.bones.tolist(), found.along.tolist(), strict=True)
    return torch.tensor([(bone, round(along, 4)) in places for bone, along in marks])
