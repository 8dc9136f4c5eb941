"""Quaternions, rigid and similarity maps, reflection in the animal's symmetry plane, linear blend skinning.

Quaternions are wxyz. 4x4 matrices act on column vectors. The reflection is S = diag(-1, 1, 1) in the object frame.
Identities are from the design's method notes (section 1) and are tested as group axioms.
"""

import re
from dataclasses import replace
from functools import cache

import torch
from torch import Tensor

from rewild4d.harmonics import products, rotated
from rewild4d.kernels import gpu
from rewild4d.types import Camera, Splats


def quat_multiply(a: Tensor, b: Tensor) -> Tensor:
    """Compute the Hamilton product a ⊗ b of wxyz quaternions, [..., 4]."""
    if a.ndim == 2 and a.shape == b.shape and gpu.on_gpu(a, b):
        return gpu.multiply(a, b)
    return products(a, b) @ _table(HAMILTON, a.device, a.dtype)


def quat_to_matrix(quats: Tensor) -> Tensor:
    """Return the rotation matrices of quaternions (normalised here), [..., 4] -> [..., 3, 3]."""
    unit = torch.nn.functional.normalize(quats, dim=-1)
    return (products(unit, unit) @ _table(ROTATION, unit.device, unit.dtype)).unflatten(-1, (3, 3))


HAMILTON = ("ww-xx-yy-zz", "wx+xw+yz-zy", "wy-xz+yw+zx", "wz+xy-yx+zw")
"""Each component of a product as a sum of products, one letter of each factor."""
ROTATION = (
    "ww+xx-yy-zz", "xy+yx-wz-zw", "xz+zx+wy+yw",
    "xy+yx+wz+zw", "ww-xx+yy-zz", "yz+zy-wx-xw",
    "xz+zx-wy-yw", "yz+zy+wx+xw", "ww-xx-yy+zz",
)  # fmt: skip
"""Each element of the matrix, row by row, of a unit quaternion times itself."""


def constant(values: tuple[float, ...], like: Tensor) -> Tensor:
    """Return numbers as a vector of the type and on the device of another tensor; do not write to it.

    It is made once, so that a step on a GPU copies no number there.
    """
    return _constant(values, like.device, like.dtype)


@cache
def _constant(values: tuple[float, ...], device: torch.device, dtype: torch.dtype) -> Tensor:
    return torch.tensor(values, device=device, dtype=dtype)


@cache
def _table(sums: tuple[str, ...], device: torch.device, dtype: torch.dtype) -> Tensor:
    """Return signs of the products in each sum, [16, sums]."""
    table = torch.zeros(16, len(sums))
    for column, terms in enumerate(sums):
        for sign, first, second in re.findall("([+-]?)([wxyz])([wxyz])", terms):
            table[4 * "wxyz".index(first) + "wxyz".index(second), column] = -1.0 if sign == "-" else 1.0
    return table.to(device, dtype)


def matrix_to_quat(matrix: Tensor) -> Tensor:
    """Return the unit quaternions (w >= 0) of rotation matrices, [..., 3, 3] -> [..., 4].

    Takes the best conditioned of the four classical branches, so it is exact near 180 degrees too.
    """
    m = matrix
    trace = m[..., 0, 0] + m[..., 1, 1] + m[..., 2, 2]
    diagonal = torch.stack((trace, m[..., 0, 0], m[..., 1, 1], m[..., 2, 2]), dim=-1)
    squares = torch.cat((1 + trace[..., None], 1 - trace[..., None] + 2 * diagonal[..., 1:]), dim=-1)
    xy, xz, yz = (m[..., i, j] + m[..., j, i] for i, j in ((0, 1), (0, 2), (1, 2)))
    wx, wy, wz = (m[..., i, j] - m[..., j, i] for i, j in ((2, 1), (0, 2), (1, 0)))
    candidates = torch.stack(
        (
            torch.stack((squares[..., 0], wx, wy, wz), dim=-1),
            torch.stack((wx, squares[..., 1], xy, xz), dim=-1),
            torch.stack((wy, xy, squares[..., 2], yz), dim=-1),
            torch.stack((wz, xz, yz, squares[..., 3]), dim=-1),
        ),
        dim=-2,
    )
    best = squares.argmax(dim=-1)[..., None, None].expand(*squares.shape[:-1], 1, 4)
    quats = torch.nn.functional.normalize(candidates.gather(-2, best).squeeze(-2), dim=-1)
    return torch.where(quats[..., :1] < 0, -quats, quats)


def axis_angle_to_matrix(axis_angle: Tensor) -> Tensor:
    """Return the rotation matrices of axis-angle vectors in radians (Rodrigues), [..., 3] -> [..., 3, 3]."""
    angle = (axis_angle.square().sum(-1) + 1e-20).sqrt()[..., None]
    quats = torch.cat(((angle / 2).cos(), axis_angle / angle * (angle / 2).sin()), dim=-1)
    return quat_to_matrix(quats)


def rigid(rotation: Tensor, translation: Tensor) -> Tensor:
    """Return 4x4 matrices from a linear part and a translation, [..., 3, 3] and [..., 3] -> [..., 4, 4]."""
    top = torch.cat((rotation, translation[..., None]), dim=-1)
    bottom = constant((0.0, 0.0, 0.0, 1.0), top).expand(*top.shape[:-2], 1, 4)
    return torch.cat((top, bottom), dim=-2)


def similarity(scale: Tensor | float, rotation: Tensor, translation: Tensor) -> Tensor:
    """Return 4x4 similarity x -> scale * rotation x + translation, [..., 4, 4]."""
    scale = torch.as_tensor(scale, dtype=rotation.dtype, device=rotation.device)
    return rigid(scale[..., None, None] * rotation, translation)


def split_similarity(matrix: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Scale [...], rotation [..., 3, 3] and translation [..., 3] of proper similarities [..., 4, 4]."""
    linear = matrix[..., :3, :3]
    scale = torch.linalg.det(linear).clamp_min(1e-30) ** (1 / 3)
    return scale, linear / scale[..., None, None], matrix[..., :3, 3]


def nearest_rotation(matrix: Tensor) -> Tensor:
    """Return the rotation closest to a matrix in the sum of squares (Kabsch), a reflection never, [..., 3, 3]."""
    u, _, vh = torch.linalg.svd(matrix)
    sign = torch.ones_like(matrix[..., 0, :])
    sign[..., 2] = torch.linalg.det(u @ vh).sign()
    return (u * sign[..., None, :]) @ vh


def look_at(eye: Tensor, target: Tensor, up: Tensor) -> Tensor:
    """World-to-camera matrix (OpenCV axes) of a camera at ``eye`` that looks at ``target``; all [3] -> [4, 4]."""
    forward = torch.nn.functional.normalize(target - eye, dim=0)
    right = torch.nn.functional.normalize(torch.linalg.cross(forward, up), dim=0)
    down = torch.linalg.cross(forward, right)
    rotation = torch.stack((right, down, forward))
    return rigid(rotation, -rotation @ eye)


def mirror_points(points: Tensor) -> Tensor:
    """Return S x: points in the object frame reflected in x = 0, [..., 3]."""
    return points * constant((-1.0, 1.0, 1.0), points)


def mirror_quats(quats: Tensor) -> Tensor:
    """Return the orientation of a reflected Gaussian: S R S, (w, x, y, z) -> (w, x, -y, -z), [..., 4]."""
    return quats * constant((1.0, 1.0, -1.0, -1.0), quats)


def mirror_matrix(matrix: Tensor) -> Tensor:
    """Return S4 P S4: a transform as the mirrored animal performs it, [..., 4, 4]."""
    sign = matrix.new_tensor((-1.0, 1.0, 1.0, 1.0))
    return matrix * sign[:, None] * sign[None, :]


def mirror_transforms(transforms: Tensor, mirror: Tensor) -> Tensor:
    """Return P_mirror[j] = S4 P[mirror[j]] S4: a pose with left and right exchanged, [..., J, 4, 4] and [J]."""
    return mirror_matrix(transforms[..., mirror, :, :])


def between_intrinsics(first: Tensor, second: Tensor, part: float) -> Tensor:
    """Return intrinsics of a crop on the straight line between two crops of one film, [3, 3] each.

    A crop's centre and side move evenly; in pixels of the crop that is a line between the inverses, not the matrices.
    """
    return torch.linalg.inv(torch.lerp(torch.linalg.inv(first), torch.linalg.inv(second), part))


def mirror_camera(camera: Camera) -> Camera:
    """Mirror a camera: the proper one whose image of the reflected scene is the horizontally flipped image.

    R' = S R S, t' = S t, cx' = W - cx (pixel centres at +0.5); det R' = +1. A bare reflection of the camera would be
    improper and must not reach a rasterizer.
    """
    intrinsics = camera.intrinsics.clone()
    intrinsics[0, 2] = camera.width - intrinsics[0, 2]
    intrinsics[0, 1] = -intrinsics[0, 1]
    return replace(camera, world_to_camera=mirror_matrix(camera.world_to_camera), intrinsics=intrinsics)


def camera_in_object(camera: Camera, object_to_world: Tensor) -> Camera:
    """Return the same view of the object frame: rigid, with the similarity's scale divided out of depth, [4, 4].

    Pixels are unchanged because projection does not see a common scale.
    """
    scale, _, _ = split_similarity(object_to_world)
    combined = camera.world_to_camera @ object_to_world.to(camera.world_to_camera)
    combined = combined.clone()
    combined[:3] = combined[:3] / scale.to(combined)
    return replace(camera, world_to_camera=combined)


def transform_splats(splats: Splats, matrix: Tensor) -> Splats:
    """Move Gaussians by a proper similarity, [4, 4]; colours that depend on the view rotate with them."""
    scale, rotation, translation = split_similarity(matrix.double())
    turn = matrix_to_quat(rotation).to(splats.quats)
    moved = splats.means.double() @ matrix.double()[:3, :3].T + translation
    colors = splats.colors
    if colors.shape[1] > 1:
        colors = rotated(colors, rotation.to(colors).expand(len(splats), 3, 3))
    return replace(
        splats,
        colors=colors,
        means=moved.to(splats.means),
        quats=quat_multiply(turn.expand_as(splats.quats), splats.quats),
        scales=splats.scales * scale.to(splats.scales),
    )


def on_cpu(splats: Splats) -> Splats:
    """Return Gaussians on the CPU in single precision, without gradients."""
    return Splats(*(part.detach().float().cpu() for part in vars(splats).values()))


def skin_points(points: Tensor, weights: Tensor, transforms: Tensor) -> Tensor:
    """Apply linear blend skinning: x -> sum_j w_j P_j x.

    Args:
        points: rest positions, [n, 3].
        weights: rows sum to one, [n, J].
        transforms: rest -> posed, [..., J, 4, 4].

    Returns:
        Posed positions, [..., n, 3].
    """
    blended = torch.einsum("nj,...jab->...nab", weights, transforms[..., :3, :])
    return torch.einsum("...nab,nb->...na", blended[..., :3], points) + blended[..., 3]


def skin_quats(quats: Tensor, weights: Tensor, joint_quats: Tensor) -> Tensor:
    """Orientation of skinned Gaussians: the normalised, sign-aligned blend of the joints' rotations times the rest one.

    The blended matrix itself would shrink covariances (its singular values fall below one); this does not.

    Args:
        quats: rest orientation, [n, 4].
        weights: rows sum to one, [n, J].
        joint_quats: rotation of each joint, [J, 4].

    Returns:
        Posed orientation, [n, 4].
    """
    leader = joint_quats[weights.argmax(dim=-1)]
    sign = torch.where(leader @ joint_quats.T < 0, -1.0, 1.0)
    blended = torch.nn.functional.normalize((weights * sign) @ joint_quats, dim=-1)
    return quat_multiply(blended, quats)
