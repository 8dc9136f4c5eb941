"""Interpolate a prior between its frames, and place Gaussians on its surface."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from scipy.spatial import cKDTree
from torch import Tensor
from torch.nn.functional import grid_sample, normalize

from rewild4d.transforms import (
    between_intrinsics,
    camera_in_object,
    matrix_to_quat,
    mirror_points,
    quat_to_matrix,
    similarity,
    skin_points,
    skin_quats,
    split_similarity,
)
from rewild4d.types import Camera, Frame, Prior, Splats


@dataclass(frozen=True)
class SurfaceSample:
    """Points on a prior's rest mesh.

    Attributes:
        points: object frame, [n, 3].
        normals: unit, outwards, [n, 3].
        weights: skinning weights, rows sum to one, [n, J].
        radius: of a disc with a point's share of the area, object units.
    """

    points: Tensor
    normals: Tensor
    weights: Tensor
    radius: float


def sample_surface(prior: Prior, count: int, generator: torch.Generator) -> SurfaceSample:
    """Draw ``count`` points uniformly by area from the rest mesh."""
    return sample_mesh(prior.vertices, prior.faces, prior.weights, count, generator)


def sample_mesh(
    vertices: Tensor, faces: Tensor, vertex_weights: Tensor, count: int, generator: torch.Generator
) -> SurfaceSample:
    """Draw ``count`` points uniformly by area from a mesh, [n, 3], [f, 3], with skinning weights, [n, J]."""
    corners = vertices[faces]
    cross = torch.linalg.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    area = cross.norm(dim=-1) / 2
    face = torch.multinomial(area, count, replacement=True, generator=generator)
    u, v = torch.rand(2, count, generator=generator)
    barycentric = torch.stack((1 - u.sqrt(), u.sqrt() * (1 - v), u.sqrt() * v), dim=-1)
    points = (barycentric[..., None] * corners[face]).sum(1)
    weights = (barycentric[..., None] * vertex_weights[faces[face]]).sum(1)
    radius = math.sqrt(float(area.sum()) / (math.pi * count))
    return SurfaceSample(points, normalize(cross[face], dim=-1), weights / weights.sum(-1, keepdim=True), radius)


def surface_vertices(prior: Prior) -> SurfaceSample:
    """Return the rest mesh's vertices that a face has, with the mean of their faces' normals, weighted by area."""
    corners = prior.vertices[prior.faces].float()
    cross = torch.linalg.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals = torch.zeros_like(prior.vertices).index_add_(0, prior.faces.flatten(), cross.repeat_interleave(3, dim=0))
    used = prior.faces.unique()
    radius = math.sqrt(float(cross.norm(dim=-1).sum()) / (2 * math.pi * len(used)))
    return SurfaceSample(prior.vertices[used], normalize(normals[used], dim=-1), prior.weights[used], radius)


def quats_from_normals(normals: Tensor) -> Tensor:
    """Return orientations whose third axis is the normal, [n, 3] -> [n, 4]."""
    helper = torch.where(normals[:, :1].abs() < 0.9, normals.new_tensor((1.0, 0, 0)), normals.new_tensor((0, 1.0, 0)))
    first = normalize(torch.linalg.cross(helper, normals), dim=-1)
    return matrix_to_quat(torch.stack((first, torch.linalg.cross(normals, first), normals), dim=-1))


def pose_at(prior: Prior, time: float) -> tuple[Tensor, Tensor]:
    """Return object_to_world, float64, [4, 4], and rest -> posed transforms, float32, [J, 4, 4], at any time.

    They are exact at the prior's frames, interpolated between them, and constant beyond the ends.
    """
    before, after, part = _neighbours(prior.times, time)
    if before == after:
        return prior.object_to_world[before], prior.transforms[before]
    return (
        blend_similarities(prior.object_to_world[before], prior.object_to_world[after], part),
        blend_similarities(prior.transforms[before].double(), prior.transforms[after].double(), part).float(),
    )


def camera_at(prior: Prior, time: float) -> Camera:
    """Return the prior's camera at any time, in the object frame; see `pose_at`."""
    before, after, part = _neighbours(prior.times, time)
    first, second = prior.cameras[before], prior.cameras[after]
    if before == after:
        return first
    moved = blend_similarities(first.world_to_camera, second.world_to_camera, part)
    intrinsics = between_intrinsics(first.intrinsics, second.intrinsics, part)
    return replace(second, world_to_camera=moved, intrinsics=intrinsics)


def world_camera(prior: Prior, time: float) -> Camera:
    """Return the prior's camera at any time, in the world."""
    return camera_in_object(camera_at(prior, time), torch.linalg.inv(pose_at(prior, time)[0]))


def _neighbours(times: Tensor, time: float) -> tuple[int, int, float]:
    """Return the frames before and after a time, and its fraction between them; at a frame and beyond the ends, one."""
    after = min(int(torch.searchsorted(times, torch.tensor(time, dtype=times.dtype) - 1e-9)), len(times) - 1)
    if after == 0 or time >= float(times[after]) - 1e-9:
        return after, after, 0.0
    low, high = float(times[after - 1]), float(times[after])
    return after - 1, after, (time - low) / (high - low)


def blend_similarities(a: Tensor, b: Tensor, part: float) -> Tensor:
    """Interpolate two proper similarities: normalised quaternion blend, linear translation, geometric scale."""
    (scale_a, rotation_a, shift_a), (scale_b, rotation_b, shift_b) = split_similarity(a), split_similarity(b)
    quat_a, quat_b = matrix_to_quat(rotation_a), matrix_to_quat(rotation_b)
    quat_b = torch.where((quat_a * quat_b).sum(-1, keepdim=True) < 0, -quat_b, quat_b)
    rotation = quat_to_matrix((1 - part) * quat_a + part * quat_b)
    scale = scale_a ** (1 - part) * scale_b**part
    return similarity(scale, rotation, (1 - part) * shift_a + part * shift_b)


def pose_gaussians(sample: SurfaceSample, quats: Tensor, scales: Tensor, colors: Tensor, transforms: Tensor) -> Splats:
    """Make opaque Gaussians on the posed surface, in the object frame.

    ``quats`` [n, 4] are orientations at rest, ``scales`` and ``colors`` [n, 3], ``transforms`` rest -> posed [J, 4, 4].
    """
    joint_quats = matrix_to_quat(split_similarity(transforms)[1])
    return Splats(
        means=skin_points(sample.points, sample.weights, transforms),
        quats=skin_quats(quats, sample.weights, joint_quats),
        scales=scales,
        opacities=torch.ones(len(scales)),
        colors=colors[:, None],
    )


def colors_from_frames(prior: Prior, sample: SurfaceSample, frames: Sequence[Frame]) -> Tensor:
    """Return RGB of each surface point in [0, 1], [n, 3], from frames whose times are the prior's.

    It is the mean over the frames that see the point, else that of the mirrored point, else the mean colour.
    """
    total = torch.zeros(len(sample.points), 3)
    weight = torch.zeros(len(sample.points), 1)
    for frame in frames:
        index = int((prior.times - frame.time).abs().argmin())
        camera, transforms = prior.cameras[index], prior.transforms[index]
        points = skin_points(sample.points, sample.weights, transforms)
        normals = torch.einsum("nj,jab,nb->na", sample.weights, transforms[:, :3, :3], sample.normals)
        facing = -(normalize(normals, dim=-1) * normalize(points - camera.center.to(points), dim=-1)).sum(-1)
        pixels, depth = camera.project(points)
        color, alpha = _look_up(frame, pixels)
        shown = (facing > 0.2) & (alpha > 0.5) & _nearest(pixels, depth, camera)
        total[shown] += facing[shown, None] * color[shown] / alpha[shown, None]
        weight[shown] += facing[shown, None]
    seen = weight[:, 0] > 0
    rgb = sum(frame.rgb.sum((1, 2)) for frame in frames) / sum(frame.mask.sum() for frame in frames)
    colors = torch.as_tensor(rgb).expand(len(total), 3).clone()
    colors[seen] = total[seen] / weight[seen]
    if seen.any() and not seen.all():
        distance, nearest = cKDTree(sample.points[seen].numpy()).query(mirror_points(sample.points[~seen]).numpy())
        known = torch.from_numpy(distance) < 0.2
        colors[torch.nonzero(~seen)[known, 0]] = colors[seen][torch.from_numpy(nearest)[known]]
    return colors.clamp(0, 1)


def _look_up(frame: Frame, pixels: Tensor) -> tuple[Tensor, Tensor]:
    """Sample colour (premultiplied) [n, 3] and matte [n] bilinearly at pixel positions [n, 2]."""
    height, width = frame.mask.shape[1:]
    grid = pixels / pixels.new_tensor((width, height)) * 2 - 1
    image = torch.cat((frame.rgb, frame.mask))[None]
    values = grid_sample(image, grid.view(1, 1, -1, 2).to(image), align_corners=False)[0, :, 0].T
    return values[:, :3], values[:, 3]


def _nearest(pixels: Tensor, depth: Tensor, camera: Camera, cell: float = 3.0) -> Tensor:
    """Return which points lie at the front of a depth buffer with cells of a few pixels, boolean [n]."""
    width, height = math.ceil(camera.width / cell), math.ceil(camera.height / cell)
    column, row = (pixels / cell).floor().long().unbind(-1)
    inside = (depth > 0) & (column >= 0) & (column < width) & (row >= 0) & (row < height)
    index = (row * width + column).clamp(0, width * height - 1)
    front = torch.full((width * height,), torch.inf, dtype=depth.dtype)
    front.scatter_reduce_(0, index[inside], depth[inside], "amin")
    return inside & (depth <= front[index] + 0.15)
