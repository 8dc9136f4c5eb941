"""Part anchors, the symmetry-aware time code and the pose network."""

from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor, nn

from rewild4d.ours.config import Pose as PoseConfig
from rewild4d.ours.fused.pose_layers import fits_sizes, sizes_of
from rewild4d.ours.fused.posing import POSE_NETWORK, codes, poses
from rewild4d.transforms import constant, mirror_points, mirror_quats, quat_to_matrix, rigid
from rewild4d.types import OBJECT_DIAGONAL


class Pose(NamedTuple):
    """Poses of a batch of codes.

    Attributes:
        quats: unit rotation of each joint about its pivot, w may be negative, [B, J, 4].
        shifts: translation of each joint in the object frame, [B, J, 3].
        features: part features F_J for the deformation network, [B, J, K].
    """

    quats: Tensor
    shifts: Tensor
    features: Tensor

    def mirrored(self, mirror: Tensor) -> "Pose":
        """Exchange left and right."""
        return Pose(
            mirror_quats(self.quats[:, mirror]), mirror_points(self.shifts[:, mirror]), self.features[:, mirror]
        )


def time_code(time: Tensor, group: Tensor, view: Tensor, frequencies: int, explicit_group: bool = False) -> Tensor:
    """Compute the symmetry-aware code emb(t m) + v (METHOD section 4): [tau, sin 2^k tau, cos 2^k tau] of tau = t m,
    then v.

    Args:
        time: (i + 1) / T for frame i, never zero, where both groups would get one code, [B].
        group: m, +1 for the sequence and -1 for its flip, [B].
        view: v, +1 for an image and -1 for its mirror image, [B].
        frequencies: octaves; no factor pi, which would give both groups one code at time 1.
        explicit_group: append m.

    Returns:
        [B, 2 + 2 frequencies (+ 1)].
    """
    if POSE_NETWORK.takes(time):
        return codes(time, group, view, frequencies, explicit_group)
    tau = (time * group)[:, None]
    angles = tau * 2.0 ** torch.arange(frequencies, dtype=tau.dtype, device=tau.device)
    parts = [tau, angles.sin(), angles.cos(), view.to(tau)[:, None]]
    return torch.cat(parts + [group.to(tau)[:, None]] * explicit_group, dim=-1)


class PoseNetwork(nn.Module):
    """Anchors + code -> self-attention over the parts -> one rotation and translation per joint.

    The head starts at zero, so every pose starts as the rest pose. Without anchors one linear layer makes the tokens of
    all parts from the code alone.

    Attributes:
        anchors: one learnable vector per part, [J, D], or None.
    """

    anchors: nn.Parameter | None

    def __init__(self, joints: int, config: PoseConfig, generator: torch.Generator) -> None:
        super().__init__()
        self.config, self.joints = config, joints
        code = 2 + 2 * config.frequencies + config.explicit_group
        if config.anchors:
            start = config.anchor_std * torch.randn(joints, config.anchor_size, generator=generator)
            self.anchors, self.embed = nn.Parameter(start), nn.Linear(config.anchor_size + code, config.width)
        else:
            self.register_parameter("anchors", None)
            self.embed = nn.Linear(code, joints * config.width)
        self.blocks = nn.ModuleList(Block(config.width, config.heads) for _ in range(config.blocks))
        self.norm = nn.LayerNorm(config.width)
        self.head = nn.Linear(config.width, 7)
        self._layers = [layer for layer in self.modules() if layer is not self and layer._parameters]
        seed_linears(self, generator)
        nn.init.zeros_(self.head.weight)
        nn.init.zeros_(self.head.bias)

    def forward(self, code: Tensor, flipped: Tensor | None = None, mirror: Tensor | None = None) -> Pose:
        """Compute poses of codes [B, E], with left and right exchanged by ``mirror`` [J] where ``flipped`` [B]."""
        if (
            self.anchors is not None
            and POSE_NETWORK.takes(self.anchors, owner=self)
            and fits_sizes(self.config.width, self.config.heads)
            and not code.requires_grad
        ):
            return self._fused(self.anchors, code, flipped, mirror)
        pose = self._plain(code)
        if flipped is None or mirror is None:
            return pose
        pick = flipped[:, None, None]
        return Pose(*(torch.where(pick, other, own) for own, other in zip(pose, pose.mirrored(mirror), strict=True)))

    def _fused(self, anchors: Tensor, code: Tensor, flipped: Tensor | None, mirror: Tensor | None) -> Pose:
        config, (joints, anchor) = self.config, anchors.shape
        # The modules' own generator of parameters takes longer than a layer.
        layers = (each for layer in self._layers for each in layer._parameters.values() if each is not None)
        parameters = [anchors, *layers]
        network = (config.width, config.heads, config.blocks, config.reach * OBJECT_DIAGONAL)
        sizes = sizes_of(joints, anchor, anchor + code.shape[1], *network, len(code))
        if flipped is None or mirror is None:
            return Pose(*poses(sizes, parameters, code, np.zeros(len(code), np.bool_), np.arange(joints)))
        return Pose(*poses(sizes, parameters, code, flipped.numpy(), mirror.numpy()))

    def _plain(self, code: Tensor) -> Pose:
        hidden = self._tokens(code)
        for block in self.blocks:
            hidden = block(hidden)
        features = self.norm(hidden)
        out = self.head(features)
        identity = constant((1.0, 0.0, 0.0, 0.0), out)
        quats = nn.functional.normalize(identity + out[..., :4], dim=-1)
        return Pose(quats, out[..., 4:] * (self.config.reach * OBJECT_DIAGONAL), features)

    def _tokens(self, code: Tensor) -> Tensor:
        """Embed codes [B, E] as a token for each part, [B, J, K]."""
        if self.anchors is None:
            return self.embed(code).unflatten(1, (self.joints, -1))
        anchors = self.anchors.expand(len(code), self.joints, -1)
        return self.embed(torch.cat((anchors, code[:, None].expand(-1, self.joints, -1)), dim=-1))


class Block(nn.Module):
    """Pre-norm self-attention and a two-layer perceptron."""

    def __init__(self, width: int, heads: int) -> None:
        super().__init__()
        self.heads = heads
        self.norm_attention, self.norm_mlp = nn.LayerNorm(width), nn.LayerNorm(width)
        self.qkv, self.project = nn.Linear(width, 3 * width), nn.Linear(width, width)
        self.up, self.down = nn.Linear(width, 2 * width), nn.Linear(2 * width, width)

    def forward(self, hidden: Tensor) -> Tensor:
        """Apply the block, [B, J, K] -> [B, J, K]."""
        batch, joints, width = hidden.shape
        qkv = self.qkv(self.norm_attention(hidden)).view(batch, joints, 3, self.heads, -1).permute(2, 0, 3, 1, 4)
        query, key, value = qkv.unbind(0)
        scores = (query @ key.transpose(-1, -2)) * (width / self.heads) ** -0.5
        mixed = (scores.softmax(dim=-1) @ value).transpose(1, 2).reshape(batch, joints, width)
        hidden = hidden + self.project(mixed)
        return hidden + self.down(nn.functional.gelu(self.up(self.norm_mlp(hidden))))


def seed_linears(module: nn.Module, generator: torch.Generator) -> None:
    """Draw every linear layer's weights from one generator: uniform within 1/sqrt(inputs), biases zero."""
    for layer in module.modules():
        if isinstance(layer, nn.Linear):
            bound = layer.in_features**-0.5
            with torch.no_grad():
                layer.weight.uniform_(-bound, bound, generator=generator)
                layer.bias.zero_()


def joint_transforms(quats: Tensor, shifts: Tensor, pivots: Tensor) -> Tensor:
    """Compute rest -> posed transforms P_j x = R_j (x - c_j) + c_j + d_j, [..., J, 4, 4].

    Args:
        quats: [..., J, 4].
        shifts: d, [..., J, 3].
        pivots: c, [J, 3].
    """
    rotation = quat_to_matrix(quats)
    return rigid(rotation, pivots + shifts - (rotation @ pivots[..., None])[..., 0])


def blend_poses(pose: Pose, quats: Tensor, shifts: Tensor, weight: float | Tensor) -> Pose:
    """Blend (1 - weight) of a pose with weight of quats [B, J, 4] and shifts [B, J, 3], never as matrices."""
    mixed = (1 - weight) * pose.quats + weight * aligned(quats, pose.quats)
    return Pose(nn.functional.normalize(mixed, dim=-1), (1 - weight) * pose.shifts + weight * shifts, pose.features)


def aligned(quats: Tensor, reference: Tensor) -> Tensor:
    """Flip the signs of quaternions to the reference's hemisphere, [..., 4]."""
    return torch.where((quats * reference).sum(-1, keepdim=True) < 0, -quats, quats)


def pose_distance(pose: Pose, quats: Tensor, shifts: Tensor) -> Tensor:
    """Compute the mean over joints of |q^ - q|^2 + |d^ - d|^2 / diagonal^2, scalar."""
    rotation = (pose.quats - aligned(quats, pose.quats).detach()).square().sum(-1)
    return (rotation + (pose.shifts - shifts).square().sum(-1) / OBJECT_DIAGONAL**2).mean()
