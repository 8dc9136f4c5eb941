"""A prior of a posed template."""

from collections.abc import Sequence

import torch
from torch import Tensor

from rewild4d.priors.bodies.body import Template
from rewild4d.transforms import mirror_camera, mirror_transforms
from rewild4d.types import Camera, Prior


def posed_prior(
    template: Template, transforms: Tensor, object_to_world: Tensor, cameras: Sequence[Camera], times: Tensor, *,
    name: str, provenance: str, quality: dict[str, float] | None = None, digest: str = "",
) -> Prior:  # fmt: skip
    """Make a prior of the posed template with the exact mirror image as its mirrored half; arguments as in `Prior`."""
    mirror = torch.tensor(template.mirror)
    return Prior(
        name=name, provenance=provenance, vertices=template.vertices, faces=template.faces, weights=template.weights,
        bones=template.bones, parents=torch.tensor(template.parents), mirror=mirror, times=times,
        object_to_world=object_to_world, cameras=tuple(cameras), transforms=transforms,
        cameras_flip=tuple(map(mirror_camera, cameras)), transforms_flip=mirror_transforms(transforms, mirror),
        quality=quality or {}, digest=digest,
    )  # fmt: skip
