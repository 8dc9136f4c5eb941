"""Several guesses of the animal at once: their parameters, and how they look to the cameras.

All parameters are whitened: one unit is one natural spread, so that one learning rate and one penalty suit them all.
Motion over time is a short cosine series, so that a moment seen by one camera is helped by its neighbours.
"""

import math
from dataclasses import dataclass, fields

import torch
from torch import Tensor

from rewild4d.priors.config import Stage
from rewild4d.priors.kinematics import pose
from rewild4d.priors.proportions import PROPORTIONS, SECTIONS, Proportions
from rewild4d.priors.silhouettes import Targets, rasterized, splat
from rewild4d.priors.template import PARENTS, Template, quadruped, quads
from rewild4d.transforms import axis_angle_to_matrix, rigid

ANGLE_LIMIT = 1.1
"""No joint axis turns further, in radians (Fauna: 60 degrees)."""
FEET = [8, 11, 14, 17]
LIFTED = 0.05
"""Height above its lowest place at which a foot bears no weight, in template units."""
STILL_STEP = 0.03
"""Foot motion per moment below which no gait is read, in template units."""
SCALE_SPREAD = 0.25
TURN_SPREAD = (0.15, 0.35, 0.10)
SHIFT_SPREAD = 0.30


def _angle_spreads() -> Tensor:
    """Natural spread of every joint about the object's axes (x flexes, y turns, z rolls) in radians, [J, 3]."""
    by_bone = {
        0: (0.30, 0.25, 0.10), 1: (0.35, 0.25, 0.10), 2: (0.40, 0.25, 0.10), 3: (0.10, 0.08, 0.04),
        4: (0.35, 0.35, 0.05), 5: (0.40, 0.40, 0.05), 6: (0.15, 0.10, 0.04), 7: (0.10, 0.08, 0.04),
    }  # fmt: skip
    for foot in (8, 11, 14, 17):
        by_bone |= {foot: (0.45, 0.0, 0.04), foot + 1: (0.45, 0.0, 0.04), foot + 2: (0.45, 0.05, 0.10)}
    return torch.tensor([by_bone[bone] for bone in range(len(PARENTS))])


ANGLE_SPREADS = _angle_spreads()


def cosine_series(count: int, terms: int) -> Tensor:
    """The first ``terms`` cosines over ``count`` moments, damped from a period of eight moments on, [count, terms]."""
    order = torch.arange(terms)
    waves = torch.cos(math.pi * (torch.arange(count)[:, None] + 0.5) * order / count)
    return waves / (1 + (4 * order / count).square())


@dataclass
class Hypotheses:
    """A batch of B guesses in the working frame (y up, animal near the origin, about template size).

    Attributes:
        facing: rotation object -> working frame of each guess, fixed, [B, 3, 3].
        path: where the masks say the animal is at each moment, fixed, [T, 3].
        scale: whitened logarithm, [B].
        turn: cosine series of the root's rotation, [B, K, 3].
        shift: cosine series of the root's offset from the path, [B, K, 3].
        shape: proportions, [B, P].
        relief: of the cross sections, [B, S, 4].
        angles: cosine series of the joint angles, [B, L, J, 3].
    """

    facing: Tensor
    path: Tensor
    scale: Tensor
    turn: Tensor
    shift: Tensor
    shape: Tensor
    relief: Tensor
    angles: Tensor

    @staticmethod
    def start(facing: Tensor, path: Tensor) -> "Hypotheses":
        """Average animals at rest on the path, [B, 3, 3] and [T, 3]."""
        batch, moments = len(facing), len(path)
        root, joints = 1 + (moments - 1) // 4, 1 + (moments - 1) // 2
        return Hypotheses(
            facing,
            path,
            scale=torch.zeros(batch),
            turn=torch.zeros(batch, root, 3),
            shift=torch.zeros(batch, root, 3),
            shape=torch.zeros(batch, len(PROPORTIONS)),
            relief=torch.zeros(batch, sum(SECTIONS), 4),
            angles=torch.zeros(batch, joints, len(PARENTS), 3),
        )

    def select(self, rows: Tensor) -> "Hypotheses":
        """Return some of the guesses, detached."""
        rest = {f.name: getattr(self, f.name).detach()[rows] for f in fields(self) if f.name != "path"}
        return Hypotheses(path=self.path, **rest)

    def __len__(self) -> int:
        return len(self.facing)

    def scales(self) -> Tensor:
        """Return the size of the animals in working units per template unit, [B]."""
        return torch.exp(SCALE_SPREAD * self.scale)

    def roots(self) -> Tensor:
        """Return the rigid root motion without the scale, [B, T, 4, 4]."""
        series = cosine_series(len(self.path), self.turn.shape[1])
        turns = axis_angle_to_matrix((series @ self.turn) * torch.tensor(TURN_SPREAD))
        return rigid(self.facing[:, None] @ turns, self.path + SHIFT_SPREAD * (series @ self.shift))

    def heading(self) -> Tensor:
        """Return the mean direction from tail to head, [B, 3]."""
        return torch.nn.functional.normalize(self.roots()[..., :3, 2].mean(1), dim=-1)

    def joint_angles(self) -> Tensor:
        """Return axis-angle vectors in radians, [B, T, J, 3]."""
        series = cosine_series(len(self.path), self.angles.shape[1])
        raw = torch.einsum("tk,bkja->btja", series, self.angles) * ANGLE_SPREADS
        return ANGLE_LIMIT * torch.tanh(raw / ANGLE_LIMIT)

    def silhouettes(self, targets: Targets, stage: Stage) -> Tensor:
        """Return the soft silhouettes in the targets' crops, whose cameras are in the working frame, [B, v, s, s]."""
        template = quadruped(Proportions(self.shape, self.relief), unit=False)
        size = targets.masks.shape[-1]
        if stage.rasterized:
            vertices = self._seen(template, template.vertices, template.weights, targets, stage.joints)
            return rasterized(vertices, quads(), targets.intrinsics, size)
        blobs = self._seen(template, template.blobs, template.blob_weights, targets, stage.joints)
        return splat(blobs, (template.blob_sizes * self.scales()[:, None])[:, None], targets.intrinsics, size)

    def _seen(self, template: Template, points: Tensor, weights: Tensor, targets: Targets, moving: bool) -> Tensor:
        """Return points of the template in the targets' camera coordinates, [B, n, 3] -> [B, v, n, 3]."""
        matrix = targets.world_to_camera @ self.roots()[:, targets.moments]
        scale = self.scales()[:, None]
        linear = torch.cat((matrix[..., :3] * scale[..., None, None], matrix[..., 3:]), -1)
        if not moving:
            return points[:, None] @ linear[..., :3, :3].transpose(-1, -2) + linear[..., None, :3, 3]
        angles = self.joint_angles()[:, targets.moments]
        transforms = linear[:, :, None] @ pose(angles, template.bones[:, None, :, 0], PARENTS)
        blended = (weights @ transforms[..., :3, :].flatten(-2)).unflatten(-1, (3, 4))
        return torch.einsum("bvnac,bnc->bvna", blended[..., :3], points) + blended[..., 3]

    def backward_gait(self) -> Tensor:
        """Measure how far low feet move towards the head (against every gait, up to 1) or the tail (down to -1), [B].

        A foot that bears weight goes backwards in the body's frame, whether the animal travels or walks on the spot;
        with head and tail confused it goes forwards. Near zero where the feet hardly move.
        """
        bones = quadruped(Proportions(self.shape), unit=False).bones
        transforms = pose(self.joint_angles(), bones[:, None, :, 0], PARENTS)[:, :, FEET]
        toes = (transforms[..., :3, :3] @ bones[:, None, FEET, 1, :, None])[..., 0] + transforms[..., :3, 3]
        if toes.shape[1] < 2:
            return toes.new_zeros(len(self))
        height, step = (toes[:, 1:, :, 1] + toes[:, :-1, :, 1]) / 2, toes[..., 2].diff(dim=1)
        bearing = torch.exp(-(height - height.amin(1, keepdim=True)) / LIFTED)
        travel = (bearing * step.abs()).sum((1, 2))
        return (bearing * step).sum((1, 2)) / (travel + STILL_STEP * bearing.sum((1, 2)))

    def penalties(self) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Measure how unusual the proportions, the relief, the joint angles and the root's motion are, each [B].

        Fast terms cost more than slow ones: a moment seen by one camera says nothing of depth, its neighbours do.
        Where the animal heads on the whole costs nothing: the starts only sample it.
        """
        pace = torch.arange(self.angles.shape[1])
        swing = self.angles.square() * (ANGLE_SPREADS > 0) * (0.3 + (pace / 4).square())[:, None, None]
        haste = torch.arange(self.shift.shape[1]).square()[:, None]
        lean = torch.cat((self.turn[:, :1, [0, 2]].flatten(1), self.turn[:, 1:].flatten(1)), dim=1)
        root = lean.square().sum(1) + 0.5 * (self.shift.square() * haste).sum((1, 2))
        return self.shape.square().mean(1), self.relief.square().mean((1, 2)), swing.sum(1).mean((1, 2)), root
