"""The skeleton's regularizers of a batch of poses, and the neighbouring frames that one of them needs."""

import math
from typing import NamedTuple

from torch import Tensor

from rewild4d.ours.fused.skeleton import POSTURE, Weights, posture_and_losses
from rewild4d.ours.losses.config import Geometry
from rewild4d.ours.losses.regularizers import attach_loss, limit_loss, sagittal_losses, still_loss, temporal_loss
from rewild4d.ours.model import Model
from rewild4d.ours.pose import Pose
from rewild4d.ours.symmetry import Key
from rewild4d.types import OBJECT_DIAGONAL


class Neighbours(NamedTuple):
    """Views with those of the frames beside them.

    Attributes:
        keys: the views, or triples of them.
        rows: of the views themselves among `keys`.
        gaps: frames from the first to the second and from the second to the third view of each triple, float64, [k, 2];
            None where `keys` are no triples.
    """

    keys: list[Key]
    rows: list[int]
    gaps: Tensor | None


def neighbour_keys(keys: list[Key], positions: Tensor, config: Geometry) -> Neighbours:
    """Find the frames before and after each view's; at an end of the clip the triple is moved inwards.

    There are no neighbours where the clip has two frames or no term needs them.

    Args:
        keys: the views.
        positions: of the clip's frames (`symmetry.frame_positions`), [T].
        config: weights of the terms.
    """
    if (not config.temporal and not config.still) or len(positions) < 3:
        return Neighbours(keys, list(range(len(keys))), None)
    triples, own = [], []
    for row, key in enumerate(keys):
        middle = min(max(key.frame, 1), len(positions) - 2)
        triples += [key._replace(frame=middle + offset) for offset in (-1, 0, 1)]
        own.append(3 * row + key.frame - middle + 1)
    frames = positions[[key.frame for key in triples]].view(-1, 3)
    return Neighbours(triples, own, frames.diff(dim=1))


def posture(
    model: Model, poses: Pose, rows: Tensor, config: Geometry, gaps: Tensor | None
) -> tuple[Pose, Tensor, Tensor]:
    """Select ``rows`` of a batch of poses, with their transforms, and sum the weighted regularizers of the whole batch.

    ``gaps`` are those of `neighbour_keys`, None where the poses are no triples.
    """
    skeleton = model.pivots, model.parents, model.mirror
    if POSTURE.takes(poses.quats):
        *own, transforms, total = posture_and_losses(*poses, rows.tolist(), *skeleton, _weights(config, gaps), gaps)
        return Pose(*own), transforms, total
    transforms = model.transforms(poses)
    total = skeleton_losses(model, poses, transforms, config, gaps)
    return Pose(*(tensor[rows] for tensor in poses)), transforms[rows], total


def skeleton_losses(model: Model, pose: Pose, transforms: Tensor, config: Geometry, gaps: Tensor | None) -> Tensor:
    """Sum the weighted regularizers of poses [B, J, ...] with transforms [B, J, 4, 4]: joint limits, attachment, planes
    and, of triples of neighbouring frames (``gaps`` is not None), smoothness and stillness."""
    if POSTURE.takes(pose.quats):
        weights = _weights(config, gaps)
        return posture_and_losses(*pose, [], model.pivots, model.parents, model.mirror, weights, gaps)[-1]
    total = pose.shifts.sum() * 0.0
    if config.limit:
        total = total + config.limit * limit_loss(pose, model.parents, config.limit_degrees)
    if config.attach:
        total = total + config.attach * attach_loss(transforms, model.pivots, model.parents)
    planes = sagittal_losses(pose, transforms, model.pivots, model.parents, model.mirror)
    for weight, loss in zip((config.limb_plane, config.body_plane, config.sideways), planes, strict=True):
        total = total + weight * loss
    if config.temporal and gaps is not None:
        total = total + config.temporal * temporal_loss(pose, gaps)
    if config.still and gaps is not None:
        total = total + config.still * still_loss(pose, config.still_step, gaps)
    return total


def _weights(config: Geometry, gaps: Tensor | None) -> Weights:
    planes = (config.limb_plane, config.body_plane, config.sideways)
    cosine = math.cos(math.radians(config.limit_degrees) / 2)
    steps = (0.0, 0.0) if gaps is None else (config.temporal, config.still)
    return Weights(config.limit, *planes, cosine, config.attach, *steps, config.still_step, OBJECT_DIAGONAL)
