"""Look for limbs where gradients do not reach: hidden by others, while the mask shows them elsewhere. A method of ours,
not of the paper.

A far leg that lies behind the near one gets no gradient from a strip of mask beside it, fades, and the strip stays
empty. Here each limb is bent and shifted as a whole in every frame, and the path through the frames is taken that
covers best what nothing else covers (docs/experiments/films.md).
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import NamedTuple

import cv2
import numpy as np
import torch
from torch import Tensor, nn

from rewild4d.ours.canonical import Posed
from rewild4d.ours.model import Model
from rewild4d.ours.pose import Pose, joint_transforms, pose_distance
from rewild4d.ours.schedule import rise_and_fall
from rewild4d.ours.symmetry import Key, Supervision, Target
from rewild4d.priors.paths import cheapest_path
from rewild4d.rasterizer import rasterize
from rewild4d.transforms import quat_multiply, quat_to_matrix

FAR, NEAR, FARTHER = 0.15, 0.03, 0.4
"""Distances of an empty pixel from the limb, in sides of the animal's box, beyond which more does not count; the share
of the first."""
MISSED, SPILLED, BENT, JERKED = 10.0, 0.5, 0.03, 0.3
"""What counts: the empty share of the mask, limb points outside it, squared bends, and their squared changes."""
SHARE, GAIN = 0.05, 0.01
"""Least share of a limb's cost, and least cost, that a path saves a frame; else the limb stays where it is."""
ALIKE = 0.8
"""Share of the best gain at which a limb farther from the camera goes first: of two that lie on each other, it sees the
nearer."""
POINTS, PIXELS = 120, 120
"""Most points of a limb, and most empty pixels, that are compared."""
COPIES, BATCH, RATE = 150, 48, 1e-3
"""Steps in which the pose network learns what was found, poses a step, and learning rate."""


class Bends(NamedTuple):
    """Changes of a limb's pose.

    Attributes:
        whole: rotation about its first joint and the body's x axis, radians, [C].
        lower: rotation of what is below its second joint about that joint, likewise, [C].
        shift: along the body's z axis, object units, [C].
    """

    whole: Tensor
    lower: Tensor
    shift: Tensor

    def at(self, rows: Tensor) -> "Bends":
        """Select rows."""
        return Bends(*(each[rows] for each in self))

    def squared(self) -> Tensor:
        """Return the size of each, squared, [C]."""
        return self.whole.square() + 0.5 * self.lower.square() + 2 * self.shift.square()

    def changes(self) -> Tensor:
        """Return the same of the difference of any two, [C, C]."""
        return Bends(*(each[:, None] - each for each in self)).squared()


class Limb(NamedTuple):
    """Bones of a limb from the body outwards, two or more, and whether it may slide along the body."""

    bones: list[int]
    slides: bool


def guesses(slides: bool) -> Bends:
    """Return the changes that are tried, the smallest first: none."""
    whole, lower = 0.2 * torch.arange(-5, 6), 0.4 * torch.arange(-2, 3)
    shift = 0.2 * torch.arange(-2, 3) if slides else torch.zeros(1)
    grid = Bends(*(each.flatten() for each in torch.meshgrid(whole, lower, shift, indexing="ij")))
    return grid.at(grid.squared().argsort(stable=True))


def limbs_of(parents: Tensor, mirror: Tensor) -> list[Limb]:
    """Find a skeleton's limbs: legs and the like, which have a counterpart on the other side, and the last two bones of
    what ends in the middle, such as a tail."""
    above, other = parents.tolist(), mirror.tolist()
    found = []
    for tip in sorted(set(range(len(above))) - set(above)):
        bones = [tip]
        while above[bones[0]] >= 0 and (other[tip] != tip) == (other[above[bones[0]]] != above[bones[0]]):
            if other[tip] == tip and len(bones) == 2:
                break
            bones.insert(0, above[bones[0]])
        found.append(Limb(bones, other[tip] != tip))
    return [limb for limb in found if len(limb.bones) > 1]


def bent(pose: Pose, pivots: Tensor, parents: Tensor, limb: Limb, bends: Bends) -> Pose:
    """Bend and shift a limb of poses [B, J, ...] by a change for each, [B]."""
    first, second = limb.bones[:2]
    parent = int(parents[first])
    body = quat_to_matrix(pose.quats[:, parent if parent >= 0 else first])
    whole, lower = (_about(body[..., 0], angle) for angle in (bends.whole, bends.lower))
    joints = pivots + pose.shifts
    top, middle, along = joints[:, first], joints[:, second], bends.shift[:, None] * body[..., 2]
    quats, shifts = pose.quats.clone(), pose.shifts.clone()
    for bone in limb.bones:
        turn, joint = whole, joints[:, bone]
        if bone != first:
            turn, joint = quat_multiply(whole, lower), _turned(lower, joint - middle) + middle
        quats[:, bone] = quat_multiply(turn, pose.quats[:, bone])
        shifts[:, bone] = _turned(whole, joint - top) + top + along - pivots[bone]
    return Pose(quats, shifts, pose.features)


class Shown(NamedTuple):
    """A frame, its pose, [1, J, ...], and the deformed Gaussians."""

    target: Target
    pose: Pose
    posed: Posed


class Found(NamedTuple):
    """The best path of a limb: a change for each frame, and the cost that it saves."""

    limb: Limb
    bends: Bends
    gain: float


@dataclass(frozen=True)
class LimbSearch:
    """The search in one clip.

    Attributes:
        model: as it is.
        supervision: of small images.
        strength: of the deformation, in [0, 1].
        weights: skinning weights of the model's Gaussians, [n, J].
    """

    model: Model
    supervision: Supervision
    strength: float
    weights: Tensor

    @classmethod
    @torch.no_grad()
    def of(cls, model: Model, supervision: Supervision, strength: float) -> "LimbSearch":
        """Prepare a search."""
        weights = model.field.sample(model.field.probabilities(), model.gaussians.means)
        return cls(model, supervision, strength, weights)

    @torch.no_grad()
    def poses(self, view: int) -> tuple[Pose, list[int]]:
        """Search all limbs in the frames of the film (``view`` 1) or of its mirror image (-1), the one that gains most
        first.

        Returns:
            The poses of those frames, [T, J, ...]; the bones of limbs that were found elsewhere.
        """
        model, supervision = self.model, self.supervision
        keys = [Key(view, view, frame) for frame in supervision.frames_of(view)]
        targets = [supervision.target(key) for key in keys]
        pose = model.pose(supervision.code_times(keys), keys)
        changed: list[int] = []
        waiting = self._farthest_first(pose, targets)
        while True:
            frames = [self._shown(target, _row(pose, i)) for i, target in enumerate(targets)]
            found = [one for limb in waiting if (one := self._best(limb, frames)).gain > 0]
            if not found:
                return pose, changed
            enough = ALIKE * max(one.gain for one in found)
            best = next(one for one in found if one.gain >= enough)
            pose = bent(pose, model.pivots, model.parents, best.limb, best.bends)
            changed += best.limb.bones
            waiting = [one.limb for one in found if one is not best]

    def _farthest_first(self, pose: Pose, targets: list[Target]) -> list[Limb]:
        """Order limbs by their first joints' distance from the camera."""
        eyes = torch.stack([target.eye for target in targets]).to(pose.shifts)
        away = (self.model.pivots + pose.shifts - eyes[:, None]).norm(dim=-1).mean(dim=0)
        found = limbs_of(self.model.parents, self.model.mirror)
        return sorted(found, key=lambda limb: -float(away[limb.bones[0]]))

    def _shown(self, target: Target, pose: Pose) -> Shown:
        return Shown(target, pose, self.model.moved(pose, self.weights, self.strength)[1])

    def _best(self, limb: Limb, frames: list[Shown]) -> Found:
        """Search one limb; a gain that is too small to believe is 0."""
        bends = Bends(*(each.to(self.model.pivots) for each in guesses(limb.slides)))
        costs = torch.stack([self._costs(frame, limb, bends) for frame in frames]) + BENT * bends.squared()
        path = cheapest_path(costs, JERKED * bends.changes())
        before, after = float(costs[:, 0].mean()), float(costs.gather(1, path[:, None]).mean())
        gain = before - after if before - after > max(GAIN, SHARE * before) else 0.0
        return Found(limb, bends.at(path), gain)

    def _costs(self, frame: Shown, limb: Limb, bends: Bends) -> Tensor:
        """Compute what each change costs in a frame, [C]."""
        own, parts, (target, pose, posed) = self.model.gaussians, self.weights.argmax(dim=1), frame
        inside, camera = torch.isin(parts, parts.new_tensor(limb.bones)), target.camera
        chosen = inside.nonzero()[:, 0]
        if not len(chosen):
            return torch.zeros_like(bends.whole)
        _, alpha, _ = rasterize(
            posed.means, nn.functional.normalize(posed.quats, dim=-1), own.scales(posed.log_scales),
            own.opacities().masked_fill(inside, 0.0), posed.means.new_zeros(len(parts), 1),
            camera.world_to_camera[None], camera.intrinsics[None], camera.width, camera.height,
        )  # fmt: skip
        mask = (target.mask[0] > 0.5).cpu().numpy()
        empty = mask & (alpha[0, 0] <= 0.5).cpu().numpy()
        chosen = chosen[:: -(-len(chosen) // POINTS)]
        pixels = self._pixels(target, pose, limb, bends, posed.means[chosen], parts[chosen])
        return SPILLED * _spilled(pixels, mask, target.side) + MISSED * _missed(pixels, empty, mask, target.side)

    def _pixels(self, target: Target, pose: Pose, limb: Limb, bends: Bends, points: Tensor, parts: Tensor) -> Tensor:
        """Compute where points [k, 3] of the limb, which go with bones ``parts`` [k], are in the image after each
        change, [C, k, 2]."""
        pivots, count = self.model.pivots, len(bends.whole)
        many = Pose(*(each.expand(count, *each.shape[1:]) for each in pose))
        after = joint_transforms(*bent(many, pivots, self.model.parents, limb, bends)[:2], pivots)
        carried = after @ torch.linalg.inv(joint_transforms(pose.quats, pose.shifts, pivots))
        at_one = nn.functional.pad(points, (0, 1), value=1.0)[..., None]
        moved = (carried[:, parts] @ at_one)[..., 0]
        camera = target.camera
        seen = moved @ camera.world_to_camera.to(moved).T
        seen = seen[..., :3] @ camera.intrinsics.to(moved).T
        return seen[..., :2] / seen[..., 2:].clamp_min(1e-3)


def learn_poses(model: Model, supervision: Supervision, found: Mapping[int, Pose], generator: torch.Generator) -> None:
    """Copy poses of the frames of each group, by its sign, into the pose network."""
    optimizer = torch.optim.Adam(model.network.parameters(), lr=RATE, fused=True)
    for index in range(COPIES):
        for group in optimizer.param_groups:
            group["lr"] = RATE * rise_and_fall(index / COPIES)
        distances = []
        for view, pose in found.items():
            frames = supervision.frames_of(view)
            rows = torch.randint(len(frames), (BATCH // len(found),), generator=generator)
            keys = [Key(view, view, frames[row]) for row in rows.tolist()]
            now = model.pose(supervision.code_times(keys), keys)
            distances.append(pose_distance(now, *(each[rows.to(each.device)] for each in pose[:2])))
        optimizer.zero_grad(set_to_none=True)
        torch.stack(distances).mean().backward()
        optimizer.step()


def _spilled(pixels: Tensor, mask: np.ndarray, side: float) -> Tensor:
    """Compute how far points [C, k, 2] lie outside the mask in the mean, as a share of `FAR`, [C]."""
    away = cv2.distanceTransform((~mask).astype(np.uint8), cv2.DIST_L2, 3) / side
    columns, rows = (pixels[..., axis].long().clamp(0, mask.shape[1 - axis] - 1) for axis in (0, 1))
    return (torch.from_numpy(away).to(pixels)[rows, columns].clamp(max=FAR) / FAR).mean(dim=1)


def _missed(pixels: Tensor, empty: np.ndarray, mask: np.ndarray, side: float) -> Tensor:
    """Compute the share of the mask that is ``empty`` times how far its pixels are from the nearest of points [C, k, 2]
    in the mean, in [0, 1], [C]; specks do not count."""
    kept = cv2.morphologyEx(empty.astype(np.uint8), cv2.MORPH_OPEN, np.ones((2, 2), np.uint8))
    places = np.argwhere(kept)[:, ::-1].astype(np.float32) + 0.5
    if not len(places):
        return pixels.new_zeros(len(pixels))
    some = torch.from_numpy(places[:: -(-len(places) // PIXELS)]).to(pixels)
    away = torch.cdist(some.expand(len(pixels), -1, -1), pixels).amin(dim=2) / side
    parts = FARTHER * away.clamp(max=FAR) / FAR + (1 - FARTHER) * away.clamp(max=NEAR) / NEAR
    return float(len(places) / mask.sum()) * parts.mean(dim=1)


def _row(pose: Pose, row: int) -> Pose:
    return Pose(*(each[row : row + 1] for each in pose))


def _about(axes: Tensor, angles: Tensor) -> Tensor:
    """Return quaternions of rotations about unit axes [B, 3] by angles [B], [B, 4]."""
    return torch.cat(((angles / 2).cos()[:, None], (angles / 2).sin()[:, None] * axes), dim=-1)


def _turned(quats: Tensor, vectors: Tensor) -> Tensor:
    return (quat_to_matrix(quats) @ vectors[..., None])[..., 0]
