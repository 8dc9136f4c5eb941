"""A prior that is the truth: the data set's own shape, skinning weights and skeleton, posed as it was.

With it a method shows what it makes of one camera when shape and motion need no guessing: a bound on what a better
prior could give. For studies: never the default, and named in the record.
"""

from dataclasses import replace

import numpy as np
import torch
from scipy.optimize import minimize
from scipy.spatial import cKDTree
from torch import Tensor

from rewild4d.priors.io import seal
from rewild4d.priors.silhouettes import known_camera, overlap
from rewild4d.transforms import (
    axis_angle_to_matrix,
    camera_in_object,
    mirror_camera,
    mirror_transforms,
    nearest_rotation,
    rigid,
    similarity,
    skin_points,
)
from rewild4d.types import OBJECT_DIAGONAL, Clip, Prior, Rig

YAWS = np.radians(np.arange(-40, 41, 10))
"""Turns of the symmetry plane about the vertical that are tried, around the template's."""
TWINS = 0.05 * OBJECT_DIAGONAL
"""How far a bone may be from where its twin's mirror image is, object units."""
SAMPLES = 3000
"""Points by which the symmetry plane is judged."""


def rig_prior(clip: Clip, rig: Rig, template: Prior) -> Prior:
    """Make a prior of the true animal.

    Args:
        clip: what the method sees; the prior's frames and cameras are its.
        rig: of the same frames.
        template: fitted to the clip: it tells left from right and head from tail, which a rig does not.

    Returns:
        A prior named "rig".

    Raises:
        UserError: a frame has no camera.
    """
    moved = rig.bones @ torch.linalg.inv(rig.bones_rest)
    posed = torch.stack([skin_points(rig.vertices, rig.weights, transforms) for transforms in moved])
    body = torch.stack([rigid_motion(rig.vertices, points) for points in posed])
    row = int((template.times - clip.times[0]).abs().argmin())
    axes = torch.linalg.inv(body[0])[:3, :3] @ template.object_to_world[row, :3, :3]
    object_to_rest = symmetric_frame(rig.vertices, axes / axes.norm(dim=0))
    rest_to_object = torch.linalg.inv(object_to_rest)
    object_to_world = body @ object_to_rest
    pivots = _moved(rig.bones_rest[:, :3, 3], rest_to_object)
    bones = torch.stack((pivots, _ends(pivots, rig.parents)), dim=1)
    mirror = twins(bones)
    transforms = _rigid_about(torch.linalg.inv(object_to_world)[:, None] @ moved @ object_to_rest, pivots).float()
    vertices = _moved(rig.vertices, rest_to_object).float()
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


def rigid_motion(points: Tensor, moved: Tensor) -> Tensor:
    """The rotation and translation that bring points closest to where they moved (Kabsch), [n, 3] each -> [4, 4]."""
    before, after = points.mean(0), moved.mean(0)
    turn = nearest_rotation((moved - after).T @ (points - before))
    return rigid(turn, after - turn @ before)


def symmetric_frame(points: Tensor, axes: Tensor) -> Tensor:
    """The object frame of a rest shape: x across its symmetry plane, y up, z to the head, bounding box as promised.

    Args:
        points: of the shape, [n, 3].
        axes: the three directions as columns, right but for some degrees, [3, 3].

    Returns:
        Similarity from the object frame to the points', [4, 4].
    """
    local = (points @ axes).numpy()
    tree = cKDTree(local)
    drawn = local[np.random.default_rng(0).permutation(len(local))[:SAMPLES]]
    size = float(np.linalg.norm(np.ptp(local, axis=0)))

    def cost(guess: np.ndarray) -> float:
        normal = _normal(guess)
        mirrored = drawn - 2 * (drawn @ normal - guess[2] * size)[:, None] * normal
        return float(tree.query(mirrored)[0].mean()) / size

    starts = [np.array((yaw, 0.0, local.mean(axis=0) @ _normal(np.array((yaw, 0.0))) / size)) for yaw in YAWS]
    best = minimize(cost, min(starts, key=cost), method="Nelder-Mead", options={"xatol": 1e-5, "fatol": 1e-7}).x
    turned = axes @ axis_angle_to_matrix(torch.tensor((0.0, best[0], best[1]), dtype=axes.dtype))
    seen = points @ turned
    low, high = seen.amin(0), seen.amax(0)
    center = (low + high) / 2
    center[0] = best[2] * size
    return similarity(float((high - low).norm()) / OBJECT_DIAGONAL, turned, turned @ center)


def _normal(guess: np.ndarray) -> np.ndarray:
    """Rotate the x axis about y and z, by one axis-angle vector (0, y, z)."""
    turn = axis_angle_to_matrix(torch.tensor((0.0, guess[0], guess[1]), dtype=torch.float64))
    return turn[:, 0].numpy()


def twins(bones: Tensor) -> Tensor:
    """The bone on the other side of each, itself where there is none, from both ends at rest: [J, 2, 3] -> [J]."""
    ends = bones.flatten(1)
    across = (bones * bones.new_tensor((-1.0, 1.0, 1.0))).flatten(1)
    apart, nearest = torch.cdist(across, ends).min(dim=1)
    own = torch.arange(len(bones))
    agreed = (nearest[nearest] == own) & (apart <= TWINS)
    return torch.where(agreed & agreed[nearest], nearest, own)


def _ends(pivots: Tensor, parents: Tensor) -> Tensor:
    """Return where bones end: the mean of their children's pivots; a bone without any goes on as its parent does."""
    ends = pivots.clone()
    for bone, pivot in enumerate(pivots):
        children = pivots[parents == bone]
        if len(children):
            ends[bone] = children.mean(0)
        elif int(parents[bone]) >= 0:
            ends[bone] = pivot + 0.5 * (pivot - pivots[int(parents[bone])])
    return ends


def _moved(points: Tensor, matrix: Tensor) -> Tensor:
    return points @ matrix[:3, :3].T + matrix[:3, 3]


def _rigid_about(transforms: Tensor, pivots: Tensor) -> Tensor:
    """Return the nearest rigid transforms that move the pivots [J, 3] as these [T, J, 4, 4] do: bones may be scaled."""
    turn = nearest_rotation(transforms[..., :3, :3])
    there = (transforms[..., :3, :3] @ pivots[..., None])[..., 0] + transforms[..., :3, 3]
    return rigid(turn, there - (turn @ pivots[..., None])[..., 0])
