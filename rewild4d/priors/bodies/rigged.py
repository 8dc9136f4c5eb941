"""A rig of one's own as a template: its shape, skeleton and skinning weights, with joint limits from its clips."""

from dataclasses import dataclass
from functools import cached_property

import torch
from torch import Tensor

from rewild4d.priors.bodies.body import Proportions, Template, to_unit
from rewild4d.priors.kinematics import depth_levels

LENGTH_SPREAD, GIRTH_SPREAD = 0.25, 0.25
"""One standard deviation of the logarithm of a bone's length, and of what it carries across its length."""


@dataclass(frozen=True)
class RiggedBody:
    """A rig at rest in object axes; see `Body` for what the fit asks of it.

    Each pair of bones has a length and a girth, of which its skin is a differentiable function.

    Attributes:
        name: of the file.
        bone_names: as in the file, [J].
        parents: of each bone, -1 for a root.
        mirror: the bone on the other side, of each.
        feet: bones whose end treads the ground.
        spreads: standard deviations of joint angles in its clips, radians, [J, 3].
        limits: bounds of joint angles, radians, [J, 3].
        rest: the rig as it is.
    """

    name: str
    bone_names: tuple[str, ...]
    parents: tuple[int, ...]
    mirror: tuple[int, ...]
    feet: tuple[int, ...]
    spreads: Tensor
    limits: Tensor
    rest: Template
    sections: int = 0

    @cached_property
    def pairs(self) -> list[int]:
        """Number of the pair that each bone is of, [J]."""
        firsts = sorted({min(bone, other) for bone, other in enumerate(self.mirror)})
        return [firsts.index(min(bone, other)) for bone, other in enumerate(self.mirror)]

    @property
    def measures(self) -> int:
        return 2 * (max(self.pairs) + 1)

    def build(self, shape: Proportions | None = None, *, unit: bool = True) -> Template:
        deviations = torch.zeros(self.measures) if shape is None else shape.deviations
        lengths, girths = deviations.unflatten(-1, (2, -1))[..., self.pairs].unbind(-2)
        long, thick = torch.exp(LENGTH_SPREAD * lengths), torch.exp(GIRTH_SPREAD * girths)
        stretched, starts = self._stretched(long, thick)
        shifts = starts - (stretched @ self.rest.bones[:, 0, :, None])[..., 0]
        affine = torch.cat((stretched, shifts[..., None]), dim=-1)
        ends = (affine[..., :3] @ self.rest.bones[:, 1, :, None])[..., 0] + shifts
        template = Template(
            vertices=_blended(affine, self.rest.vertices, self.rest.weights),
            faces=self.rest.faces,
            weights=self.rest.weights,
            bones=torch.stack((starts, ends), dim=-2),
            parents=self.parents,
            mirror=self.mirror,
            blobs=_blended(affine, self.rest.blobs, self.rest.blob_weights),
            blob_sizes=self.rest.blob_sizes * (thick @ self.rest.blob_weights.T),
            blob_weights=self.rest.blob_weights,
            cover=_blended(affine, self.rest.cover, self.rest.cover_weights),
            cover_weights=self.rest.cover_weights,
            quads=self.rest.quads,
        )
        return to_unit(template) if unit else template

    def _stretched(self, long: Tensor, thick: Tensor) -> tuple[Tensor, Tensor]:
        """Return how bones stretch what they carry, [..., J, 3, 3], and where they start then, [..., J, 3]."""
        old = self.rest.bones
        axis = torch.nn.functional.normalize(old[:, 1] - old[:, 0], dim=-1)
        along = axis[:, :, None] * axis[:, None, :]
        stretched = thick[..., None, None] * torch.eye(3) + (long - thick)[..., None, None] * along
        starts: dict[int, Tensor] = {}
        for level in depth_levels(self.parents):
            for bone in level:
                parent, start = self.parents[bone], old[bone, 0].expand(*long.shape[:-1], 3)
                if parent >= 0:
                    step = (stretched[..., parent, :, :] @ (old[bone, 0] - old[parent, 0])[:, None])[..., 0]
                    start = starts[parent] + step
                starts[bone] = start
        return stretched, torch.stack([starts[bone] for bone in range(len(old))], dim=-2)

    def carriage(self, bones: Tensor, transforms: Tensor) -> Tensor:
        """A rig's head and tail may be anywhere: no penalty."""
        return torch.zeros(len(bones))


def _blended(affine: Tensor, points: Tensor, weights: Tensor) -> Tensor:
    """Move points [n, 3] by the weighted mean of bones' transforms [..., J, 3, 4]."""
    blended = (weights @ affine.flatten(-2)).unflatten(-1, (3, 4))
    return (blended[..., :3] @ points[:, :, None])[..., 0] + blended[..., 3]
