"""The learnable model, and its two branches."""

from collections.abc import Iterator

import torch
from torch import Tensor, nn

from rewild4d.ours.canonical import Gaussians, Posed, initial_gaussians
from rewild4d.ours.config import Config
from rewild4d.ours.deform import DeformNetwork
from rewild4d.ours.evidence import Sighting, training_views
from rewild4d.ours.fused.skinning import SKINNING, skin_both
from rewild4d.ours.inputs import Scalar
from rewild4d.ours.pose import Pose, PoseNetwork, joint_transforms, time_code
from rewild4d.ours.skinning import SkinningField, build_field
from rewild4d.ours.symmetry import Key, Supervision
from rewild4d.ours.turns import Turns
from rewild4d.transforms import quat_multiply, skin_points, skin_quats
from rewild4d.types import Prior


class Model(nn.Module):
    """Canonical Gaussians, skinning field, pose network and deformation network, in the object frame.

    Attributes:
        turns: turns of each frame's joints beside the pose network, or None.
        pivots: inner end of each bone at rest, [J, 3].
        mirror: bone on the other side, [J].
        parents: -1 for a root, [J].
    """

    pivots: Tensor
    mirror: Tensor
    parents: Tensor

    def __init__(
        self,
        config: Config,
        gaussians: Gaussians,
        field: SkinningField,
        pivots: Tensor,
        parents: Tensor,
        mirror: Tensor,
        generator: torch.Generator,
        times: Tensor | None = None,
    ) -> None:
        super().__init__()
        self.config = config
        self.gaussians, self.field = gaussians, field
        self.network = PoseNetwork(len(parents), config.pose, generator)
        parts = config.pose.anchor_size if config.pose.anchors else len(parents)
        self.deform = DeformNetwork(parts, config.pose.width, config.deform, generator)
        self.turns: Turns | None = None
        if config.pose.turns:
            assert times is not None, "turns need the frames' times"
            self.turns = Turns(times, len(parents), config.pose.tied)
        self.register_buffer("pivots", pivots)
        self.register_buffer("mirror", mirror)
        self.register_buffer("parents", parents)

    def pose(self, times: Tensor, keys: list[Key]) -> Pose:
        """Compute poses of views at (jittered) times (i + 1) / T, [B]; where tied, mirror images share a pose."""
        codes, flipped = self.codes(times, keys)
        codes, flipped = codes.to(self.pivots), flipped.to(self.pivots.device)
        return self.turned(self.pose_of(codes, flipped), codes, flipped)

    def codes(self, times: Tensor, keys: list[Key]) -> tuple[Tensor, Tensor]:
        """Return time codes [B, E] of views at times [B], and which of them are mirror images, boolean, [B]."""
        config = self.config.pose
        view = torch.tensor([float(key.view) for key in keys])
        group = torch.tensor([float(key.group) for key in keys])
        sign, flipped = group if config.encoding == "group" else view, view < 0
        if config.tied:
            sign = view = torch.ones(len(keys))
        return time_code(times, sign, view, config.frequencies, config.explicit_group), flipped

    def pose_of(self, codes: Tensor, flipped: Tensor) -> Pose:
        """Compute the network's poses of time codes [B, E]; where tied, those of mirror images are mirrored by
        ``flipped`` [B]."""
        return self.network(codes, flipped, self.mirror) if self.config.pose.tied else self.network(codes)

    def turned(self, pose: Pose, codes: Tensor, flipped: Tensor) -> Pose:
        """Turn the joints of poses of time codes [B, E] by what their frames have beside the network."""
        if self.turns is None:
            return pose
        turns = self.turns(codes[:, 0].abs(), flipped, self.mirror)
        return pose._replace(quats=quat_multiply(turns, pose.quats))

    def transforms(self, pose: Pose) -> Tensor:
        """Return rest -> posed transforms of a batch of poses, [B, J, 4, 4]."""
        return joint_transforms(pose.quats, pose.shifts, self.pivots)

    def skin(self, weights: Tensor, quats: Tensor, transforms: Tensor) -> tuple[Posed, Posed]:
        """Skin the canonical Gaussians by weights [n, J] for the pose branch and for the appearance branch.

        Both have the same values; gradients of the second do not reach the joints, unless `loss.isolated` is off.
        """
        own, log_scales = self.gaussians, self.gaussians.scales_log()
        if SKINNING.takes(own.means, owner=self):
            live_means, live_quats, means, quats = skin_both(own.means, own.quats, weights, transforms, quats)
            live = Posed(live_means, live_quats, log_scales)
            return live, Posed(means, quats, log_scales) if self.config.loss.isolated else live
        rest = nn.functional.normalize(own.quats, dim=-1)
        live, still = (
            Posed(skin_points(own.means, weights, matrices), skin_quats(rest, weights, rotations), log_scales)
            for matrices, rotations in ((transforms, quats), (transforms.detach(), quats.detach()))
        )
        return live, still if self.config.loss.isolated else live

    def deformed(
        self, pose: Pose, weights: Tensor, posed: Posed, strength: Scalar | None, offset: float = 0.0
    ) -> Posed:
        """Apply the deformation network to skinned Gaussians at a pose of one code, with a ``strength`` above zero, or
        None for none; see `DeformNetwork.forward`."""
        if strength is None or not self.config.deform.enabled:
            return posed
        features = pose.features[0].detach() if self.config.deform.detach_features else pose.features[0]
        return self.deform(features, weights, self.network.anchors, posed, strength, offset)

    def moved(self, pose: Pose, weights: Tensor, strength: float) -> tuple[Posed, Posed]:
        """Return skinned Gaussians of the appearance branch at a pose of one code, and the same deformed."""
        posed = self.skin(weights, pose.quats[0], self.transforms(pose)[0])[1]
        return posed, self.deformed(pose, weights, posed, strength or None)


def sightings(model: Model, supervision: Supervision, mirrored: float = 0.0) -> Iterator[Sighting]:
    """Pose the Gaussians as each training view shows them; a share ``mirrored`` of the steps sees mirror images."""
    weights = model.field.sample(model.field.probabilities(), model.gaussians.means)
    for key, share in training_views(supervision, mirrored):
        pose = model.pose(supervision.code_times([key]), [key])
        yield Sighting(key, share, model.skin(weights, pose.quats[0], model.transforms(pose)[0])[1])


def build_model(config: Config, prior: Prior, generator: torch.Generator, times: Tensor | None = None) -> Model:
    """Build the initial model: Gaussians on the prior's rest surface, the field filled from its weights.

    `pose.turns` needs the ``times`` of the clip's frames for the time code (`Supervision.frame_times`), [T].
    """
    values = initial_gaussians(prior, config.canonical, generator, config.prior.shape)
    field = build_field(prior.vertices.float(), prior.weights.float(), prior.mirror.long(), config.skinning)
    skeleton = (prior.bones[:, 0].float(), prior.parents.long(), prior.mirror.long())
    return Model(config, Gaussians(values, config.canonical.max_scale), field, *skeleton, generator, times)
