"""The CUDA backend: projection and tile lists in torch, blending as Triton kernels behind one autograd function."""

import math
from dataclasses import dataclass
from typing import Any

import torch
import triton
from torch import Tensor
from torch.autograd.function import once_differentiable

from rewild4d.rasterizer import ewa, triton_blend
from rewild4d.rasterizer.conventions import RasterInfo
from rewild4d.rasterizer.projection import HALF_LOG2_E
from rewild4d.transforms import quat_to_matrix

TILE, MOMENTS = triton_blend.SIDE.value, triton_blend.MOMENTS.value
LAUNCH = {"num_warps": 8, "enable_fp_fusion": True}
"""A thread a pixel: the scans along a group of Gaussians then stay within one thread."""
MOST_CHANNELS = 16
"""What one program blends; for more of them the tile is walked again."""
LN2 = math.log(2.0)


def rasterize(
    means: Tensor,
    quats: Tensor,
    scales: Tensor,
    opacities: Tensor,
    features: Tensor,
    world_to_camera: Tensor,
    intrinsics: Tensor,
    width: int,
    height: int,
    background: Tensor | None,
    eps2d: float,
    antialias: bool,
    near: float,
) -> tuple[Tensor, Tensor, RasterInfo]:
    """Same as `rewild4d.rasterizer.rasterize`, on checked float32 input on one GPU; ``background`` is [V, C]."""
    # Double precision, as in the CPU backend: the determinant of a needle cancels, and memory is what projecting costs.
    half = quat_to_matrix(quats.double()) * scales.double()[:, None, :]
    centres, cov2d, depths, compensation = ewa.project(
        means.double(), half @ half.mT, world_to_camera.double(), intrinsics.double(), width, height, eps2d
    )
    seen = opacities.double() * (compensation if antialias else torch.ones_like(compensation))
    radii, extents = ewa.reach(centres, cov2d, depths, seen, width, height, near)
    records = _records(cov2d, seen, radii > 0).to(means.dtype)
    means2d = centres.to(means.dtype)
    if means2d.requires_grad:
        means2d.retain_grad()
    if background is None:
        background = features.new_zeros(len(world_to_camera), features.shape[1])
    lists = list_tiles(centres, extents, depths, radii > 0, width, height)
    image, alpha = _Blend.apply(means2d, records, features, background, lists, width, height)
    return image, alpha, RasterInfo(radii.to(means.dtype), means2d)


def _records(cov2d: Tensor, opacities: Tensor, shown: Tensor) -> Tensor:
    """Coefficients of dx^2, dx dy, dy^2 and the constant of log2 alpha, [V, N, 4]; harmless where not shown."""
    xx, xy, yy = cov2d[..., 0, 0], cov2d[..., 0, 1], cov2d[..., 1, 1]
    factor = HALF_LOG2_E / torch.where(shown, ewa.determinant(cov2d), 1.0)
    return torch.stack((-factor * yy, 2 * factor * xy, -factor * xx, torch.where(shown, opacities, 1.0).log2()), dim=-1)


@dataclass(frozen=True)
class TileLists:
    """Which Gaussian touches which tile, front to back.

    Attributes:
        tiles: tiles across and down.
        starts: where the list of each tile of each view begins in ``entries``, and their end, [V * tiles + 1].
        entries: view * N + Gaussian, tile by tile, nearest first, [E].
        slots: each entry's own place in an order that has the entries of one Gaussian side by side, [E].
        visible: view * N + Gaussian of all that can be drawn, in that order, [M].
        counts: how many tiles each of them touches, [M].
    """

    tiles: tuple[int, int]
    starts: Tensor
    entries: Tensor
    slots: Tensor
    visible: Tensor
    counts: Tensor


@torch.no_grad()
def list_tiles(centres: Tensor, extents: Tensor, depths: Tensor, shown: Tensor, width: int, height: int) -> TileLists:
    """Sort by depth (ties by index), repeat each Gaussian over its rectangle of tiles, sort by tile; both sorts stable.

    Args:
        centres: in pixels, [V, N, 2].
        extents: half sides of the bounding boxes in pixels, [V, N, 2].
        depths: along the camera's z, [V, N].
        shown: which to list, [V, N].
        width: image width in pixels.
        height: image height in pixels.
    """
    across, down = -(-width // TILE), -(-height // TILE)
    view, index = shown.nonzero(as_tuple=True)
    order = depths[view, index].argsort(stable=True)
    view, index = view[order], index[order]
    middle, half = centres[view, index], extents[view, index] * 1.0001  # the kernel works in single precision
    first = (middle - half - 0.5).ceil().clamp_min(0).long() // TILE
    last = torch.minimum((middle + half - 0.5).floor(), middle.new_tensor((width - 1, height - 1))).long() // TILE
    span = (last - first + 1).clamp_min(0)
    counts = span.prod(dim=-1)
    owner = torch.arange(len(counts), device=counts.device).repeat_interleave(counts)
    rank = torch.arange(len(owner), device=counts.device) - (counts.cumsum(0) - counts)[owner]
    column, row = first[owner, 0] + rank % span[owner, 0], first[owner, 1] + rank // span[owner, 0]
    tiles, slots = ((view[owner] * down + row) * across + column).int().sort(stable=True)
    starts = torch.searchsorted(tiles, torch.arange(len(shown) * down * across + 1, device=tiles.device).int())
    visible = view * shown.shape[1] + index
    return TileLists((across, down), starts, visible[owner[slots]], slots, visible, counts)


class _Blend(torch.autograd.Function):
    """Image-space Gaussians to features [V, C, h, w] and alpha [V, 1, h, w]."""

    @staticmethod
    def forward(
        ctx: Any,
        means2d: Tensor,
        records: Tensor,
        features: Tensor,
        background: Tensor,
        lists: TileLists,
        width: int,
        height: int,
    ) -> tuple[Tensor, Tensor]:
        views, (count, channels) = len(records), features.shape
        image, alpha = features.new_empty(views, channels, height, width), features.new_empty(views, 1, height, width)
        features, background = features.contiguous(), background.contiguous()
        part = min(MOST_CHANNELS, triton.next_power_of_2(channels))
        grid = (len(lists.starts) - 1, -(-channels // part))
        with torch.cuda.device_of(records):
            triton_blend.blend[grid](
                lists.starts, lists.entries, means2d, records, features, background, image, alpha,
                width, height, *lists.tiles, count, CHANNELS=channels, PART=part, **LAUNCH,
            )  # fmt: skip
        ctx.save_for_backward(means2d, records, features, image, alpha)
        ctx.lists = lists
        return image, alpha

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, g_image: Tensor, g_alpha: Tensor) -> tuple[Tensor | None, ...]:
        means2d, records, features, image, alpha = ctx.saved_tensors
        lists: TileLists = ctx.lists
        views, channels, height, width = image.shape
        sums = records.new_zeros(len(lists.slots), MOMENTS + channels)
        with torch.cuda.device_of(records):
            triton_blend.blend_backward[(len(lists.starts) - 1,)](
                lists.starts, lists.entries, lists.slots, means2d, records, features, image, alpha,
                g_image.contiguous(), g_alpha.contiguous(), sums,
                width, height, *lists.tiles, len(features), CHANNELS=channels, **LAUNCH,
            )  # fmt: skip
        total = records.new_zeros(views * len(features), MOMENTS + channels)
        if len(lists.visible):
            total[lists.visible] = torch.segment_reduce(sums, "sum", lengths=lists.counts, axis=0, unsafe=True)
        total = total.unflatten(0, records.shape[:2])
        m, mx, my, mxx, mxy, myy = total[..., :MOMENTS].unbind(-1)
        xx, xy, yy = records[..., :3].unbind(-1)
        v_means2d = -LN2 * torch.stack((2 * xx * mx + xy * my, 2 * yy * my + xy * mx), dim=-1)
        v_records = LN2 * torch.stack((mxx, mxy, myy, m), dim=-1)
        v_background = (g_image * (1 - alpha)).sum(dim=(2, 3))
        return v_means2d, v_records, total[..., MOMENTS:].sum(dim=0), v_background, None, None, None
