"""Compute the volume that all input cameras look at: the frame of reference of a method without a prior."""

from collections.abc import Sequence
from dataclasses import replace

import torch
from torch import Tensor

from rewild4d.ours.symmetry import match_times
from rewild4d.transforms import camera_in_object, mirror_camera, similarity
from rewild4d.types import Camera, Clip, Prior

SCENE_HALF = 3.0
"""Half the side of the scene's cube: an animal that fills the frame is about as long as in the object frame."""
PULL = 1e-3
"""Weight of the world's origin against one view's: it decides only the depth that the views leave open."""
DRAWS = 8
"""Points drawn for each that is kept."""


def scene_frame(clip: Clip, prior: Prior) -> Prior:
    """Express the clip's cameras in the frame of the shared volume.

    Args:
        clip: gives the cameras; for frames without one the prior's are used.
        prior: gives nothing else.

    Returns:
        The prior with these cameras and one similarity for all times; its shape and poses are not to be used.
    """
    cameras = {
        row: frame.camera or camera_in_object(prior.cameras[row], torch.linalg.inv(prior.object_to_world[row].double()))
        for frame, row in zip(clip.frames, match_times(clip, prior), strict=True)
    }
    center, half = common_volume(list(cameras.values()))
    scene_to_world = similarity(half / SCENE_HALF, torch.eye(3, dtype=torch.float64), center)
    # Cameras of rows that the clip does not use are never read.
    inside = tuple(
        camera_in_object(cameras[row], scene_to_world) if row in cameras else camera
        for row, camera in enumerate(prior.cameras)
    )
    return replace(
        prior,
        object_to_world=scene_to_world.repeat(len(prior.times), 1, 1),
        cameras=inside,
        cameras_flip=tuple(map(mirror_camera, inside)),
    )


def common_volume(cameras: Sequence[Camera]) -> tuple[Tensor, float]:
    """Compute the cube around the point that is nearest to all optical axes through the image centres.

    It is as wide as the longer side of the narrowest view at that point.

    Args:
        cameras: in the world.

    Returns:
        Centre, float64, [3]; half side, world units.
    """
    matrix, right = torch.zeros(3, 3, dtype=torch.float64), torch.zeros(3, dtype=torch.float64)
    for camera in cameras:
        axis = _viewing_direction(camera)
        across = torch.eye(3, dtype=torch.float64) - axis[:, None] * axis
        matrix, right = matrix + across, right + across @ camera.center.double()
    center = torch.linalg.solve(matrix + PULL * len(cameras) * torch.eye(3, dtype=torch.float64), right)
    halves = []
    for camera in cameras:
        focal = torch.stack((camera.intrinsics[0, 0], camera.intrinsics[1, 1]))
        size = torch.tensor((camera.width, camera.height), dtype=torch.float64)
        halves.append(float((size / (2 * focal)).max() * (center - camera.center).norm()))
    return center, min(halves)


def random_points(count: int, cameras: Sequence[Camera], generator: torch.Generator) -> Tensor:
    """Draw uniform points of the scene's cube that lie in every image, or in most where too few do, [count, 3].

    Args:
        count: number of points.
        cameras: in the scene's frame.
        generator: the only source of randomness.
    """
    points = SCENE_HALF * (2 * torch.rand(DRAWS * count, 3, generator=generator) - 1)
    seen = torch.zeros(len(points))
    for camera in cameras:
        pixels, depth = camera.project(points)
        inside = (pixels >= 0) & (pixels <= pixels.new_tensor((camera.width, camera.height)))
        seen += inside.all(-1) & (depth > 0)
    return points[seen.argsort(descending=True, stable=True)[:count]]


def _viewing_direction(camera: Camera) -> Tensor:
    """Return the unit direction through the image centre, in the world, [3]."""
    middle = torch.tensor((camera.width / 2, camera.height / 2, 1.0), dtype=torch.float64)
    local = torch.linalg.solve(camera.intrinsics.double(), middle)
    return torch.nn.functional.normalize(camera.world_to_camera[:3, :3].double().T @ local, dim=0)
