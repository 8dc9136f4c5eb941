"""Cameras of PyTorch3D, as CoP3D and CO3D store them, to OpenCV's and back.

A world point is a row vector: X_camera = X_world R + T, with axes +x to the left, +y up and +z into the scene. A focal
length f and a principal point p are in normalised device coordinates, where the image of a point is f X / Z + p. In
"ndc_isotropic" the image's shorter side spans [-1, 1]; in "ndc_norm_image_bounds" each side does. Sources:
facebookresearch/co3d co3d/dataset/data_types.py @ eb51d75; facebookresearch/pytorch3d docs/notes/cameras.md,
pytorch3d/renderer/camera_conversions.py and pytorch3d/implicitron/dataset/frame_data.py @ 9381c401.
"""

from typing import Any

import msgspec
import numpy as np
import torch

from rewild4d.types import Camera

FORMATS = ("ndc_norm_image_bounds", "ndc_isotropic")
RIGHT = 1e-3
"""Largest deviation of R's rows from an orthonormal right-handed frame; files hold single precision."""
_FLIP = np.array((-1.0, -1.0, 1.0))
"""PyTorch3D's camera axes in OpenCV's."""

Row = tuple[float, float, float]


class Viewpoint(msgspec.Struct, frozen=True):
    """A camera as an annotation file has it."""

    R: tuple[Row, Row, Row]
    T: Row
    focal_length: tuple[float, float]
    principal_point: tuple[float, float]
    intrinsics_format: str = FORMATS[0]


def to_opencv(viewpoint: Viewpoint, size: tuple[int, int]) -> Camera:
    """Return the camera of an image of this width and height.

    Raises:
        ValueError: an unknown format, a number that is not finite, no rotation, or a focal length that is not positive;
            the text ends a sentence that begins with "expected".
    """
    if viewpoint.intrinsics_format not in FORMATS:
        raise ValueError(f"intrinsics_format {' or '.join(FORMATS)}, got '{viewpoint.intrinsics_format[:40]}'")
    rotation, shift = np.array(viewpoint.R), np.array(viewpoint.T)
    focal, middle = np.array(viewpoint.focal_length), np.array(viewpoint.principal_point)
    if not all(np.isfinite(values).all() for values in (rotation, shift, focal, middle)):
        raise ValueError("a camera of finite numbers, got a NaN or an infinite one")
    if np.abs(rotation @ rotation.T - np.eye(3)).max() > RIGHT or np.linalg.det(rotation) < 0:
        raise ValueError("a rotation as R, got a matrix that is none")
    if focal.min() <= 0:
        raise ValueError(f"a focal_length above 0, got {focal.tolist()}")
    scale = _pixels(viewpoint.intrinsics_format, size)
    focal, middle = focal * scale, np.array(size) / 2 - middle * scale
    world_to_camera = np.eye(4)
    world_to_camera[:3, :3], world_to_camera[:3, 3] = (rotation * _FLIP).T, shift * _FLIP
    intrinsics = np.array(((focal[0], 0, middle[0]), (0, focal[1], middle[1]), (0, 0, 1)))
    return Camera(torch.from_numpy(world_to_camera), torch.from_numpy(intrinsics), *size)


def from_opencv(camera: Camera, intrinsics_format: str = FORMATS[0]) -> dict[str, Any]:
    """Return a camera as an annotation file has it, the inverse of `to_opencv`; a camera with skew has no such form."""
    scale = _pixels(intrinsics_format, (camera.width, camera.height))
    intrinsics, pose = camera.intrinsics.double().numpy(), camera.world_to_camera.double().numpy()
    middle = np.array((camera.width, camera.height)) / 2 - intrinsics[:2, 2]
    return {
        "R": (pose[:3, :3].T * _FLIP).tolist(),
        "T": (pose[:3, 3] * _FLIP).tolist(),
        "focal_length": (np.diag(intrinsics)[:2] / scale).tolist(),
        "principal_point": (middle / scale).tolist(),
        "intrinsics_format": intrinsics_format,
    }


def _pixels(intrinsics_format: str, size: tuple[int, int]) -> np.ndarray:
    """Return the pixels of one unit of normalised device coordinates along each axis, [2]."""
    sides = np.array(size, dtype=np.float64)
    return sides / 2 if intrinsics_format == FORMATS[0] else np.full(2, sides.min() / 2)
