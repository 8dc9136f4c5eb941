"""The second look at the poses: fitted again, now with the learnt Gaussians instead of the shape of the prior.

The prior's proportions are not the animal's, so its poses carry that error, above all in depth, which one view at a
moment cannot see. Chained joints and short cosine series over time let a moment be helped by its neighbours.
"""

import torch
from torch import Tensor, nn

from rewild4d.ours.config import Repose
from rewild4d.ours.losses import blurred
from rewild4d.ours.model import Model
from rewild4d.ours.pose import joint_transforms, pose_distance
from rewild4d.ours.symmetry import Key, Supervision
from rewild4d.priors.hypotheses import cosine_series
from rewild4d.priors.kinematics import depth_levels
from rewild4d.rasterizer import rasterize
from rewild4d.transforms import axis_angle_to_matrix, matrix_to_quat, mirror_transforms, rigid, skin_points, skin_quats
from rewild4d.types import OBJECT_DIAGONAL


class Correction(nn.Module):
    """Smooth changes of a sequence of poses; all parameters whitened and zero at the start.

    Attributes:
        turn: cosine series of the whole body's rotation about the middle of the animal, [K, 3].
        shift: of its translation, [K, 3].
        angles: of each joint's rotation about its pivot, axes of the object frame at rest, [L, J, 3].
    """

    def __init__(self, start: Tensor, pivots: Tensor, parents: list[int], config: Repose) -> None:
        super().__init__()
        frames, joints = start.shape[:2]
        self.config, self.start, self.pivots, self.parents = config, start, pivots, parents
        self.levels = depth_levels(parents)
        root, limbs = 1 + round((frames - 1) * config.root_terms), 1 + round((frames - 1) * config.joint_terms)
        self.root_series = cosine_series(frames, root).to(start)
        self.joint_series = cosine_series(frames, limbs).to(start)
        self.turn = nn.Parameter(start.new_zeros(root, 3))
        self.shift = nn.Parameter(start.new_zeros(root, 3))
        self.angles = nn.Parameter(start.new_zeros(limbs, joints, 3))
        above = start[:, [max(parent, 0) for parent in parents]]
        self.local = torch.linalg.inv(above) @ start
        self.center = (start[..., :3, :3] @ pivots[..., None])[..., 0].mean(1) + start[..., :3, 3].mean(1)

    def forward(self) -> Tensor:
        """Rest -> posed transforms after the change, [T, J, 4, 4]."""
        spreads = self.angles.new_tensor(self.config.joint_spread)
        bend = axis_angle_to_matrix(torch.einsum("tk,kja->tja", self.joint_series, self.angles) * spreads)
        own = rigid(bend, self.pivots - (bend @ self.pivots[..., None])[..., 0])
        turn = axis_angle_to_matrix(self.root_series @ self.turn * self.config.turn_spread)
        place = self.center + self.root_series @ self.shift * (self.config.shift_spread * OBJECT_DIAGONAL)
        whole = rigid(turn, place - (turn @ self.center[..., None])[..., 0])
        posed: dict[int, Tensor] = {}
        for level in self.levels:
            for bone in level:
                parent = self.parents[bone]
                base = whole @ self.start[:, bone] if parent < 0 else posed[parent] @ self.local[:, bone]
                posed[bone] = base @ own[:, bone]
        return torch.stack([posed[bone] for bone in range(len(self.parents))], dim=1)

    def penalty(self) -> Tensor:
        """How unusual the change is: summed squares of all whitened parameters over the moments, scalar."""
        squares = self.turn.square().sum() + self.shift.square().sum() + self.angles.square().sum()
        return squares / len(self.start)


def repose(model: Model, supervision: Supervision, config: Repose, side: int, generator: torch.Generator) -> Tensor:
    """Fit the poses of one side again to the images.

    Args:
        model: its Gaussians and skinning weights stay as they are.
        supervision: images, and the poses that are the start.
        config: steps and spreads.
        side: 0 for the images, 1 for their mirror images with the prior's own cameras for those.
        generator: draws the Gaussians that stand for the body.

    Returns:
        Rest -> posed transforms, [T, J, 4, 4].
    """
    own = model.gaussians
    keys = [Key(1 - 2 * side, 1 - 2 * side, frame) for frame in range(supervision.frames)]
    with torch.no_grad():
        start = joint_transforms(supervision.prior_quats[side], supervision.prior_shifts[side], model.pivots)
        weights = model.field.sample(model.field.probabilities(), own.means)
        rest, scales = nn.functional.normalize(own.quats, dim=-1), own.scales(own.scales_log())
        features, opacities = own.rgb().clone(), own.opacities()
        means = own.means.detach()
    change = Correction(start, model.pivots, model.parents.tolist(), config)
    optimizer = torch.optim.Adam(change.parameters(), lr=config.rate, betas=(0.9, 0.98))
    for step in range(config.steps):
        progress = step / config.steps
        optimizer.param_groups[0]["lr"] = config.rate * min(1.0, 2 * (1 - progress))
        picked = torch.randperm(len(keys), generator=generator)[: config.frames].tolist()
        transforms = change()
        loss = config.penalty * change.penalty()
        for frame in picked:
            target = supervision.target(keys[frame])
            camera, matrix = target.camera, transforms[frame]
            quats = skin_quats(rest, weights, matrix_to_quat(matrix[:, :3, :3].detach()))
            image, alpha, _ = rasterize(
                skin_points(means, weights, matrix), quats, scales, opacities, features,
                camera.world_to_camera[None], camera.intrinsics[None], camera.width, camera.height,
            )  # fmt: skip
            sigma = round(target.side * (config.blur[0] * (1 - progress) + config.blur[1] * progress), 1)
            difference = torch.cat((config.colour**0.5 * (image[0] - target.rgb), alpha[0] - target.mask))
            loss = loss + torch.stack([blurred(part, sigma) for part in difference]).square().sum() / (
                target.side**2 * len(picked)
            )
        optimizer.zero_grad(set_to_none=True)
        loss.backward()
        optimizer.step()
    return change().detach()


def copy_poses(model: Model, supervision: Supervision, config: Repose, generator: torch.Generator) -> None:
    """Teach the pose network the supervision's poses, everything else untouched.

    Args:
        model: its pose network changes.
        supervision: the poses.
        config: steps and learning rate.
        generator: draws the views.
    """
    optimizer = torch.optim.Adam(model.network.parameters(), lr=config.copy_rate)
    for step in range(config.copy_steps):
        place = step / config.copy_steps
        optimizer.param_groups[0]["lr"] = config.copy_rate * min(1.0, 0.1 + 10 * place, 1.5 * (1 - place))
        keys = [supervision.draw(generator) for _ in range(config.copies)]
        times = torch.tensor([(key.frame + 1) / supervision.frames for key in keys])
        distance = pose_distance(model.pose(times, keys), *supervision.prior_pose(keys))
        optimizer.zero_grad(set_to_none=True)
        distance.backward()
        optimizer.step()


def look_again(
    model: Model, supervision: Supervision, small: Supervision, config: Repose, generator: torch.Generator
) -> None:
    """Replace the poses of both supervisions by fitted ones, and teach them to the network.

    Args:
        model: its pose network changes.
        supervision: of the training.
        small: the same in smaller images, where the poses are fitted.
        config: every choice.
        generator: the source of chance.
    """
    plain = repose(model, small, config, 0, generator)
    flipped = mirror_transforms(plain, model.mirror) if small.symmetric else repose(model, small, config, 1, generator)
    for views in (supervision, small):
        views.set_poses(torch.stack((plain, flipped)), model.pivots)
    copy_poses(model, supervision, config, generator)
