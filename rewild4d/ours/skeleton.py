"""The skeleton's own regularisers of a batch of poses, and the neighbouring frames that one of them needs."""

from torch import Tensor

from rewild4d.ours.config import Geometry
from rewild4d.ours.geometry_losses import attach_loss, limit_loss, temporal_loss
from rewild4d.ours.model import Model
from rewild4d.ours.pose import Pose
from rewild4d.ours.symmetry import Key


def neighbour_keys(keys: list[Key], frames: int, needed: bool) -> tuple[list[Key], list[int]]:
    """Each view with the frames before and after it, in triples, and the rows of the views themselves.

    At an end of the clip the triple is moved inwards. Clips of two frames, or ``needed`` false, get no neighbours.

    Args:
        keys: the views of a step.
        frames: number of frames.
        needed: whether a temporal term wants triples.
    """
    if not needed or frames < 3:
        return keys, list(range(len(keys)))
    triples, own = [], []
    for row, key in enumerate(keys):
        middle = min(max(key.frame, 1), frames - 2)
        triples += [key._replace(frame=middle + offset) for offset in (-1, 0, 1)]
        own.append(3 * row + key.frame - middle + 1)
    return triples, own


def skeleton_losses(model: Model, pose: Pose, transforms: Tensor, config: Geometry) -> Tensor:
    """Weighted sum of joint limits, attachment and (over triples) temporal smoothness, scalar.

    Args:
        model: gives the skeleton.
        pose: [B, J, ...]; in triples of neighbouring frames where ``config.temporal`` is above zero.
        transforms: of the same poses, [B, J, 4, 4].
        config: the weights.
    """
    total = pose.shifts.sum() * 0.0
    if config.limit:
        total = total + config.limit * limit_loss(pose, model.parents, config.limit_degrees)
    if config.attach:
        total = total + config.attach * attach_loss(transforms, model.pivots, model.parents)
    if config.temporal and len(pose.quats) % 3 == 0:
        total = total + config.temporal * temporal_loss(pose)
    return total
