"""A batch of guesses of the animal: their parameters, silhouettes and penalties.

Parameters are in standard deviations, so that one learning rate suits all. Motion is a short cosine series over time.
"""

import math
from dataclasses import dataclass, fields, replace
from typing import Any, Self

import torch
from torch import Tensor

from rewild4d.priors.bodies.body import Body, Proportions, Template
from rewild4d.priors.bodies.tetrapod import SPINE
from rewild4d.priors.config import Stage
from rewild4d.priors.kinematics import moved, pose, rotation_about
from rewild4d.priors.silhouettes import PARTS, Targets, rasterized, splat
from rewild4d.transforms import axis_angle_to_matrix, rigid

LIFTED = 0.05
"""Height above its lowest position over which a foot's weight falls to 1 / e, template units."""
STILL_STEP = 0.03
"""Foot motion per frame below which a gait counts little, template units."""
SCALE_SPREAD = 0.25
ROTATION_SPREAD = (0.15, 0.35, 0.10)
SHIFT_SPREAD = 0.30


def cosine_series(count: int, terms: int) -> Tensor:
    """Return the first ``terms`` cosines over ``count`` frames, damped below a period of eight, [count, terms]."""
    order = torch.arange(terms)
    waves = torch.cos(math.pi * (torch.arange(count)[:, None] + 0.5) * order / count)
    return waves / (1 + (4 * order / count).square())


@dataclass
class Hypotheses:
    """A batch of B guesses in the working frame (y up, animal near the origin, about template size).

    Attributes:
        body: the kind of animal.
        facing: rotation object -> working frame of each guess, fixed, [B, 3, 3].
        path: position of the animal at each frame according to the masks, fixed, [T, 3].
        scale: logarithm of the size, [B].
        rotation: cosine series of the root's rotation, [B, K, 3].
        shift: cosine series of the root's offset from the path, [B, K, 3].
        shape: proportions, [B, P].
        relief: of the cross sections, [B, S, 4].
        angles: cosine series of the joint angles, [B, L, J, 3].
        colors: RGB of parts of the surface, see `rasterized`, [B, D, 3]; none before a stage fits them.
        turn: angle about y at each frame by which all guesses head away from their facing, fixed, radians, [T].
    """

    body: Body
    facing: Tensor
    path: Tensor
    scale: Tensor
    rotation: Tensor
    shift: Tensor
    shape: Tensor
    relief: Tensor
    angles: Tensor
    colors: Tensor
    turn: Tensor

    @classmethod
    def start(cls, body: Body, facing: Tensor, path: Tensor, root_period: int = 4) -> Self:
        """Return average animals of a kind at rest on the path, from facings [B, 3, 3] and a path [T, 3].

        The root has a term of motion for each ``root_period`` frames.
        """
        batch, count = len(facing), len(path)
        root, joints = 1 + (count - 1) // root_period, 1 + (count - 1) // 2
        return cls(
            body,
            facing,
            path,
            scale=torch.zeros(batch),
            rotation=torch.zeros(batch, root, 3),
            shift=torch.zeros(batch, root, 3),
            shape=torch.zeros(batch, body.measures),
            relief=torch.zeros(batch, body.sections, 4),
            angles=torch.zeros(batch, joints, len(body.parents), 3),
            colors=torch.zeros(batch, 0, 3),
            turn=torch.zeros(count),
        )

    def by_guess(self) -> dict[str, Tensor]:
        """Return all tensors with a row for each guess, by name, detached."""
        names = [field.name for field in fields(self) if field.name not in ("body", "path", "turn")]
        return {name: getattr(self, name).detach() for name in names}

    def select(self, rows: Tensor) -> Self:
        """Return some of the guesses, detached."""
        chosen: dict[str, Any] = {name: value[rows] for name, value in self.by_guess().items()}
        return replace(self, **chosen)

    def __len__(self) -> int:
        return len(self.facing)

    def scales(self) -> Tensor:
        """Return the size of the animals in working units per template unit, [B]."""
        return torch.exp(SCALE_SPREAD * self.scale)

    def roots(self) -> Tensor:
        """Return the rigid root motion without the scale, [B, T, 4, 4]."""
        series = cosine_series(len(self.path), self.rotation.shape[1])
        rotations = axis_angle_to_matrix((series @ self.rotation) * torch.tensor(ROTATION_SPREAD))
        facings = self.facing[:, None] @ rotation_about(1, self.turn)
        return rigid(facings @ rotations, self.path + SHIFT_SPREAD * (series @ self.shift))

    def heading(self) -> Tensor:
        """Return the mean direction from tail to head, [B, 3]."""
        return torch.nn.functional.normalize(self.roots()[..., :3, 2].mean(1), dim=-1)

    def joint_angles(self) -> Tensor:
        """Return axis-angle vectors in radians, [B, T, J, 3]."""
        series = cosine_series(len(self.path), self.angles.shape[1])
        raw = torch.einsum("tk,bkja->btja", series, self.angles) * self.body.spreads
        limits = self.body.limits
        return limits * torch.tanh(raw / limits)

    def template(self) -> Template:
        """Return the animals at rest before they are scaled."""
        return self.body.build(Proportions(self.shape, self.relief), unit=False)

    def painted(self, color: Tensor) -> Self:
        """Return these guesses in one colour, [3]."""
        parts = PARTS * PARTS * len(self.template().quads)
        return replace(self, colors=color.expand(len(self), parts, 3).clone())

    def pictures(self, targets: Targets) -> tuple[Tensor, Tensor]:
        """Return colours times mattes in the targets' crops, and mattes, [B, v, 3, s, s] and [B, v, s, s]."""
        template, size = self.template(), targets.masks.shape[-1]
        cover = self._in_cameras(template, template.cover, template.cover_weights, targets, True)
        return rasterized(cover, template.quads, targets.intrinsics, size, self.colors)

    def silhouettes(self, targets: Targets, stage: Stage) -> Tensor:
        """Return the soft silhouettes in the targets' crops, [B, v, s, s]."""
        template, size = self.template(), targets.masks.shape[-1]
        if stage.rasterized:
            cover = self._in_cameras(template, template.cover, template.cover_weights, targets, stage.joints)
            return rasterized(cover, template.quads, targets.intrinsics, size)[1]
        blobs = self._in_cameras(template, template.blobs, template.blob_weights, targets, stage.joints)
        return splat(blobs, (template.blob_sizes * self.scales()[:, None])[:, None], targets.intrinsics, size)

    def _in_cameras(self, template: Template, points: Tensor, weights: Tensor, targets: Targets, bent: bool) -> Tensor:
        """Return points of the template, skinned if ``bent``, in the cameras' axes, [B, n, 3] -> [B, v, n, 3]."""
        matrix = targets.world_to_camera @ self.roots()[:, targets.timesteps]
        scale = self.scales()[:, None]
        linear = torch.cat((matrix[..., :3] * scale[..., None, None], matrix[..., 3:]), -1)
        if not bent:
            return points[:, None] @ linear[..., :3, :3].transpose(-1, -2) + linear[..., None, :3, 3]
        angles = self.joint_angles()[:, targets.timesteps]
        transforms = linear[:, :, None] @ pose(angles, template.bones[:, None, :, 0], self.body.parents)
        blended = (weights @ transforms[..., :3, :].flatten(-2)).unflatten(-1, (3, 4))
        return torch.einsum("bvnac,bnc->bvna", blended[..., :3], points) + blended[..., 3]

    def points(self, bones: Tensor, along: Tensor) -> Tensor:
        """Return points of bones, at shares of their lengths ([L] each), at every time, [B, T, L, 3]."""
        rest = self.template().bones
        start, end = rest[:, bones].unbind(-2)
        transforms = pose(self.joint_angles(), rest[:, None, :, 0], self.body.parents)[:, :, bones]
        places = (start + along[:, None] * (end - start))[:, None]
        posed, roots = moved(places, transforms) * self.scales()[:, None, None, None], self.roots()
        return posed @ roots[..., :3, :3].transpose(-1, -2) + roots[..., None, :3, 3]

    def backward_gait(self) -> Tensor:
        """Return how far feet on the ground move towards the head (up to 1) or the tail (down to -1), [B].

        Feet that bear weight move backwards in the body's frame; forwards means that head and tail are confused.
        """
        bones, feet = self.body.build(Proportions(self.shape), unit=False).bones, list(self.body.feet)
        transforms = pose(self.joint_angles(), bones[:, None, :, 0], self.body.parents)[:, :, feet]
        toes = moved(bones[:, None, feet, 1], transforms)
        if toes.shape[1] < 2:
            return toes.new_zeros(len(self))
        height, step = (toes[:, 1:, :, 1] + toes[:, :-1, :, 1]) / 2, toes[..., 2].diff(dim=1)
        bearing = torch.exp(-(height - height.amin(1, keepdim=True)) / LIFTED)
        travel = (bearing * step.abs()).sum((1, 2))
        return (bearing * step).sum((1, 2)) / (travel + STILL_STEP * bearing.sum((1, 2)))

    def sideways(self) -> Tensor:
        """Return the mean square of how far the spine of a `Tetrapod` is bent and rolled sideways on average, [B]."""
        return self.angles[:, 0, :SPINE, 1:].square().mean((1, 2))

    def penalties(self) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Return penalties of proportions, relief, joint angles and root motion, each [B].

        Fast terms cost more: one camera a frame says nothing of depth, neighbouring frames do. The mean yaw and the
        mean position are free.
        """
        rotation, shift = self.rotation, self.shift
        speed = torch.arange(shift.shape[1]).square()[:, None]
        bound = torch.cat((rotation[:, :1, [0, 2]].flatten(1), rotation[:, 1:].flatten(1)), dim=1)
        root = bound.square().sum(1) + 0.5 * (shift.square() * speed).sum((1, 2))
        return *self._body_penalties(1.0), root

    def _body_penalties(self, frequency: float) -> tuple[Tensor, Tensor, Tensor]:
        """Return penalties of proportions, relief and joint angles; term k of the series counts as k * frequency."""
        order = frequency * torch.arange(self.angles.shape[1])
        angles = self.angles.square() * (self.body.spreads > 0) * (0.3 + (order / 4).square())[:, None, None]
        relief = self.relief.square().mean((1, 2)) if self.body.sections else torch.zeros(len(self))
        return self.shape.square().mean(1), relief, angles.sum(1).mean((1, 2))
