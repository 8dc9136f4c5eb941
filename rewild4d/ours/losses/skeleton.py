"""The skeleton's regularizers of a batch of poses, and the neighbouring frames that one of them needs."""

import math

from torch import Tensor

from rewild4d.ours.config import Geometry
from rewild4d.ours.fused.skeleton import POSTURE, Weights, posture_and_losses
from rewild4d.ours.losses.regularizers import attach_loss, limit_loss, sagittal_losses, still_loss, temporal_loss
from rewild4d.ours.model import Model
from rewild4d.ours.pose import Pose
from rewild4d.ours.symmetry import Key
from rewild4d.types import OBJECT_DIAGONAL


def neighbour_keys(keys: list[Key], frames: int, config: Geometry) -> tuple[list[Key], list[int]]:
    """Return each view with the frames before and after it, in triples, and the rows of the views themselves.

    At an end of the clip the triple is moved inwards. No neighbours where the clip has two frames or no term needs
    them.
    """
    if (not config.temporal and not config.still) or frames < 3:
        return keys, list(range(len(keys)))
    triples, own = [], []
    for row, key in enumerate(keys):
        middle = min(max(key.frame, 1), frames - 2)
        triples += [key._replace(frame=middle + offset) for offset in (-1, 0, 1)]
        own.append(3 * row + key.frame - middle + 1)
    return triples, own


def posture(model: Model, poses: Pose, rows: list[int], config: Geometry) -> tuple[Pose, Tensor, Tensor]:
    """Select poses of a batch, with their transforms, and sum the weighted regularizers of the whole batch.

    Where B = 3 k, the poses are triples of neighbouring frames from `neighbour_keys`, ``rows`` the k selected ones.
    """
    triples = len(poses.quats) == 3 * len(rows)
    skeleton = model.pivots, model.parents, model.mirror
    if POSTURE.takes(poses.quats):
        *own, transforms, total = posture_and_losses(*poses, rows, *skeleton, _weights(config, triples))
        return Pose(*own), transforms, total
    transforms = model.transforms(poses)
    total = skeleton_losses(model, poses, transforms, config, triples)
    return Pose(*(tensor[rows] for tensor in poses)), transforms[rows], total


def skeleton_losses(model: Model, pose: Pose, transforms: Tensor, config: Geometry, triples: bool) -> Tensor:
    """Sum the weighted regularizers of poses [B, J, ...] with transforms [B, J, 4, 4]: joint limits, attachment, planes
    and, if the poses are triples of neighbouring frames, smoothness and stillness."""
    if POSTURE.takes(pose.quats):
        return posture_and_losses(*pose, [], model.pivots, model.parents, model.mirror, _weights(config, triples))[-1]
    total = pose.shifts.sum() * 0.0
    if config.limit:
        total = total + config.limit * limit_loss(pose, model.parents, config.limit_degrees)
    if config.attach:
        total = total + config.attach * attach_loss(transforms, model.pivots, model.parents)
    planes = sagittal_losses(pose, transforms, model.pivots, model.parents, model.mirror)
    for weight, loss in zip((config.limb_plane, config.body_plane, config.sideways), planes, strict=True):
        total = total + weight * loss
    if config.temporal and triples:
        total = total + config.temporal * temporal_loss(pose)
    if config.still and triples:
        total = total + config.still * still_loss(pose, config.still_step)
    return total


def _weights(config: Geometry, triples: bool) -> Weights:
    planes = (config.limb_plane, config.body_plane, config.sideways)
    cosine = math.cos(math.radians(config.limit_degrees) / 2)
    steps = (config.temporal, config.still) if triples else (0.0, 0.0)
    return Weights(config.limit, *planes, cosine, config.attach, *steps, config.still_step, OBJECT_DIAGONAL)
