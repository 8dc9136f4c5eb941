"""Soft silhouettes and pictures in square crops around the animal, and their difference.

`rasterized` draws flat Gaussians on the surface by the benchmark's rasterizer, one call per pose and view. `splat` is
its fast approximation while there are many hypotheses: the image of a round Gaussian is separable, so the density of
all of them is one matrix product per view, and alpha = 1 - exp(-density). The final score draws the mesh (`outline`).
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache

import cv2
import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import normalize

from rewild4d.errors import UserError
from rewild4d.priors.fused.splats import SPLATS, densities
from rewild4d.rasterizer import rasterize
from rewild4d.transforms import camera_in_object, matrix_to_quat
from rewild4d.types import Camera, Frame

CROP_MARGIN = 0.25
"""Border added on each side of the mask's bounding box, as a share of its longer side."""
DISC_SIZE, DISC_OPACITY = 0.4, 0.95
"""Standard deviations, in edge lengths, and opacity of the flat Gaussian on a quadrilateral."""
PARTS, PART_SIZE, PART_OPACITY = 3, 0.26, 0.33
"""Coloured quadrilaterals are cut into as many parts along each side, whose standard deviations, in edge lengths of the
whole, leave no gaps: gaps would be taken for patterns."""
NOISE = 0.01
"""Distance of colours below which it counts as a square."""
DENSITY = 2.5
"""Optical depth at the centre of one round Gaussian, so that a few that overlap are opaque."""


@dataclass(frozen=True)
class Targets:
    """Cropped masks of a set of observations.

    Attributes:
        masks: soft mattes of the crops, [v, s, s].
        colors: RGB of the crops times their mattes, [v, 3, s, s].
        valid: share of each pixel that lies inside the image, [v, s, s].
        world_to_camera: [v, 4, 4].
        intrinsics: of the crops, [v, 3, 3].
        timesteps: index of the time of each observation, int64, [v].
    """

    masks: Tensor
    colors: Tensor
    valid: Tensor
    world_to_camera: Tensor
    intrinsics: Tensor
    timesteps: Tensor

    def select(self, rows: Tensor) -> "Targets":
        return Targets(*(value[rows] for value in vars(self).values()))


def known_camera(frame: Frame, name: str) -> Camera:
    """Return the frame's camera; a `UserError` where it has none."""
    if frame.camera is None:
        raise UserError(
            f"{name}: expected a camera for every frame, but the frame at {frame.time:g} s has none; "
            "the template fit needs known cameras, so give a prior file instead."
        )
    return frame.camera


def require_mask(frames: Sequence[Frame], name: str) -> None:
    """Raise a `UserError` unless a mask of the case ``name`` shows something."""
    if not any((frame.mask > 0.5).any() for frame in frames):
        raise UserError(f"{name}: expected at least one mask that shows the animal, but all {len(frames)} are empty.")


def crop_targets(frames: Sequence[Frame], timesteps: Sequence[int], world: Tensor, size: int, name: str) -> Targets:
    """Cut square crops of ``size`` pixels around masks, resampled by area, and leave out frames with an empty mask.

    ``timesteps`` are indices of the frames' times, ``world`` the similarity [4, 4] from the working frame, where the
    targets' cameras are, to the world, and ``name`` the case.
    """
    masks, colors, valid, cameras, kept = [], [], [], [], []
    for frame, timestep in zip(frames, timesteps, strict=True):
        box = mask_box(frame.mask[0] > 0.5)
        if box is None:
            continue
        left, top, side = _square(*box)
        camera = camera_in_object(known_camera(frame, name), world)
        cameras.append(camera.shifted(left, top, side, side).resized(size, size))
        inside = torch.ones_like(frame.mask[0])
        masks.append(_window(frame.mask, left, top, side, size)[0])
        colors.append(_window(frame.rgb, left, top, side, size))
        valid.append(_window(inside[None], left, top, side, size)[0])
        kept.append(timestep)
    return Targets(
        torch.stack(masks),
        torch.stack(colors),
        torch.stack(valid),
        torch.stack([camera.world_to_camera for camera in cameras]).float(),
        torch.stack([camera.intrinsics for camera in cameras]).float(),
        torch.tensor(kept),
    )


def mask_box(shown: Tensor) -> tuple[int, int, int, int] | None:
    """Return left, top, right and bottom (one past the last pixel) of what is true, [h, w]; None where nothing is."""
    rows, columns = torch.nonzero(shown, as_tuple=True)
    if len(rows) == 0:
        return None
    return int(columns.min()), int(rows.min()), int(columns.max()) + 1, int(rows.max()) + 1


def _square(left: int, top: int, right: int, bottom: int) -> tuple[int, int, int]:
    """Return the left, top and side of the crop around a box; it may extend beyond the image."""
    side = round(max(right - left, bottom - top) * (1 + 2 * CROP_MARGIN)) + 2
    return (left + right - side) // 2, (top + bottom - side) // 2, side


def _window(image: Tensor, left: int, top: int, side: int, size: int) -> Tensor:
    """Cut a square out of an image [c, h, w], zero outside, and resample it by area, [c, size, size]."""
    height, width = image.shape[1:]
    padding = (max(-left, 0), max(left + side - width, 0), max(-top, 0), max(top + side - height, 0))
    padded = torch.nn.functional.pad(image, padding)
    x, y = left + padding[0], top + padding[2]
    window = padded[:, y : y + side, x : x + side]
    return torch.nn.functional.interpolate(window[None], (size, size), mode="area")[0]


def splat(points: Tensor, sizes: Tensor, intrinsics: Tensor, size: int) -> Tensor:
    """Render soft silhouettes of round Gaussians, alpha [..., size, size].

    ``points`` [..., n, 3] are in camera coordinates, ``sizes`` standard deviations, broadcastable to [..., n], and
    ``intrinsics`` [..., 3, 3].
    """
    depth = points[..., 2].clamp_min(1e-2)
    focal = torch.stack((intrinsics[..., 0, 0], intrinsics[..., 1, 1]), -1)[..., None, :]
    center = points[..., :2] / depth[..., None] * focal + intrinsics[..., None, :2, 2]
    spread = sizes[..., None] * focal / depth[..., None]
    widened = spread.square() + 0.3
    strength = DENSITY * (spread.square() / widened).prod(-1).sqrt()
    if SPLATS.takes(center, widened, strength):
        return 1 - torch.exp(-densities(center, widened, strength, size))
    pixels = torch.arange(size) + 0.5
    kernel = torch.exp(-0.5 * (center[..., None] - pixels).square() / widened[..., None])
    density = (kernel[..., 1, :] * strength[..., None]).transpose(-1, -2) @ kernel[..., 0, :]
    return 1 - torch.exp(-density)


def rasterized(
    vertices: Tensor, quads: Tensor, intrinsics: Tensor, size: int, colors: Tensor | None = None
) -> tuple[Tensor, Tensor]:
    """Render a surface by flat Gaussians on every quadrilateral.

    The 50 % contour is the surface's outline to a few hundredths of its area. Gradients reach the vertices through the
    Gaussians' centres alone, which is most of them at half the cost.

    Args:
        vertices: in camera coordinates, [..., v, n, 3].
        quads: corners in order, [q, 4].
        intrinsics: [v, 3, 3].
        size: side of the square images in pixels.
        colors: RGB of parts of the quadrilaterals, [..., PARTS * PARTS * q, 3]; None draws each as a whole, in white.

    Returns:
        RGB [..., v, 3, size, size] (one channel without colours), and alpha [..., v, size, size].
    """
    parts = 1 if colors is None else PARTS
    corners = vertices[..., quads, :]
    means = _part_means(corners, parts)
    a, b, c, d = corners.detach().unbind(-2)
    along, around = (c + d - a - b) / 2, (b + c - a - d) / 2
    first, normal = (normalize(axis, dim=-1) for axis in (along, torch.linalg.cross(along, around)))
    quats = matrix_to_quat(torch.stack((first, torch.linalg.cross(normal, first), normal), dim=-1))
    lengths = torch.stack((along, around), dim=-2).norm(dim=-1)
    scales = torch.cat(((DISC_SIZE if parts == 1 else PART_SIZE) * lengths, 0.01 * lengths[..., :1]), dim=-1)
    quats, scales = (value.repeat_interleave(parts * parts, dim=-2) for value in (quats, scales))
    opacities = torch.full(means.shape[-2:-1], DISC_OPACITY if parts == 1 else PART_OPACITY)
    eye, images, mattes = torch.eye(4)[None], [], []
    for index in np.ndindex(*means.shape[:-2]):
        shown = opacities[:, None] if colors is None else colors[index[:-1]]
        image, matte, _ = rasterize(
            means[index], quats[index], scales[index], opacities, shown, eye, intrinsics[index[-1]][None],
            size, size, antialias=True,
        )  # fmt: skip
        images.append(image[0])
        mattes.append(matte[0, 0])
    return torch.stack(images).unflatten(0, means.shape[:-2]), torch.stack(mattes).unflatten(0, means.shape[:-2])


def _part_means(corners: Tensor, parts: int) -> Tensor:
    """Return middles of parts of quadrilaterals, in order of these, [..., q, 4, 3] -> [..., parts * parts * q, 3]."""
    if parts == 1:
        return corners.mean(-2)
    share = (torch.arange(parts) + 0.5) / parts
    along, around = (grid.flatten() for grid in torch.meshgrid(share, share, indexing="ij"))
    weights = torch.stack(
        ((1 - along) * (1 - around), (1 - along) * around, along * around, along * (1 - around)), dim=1
    )  # fmt: skip
    return (weights @ corners).flatten(-3, -2)


@cache
def _blur_matrix(size: int, sigma: float) -> Tensor:
    """Return a blur along one axis, zero outside, [size, size]."""
    index = torch.arange(size)
    kernel = torch.exp(-0.5 * ((index[:, None] - index) / sigma).square())
    return kernel / torch.exp(-0.5 * (torch.arange(-size, size + 1) / sigma).square()).sum()


def blur(images: Tensor, sigma: float) -> Tensor:
    """Blur square images by a Gaussian, zero outside, [..., s, s]."""
    matrix = _blur_matrix(images.shape[-1], round(max(sigma, 0.05), 2))
    return matrix @ images @ matrix.T


def mismatch(rendered: Tensor, targets: Targets, sigma: float) -> Tensor:
    """Return squared difference over the animal's area plus Dice loss, blurred, [..., v, s, s] -> [...]."""
    rendered = blur(rendered * targets.valid, sigma)
    wanted = blur(targets.masks, sigma)
    square = (rendered - wanted).square().sum((-1, -2)) / wanted.sum((-1, -2))
    dice = 1 - 2 * (rendered * wanted).sum((-1, -2)) / (rendered.square() + wanted.square()).sum((-1, -2))
    return (square + dice).mean(-1)


def color_mismatch(rendered: Tensor, targets: Targets, sigma: float) -> Tensor:
    """Return the mean distance of blurred colours over the animal's area, robust, [..., v, 3, s, s] -> [...]."""
    away = blur(rendered * targets.valid[:, None], sigma) - blur(targets.colors, sigma)
    distance = (away.square().sum(-3) + NOISE**2).sqrt().sum((-1, -2))
    return (distance / blur(targets.masks, sigma).sum((-1, -2))).mean(-1)


def mean_color(targets: Targets) -> Tensor:
    """Return the mean RGB of the animal, [3]."""
    return targets.colors.sum((0, 2, 3)) / targets.masks.sum()


def outline(vertices: Tensor, faces: Tensor, camera: Camera) -> np.ndarray:
    """Draw the silhouette of a mesh, anti-aliased, uint8, [h, w]; vertices [n, 3] are in the camera's world."""
    pixels, depth = camera.project(vertices.double())
    image = np.zeros((4 * camera.height, 4 * camera.width), np.uint8)
    corners = pixels.numpy()[faces.numpy()]
    visible = (depth.numpy() > 1e-6)[faces.numpy()].all(1) & (np.abs(corners) < 1e5).all((1, 2))
    # cv2 also fills the pixels on an edge; four times the size keeps that below an eighth of a pixel
    fixed_point = np.round((4 * corners[visible] - 0.5) * 16).astype(np.int32)
    for triangle in fixed_point:
        cv2.fillConvexPoly(image, triangle, 255, shift=4)
    return cv2.resize(image, (camera.width, camera.height), interpolation=cv2.INTER_AREA)


def overlap(vertices: Sequence[Tensor], faces: Tensor, cameras: Sequence[Camera], masks: Sequence[Tensor]) -> float:
    """Return the mean intersection over union of meshes [n, 3] and masks [1, h, w] at 0.5; empty masks do not count."""
    scores = []
    for points, camera, mask in zip(vertices, cameras, masks, strict=True):
        wanted = mask[0].numpy() > 0.5
        if wanted.any():
            drawn = outline(points, faces, camera) > 127
            scores.append((drawn & wanted).sum() / (drawn | wanted).sum())
    return float(np.mean(scores))
