"""Make a prior of the truth: the data set's own shape, skinning weights, skeleton and poses.

It bounds what a better prior could give. For studies only: never the default, and named in the record.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import torch
from scipy.optimize import minimize
from scipy.spatial import cKDTree
from torch import Tensor

from rewild4d.priors.io import seal
from rewild4d.priors.kinematics import moved
from rewild4d.priors.silhouettes import known_camera, overlap
from rewild4d.transforms import (
    axis_angle_to_matrix,
    camera_in_object,
    mirror_camera,
    mirror_points,
    mirror_transforms,
    nearest_rotation,
    rigid,
    similarity,
    skin_points,
)
from rewild4d.types import OBJECT_DIAGONAL, Clip, Prior, Rig

YAWS = np.radians(np.arange(-40, 41, 10))
"""Yaws of the symmetry plane that are tried, from the template's, radians."""
TWINS = 0.05 * OBJECT_DIAGONAL
"""Largest distance of a bone from the mirror image of the bone on the other side, object units."""
SAMPLES = 3000
"""Points that the symmetry plane is fitted to."""


def rig_prior(clip: Clip, rig: Rig, template: Prior) -> Prior:
    """Make a prior named "rig" of the true animal in the clip's frames.

    The template, fitted to the clip, gives left and head, which a rig does not name.

    Raises:
        UserError: a frame has no camera.
    """
    motion = rig.bones @ torch.linalg.inv(rig.bones_rest)
    posed = [skin_points(rig.vertices, rig.weights, transforms) for transforms in motion]
    body = torch.stack([rigid_motion(rig.vertices, points) for points in posed])
    row = int((template.times - clip.times[0]).abs().argmin())
    axes = torch.linalg.inv(body[0])[:3, :3] @ template.object_to_world[row, :3, :3]
    object_to_rest = symmetric_frame(rig.vertices, axes / axes.norm(dim=0))
    rest_to_object = torch.linalg.inv(object_to_rest)
    object_to_world = body @ object_to_rest
    pivots = _in_frame(rig.bones_rest[:, :3, 3], rest_to_object)
    bones = torch.stack((pivots, _ends(pivots, rig.parents)), dim=1)
    mirror = twins(bones)
    transforms = _rigid_about(torch.linalg.inv(object_to_world)[:, None] @ motion @ object_to_rest, pivots).float()
    vertices = _in_frame(rig.vertices, rest_to_object).float()
    weights = rig.weights.float()
    cameras = tuple(
        camera_in_object(known_camera(frame, clip.name), matrix)
        for frame, matrix in zip(clip.frames, object_to_world, strict=True)
    )
    drawn = [skin_points(vertices, weights, matrices) for matrices in transforms]
    quality = {"mask_iou": overlap(drawn, rig.faces, cameras, [frame.mask for frame in clip.frames])}
    return seal(
        replace(
            template, name="rig", vertices=vertices, faces=rig.faces, weights=weights, bones=bones.float(),
            provenance="The data set's own shape, skinning weights and bones; left and head as the template's fit has "
            "them.", parents=rig.parents, mirror=mirror, times=torch.tensor(clip.times, dtype=torch.float64),
            object_to_world=object_to_world, cameras=cameras, transforms=transforms,
            cameras_flip=tuple(mirror_camera(camera) for camera in cameras),
            transforms_flip=mirror_transforms(transforms, mirror), quality=quality, digest="", notes=(),
        )
    )  # fmt: skip


def rigid_motion(points: Tensor, others: Tensor) -> Tensor:
    """Return the rigid motion that best maps points to others (Kabsch), [n, 3] each -> [4, 4]."""
    before, after = points.mean(0), others.mean(0)
    rotation = nearest_rotation((others - after).T @ (points - before))
    return rigid(rotation, after - rotation @ before)


def symmetric_frame(points: Tensor, axes: Tensor) -> Tensor:
    """Return the similarity from a shape's object frame: x normal to its symmetry plane, y up, z to the head, [4, 4].

    ``points`` [n, 3] are those of the shape, and the columns of ``axes`` [3, 3] are x, y and z to some degrees.
    """
    local = (points @ axes).numpy()
    tree = cKDTree(local)
    drawn = local[np.random.default_rng(0).permutation(len(local))[:SAMPLES]]
    size = float(np.linalg.norm(np.ptp(local, axis=0)))

    def cost(guess: np.ndarray) -> float:
        normal = _normal(guess)
        mirrored = drawn - 2 * (drawn @ normal - guess[2] * size)[:, None] * normal
        return float(tree.query(mirrored)[0].mean()) / size

    starts = [np.array((yaw, 0.0, local.mean(axis=0) @ _normal((yaw, 0.0)) / size)) for yaw in YAWS]
    best = minimize(cost, min(starts, key=cost), method="Nelder-Mead", options={"xatol": 1e-5, "fatol": 1e-7}).x
    rotation = axes @ axis_angle_to_matrix(torch.tensor((0.0, best[0], best[1]), dtype=axes.dtype))
    seen = points @ rotation
    low, high = seen.amin(0), seen.amax(0)
    center = (low + high) / 2
    center[0] = best[2] * size
    return similarity(float((high - low).norm()) / OBJECT_DIAGONAL, rotation, rotation @ center)


def _normal(guess: Sequence[float] | np.ndarray) -> np.ndarray:
    """Return the x axis rotated by the axis-angle vector (0, guess[0], guess[1])."""
    return axis_angle_to_matrix(torch.tensor((0.0, guess[0], guess[1]), dtype=torch.float64))[:, 0].numpy()


def twins(bones: Tensor) -> Tensor:
    """Return each bone's counterpart on the other side, else itself, from both ends at rest, [J, 2, 3] -> [J]."""
    apart, nearest = torch.cdist(mirror_points(bones).flatten(1), bones.flatten(1)).min(dim=1)
    own = torch.arange(len(bones))
    agreed = (nearest[nearest] == own) & (apart <= TWINS)
    return torch.where(agreed & agreed[nearest], nearest, own)


def _ends(pivots: Tensor, parents: Tensor) -> Tensor:
    """Return the ends of bones: the mean of their children's pivots; without children half the parent's length on."""
    ends = pivots.clone()
    for bone, pivot in enumerate(pivots):
        children = pivots[parents == bone]
        if len(children):
            ends[bone] = children.mean(0)
        elif int(parents[bone]) >= 0:
            ends[bone] = pivot + 0.5 * (pivot - pivots[int(parents[bone])])
    return ends


def _in_frame(points: Tensor, matrix: Tensor) -> Tensor:
    return points @ matrix[:3, :3].T + matrix[:3, 3]


def _rigid_about(transforms: Tensor, pivots: Tensor) -> Tensor:
    """Return the nearest rigid transforms that move the pivots [J, 3] as these [T, J, 4, 4] do: bones may be scaled."""
    rotation = nearest_rotation(transforms[..., :3, :3])
    return rigid(rotation, moved(pivots, transforms) - (rotation @ pivots[..., None])[..., 0])
