"""The CUDA backend: Triton kernels behind two autograd functions, with a sort by torch between them."""

from typing import Any, NamedTuple

import torch
import triton
from torch import Tensor
from torch.autograd.function import once_differentiable

from rewild4d.rasterizer import triton_blend, triton_project, triton_tiles
from rewild4d.rasterizer.checks import check_values
from rewild4d.rasterizer.conventions import Options, RasterInfo, RasterInput, Rendered, camera_gradients
from rewild4d.rasterizer.rooms import take_room

TILE, MOMENTS = triton_blend.SIDE.value, triton_blend.MOMENTS.value
BLOCK, RECORD, CAMERA = triton_project.BLOCK.value, triton_project.RECORD.value, triton_project.CAMERA.value
BUCKET, PIXELS = triton_blend.BUCKET.value, triton_blend.PIXELS.value
OWNERS, ENTRIES = triton_tiles.OWNERS.value, triton_tiles.ENTRIES.value
UNUSABLE = triton_project.UNUSABLE.value
MOST_TILES = 1 << (63 - triton_project.DEPTH_BITS.value)
LAUNCHES: dict[str, dict[str, Any]] = {
    "project": {"num_warps": 2},
    "list_entries": {"num_warps": 4},
    "start_tiles": {"num_warps": 4},
    "blend": {"GROUP": 16, "num_warps": 1},
    "blend_backward": {"GROUP": 8, "num_warps": 1},
    "gather": {"num_warps": 1},
    "project_backward": {"num_warps": 2},
}
"""Launch settings; for blending the fastest of groups of 2 to 16 Gaussians on 1 to 8 warps, on an H100."""
MOST_CHANNELS = 16
"""Most channels that one program blends; a tile has a program for each part of more channels."""


def rasterize(given: RasterInput) -> Rendered:
    """Render like `rewild4d.rasterizer.rasterize`, on float32 input on one GPU.

    Raises:
        ValueError: a value is not finite or too large; more tiles than sorting keys have room for.
    """
    means, quats, scales, opacities, features, world_to_camera, intrinsics, width, height, background, *_ = given
    views, across, down = len(world_to_camera), -(-width // TILE), -(-height // TILE)
    if views * across * down >= MOST_TILES:
        raise ValueError(f"expected fewer than {MOST_TILES} tiles of {TILE} x {TILE} pixels in all views together.")
    if background is None:
        background = features.new_zeros(views, features.shape[1])
    named = {
        "means": means, "quats": quats, "scales": scales, "opacities": opacities,
        "world_to_camera": world_to_camera, "intrinsics": intrinsics, "features": features, "background": background,
    }  # fmt: skip
    if not len(means):
        check_values(named)  # no kernel does
    *inputs, features, background = (tensor.contiguous() for tensor in named.values())
    shades = (features.detach(), background.detach())
    with torch.cuda.device_of(means):
        means2d, rests, records, radii, keys, wides, tiles = _Project.apply(given.options, shades, *inputs)
        if means2d.requires_grad:
            means2d.retain_grad()
        ends = tiles.flatten().cumsum(0)
        room = take_room(ends)
        if room >= UNUSABLE:
            check_values(named)
            raise ValueError(f"expected fewer than {UNUSABLE} pairs of a Gaussian and a tile that it touches.")
        lists = _list_tiles(keys, wides, tiles, ends, room, views, across, down)
        image, alpha = _Blend.apply(means2d, rests, records, features, background, lists, (width, height))
    return image, alpha, RasterInfo(radii, means2d)


class _Project(torch.autograd.Function):
    """Project means, quats, scales and opacities by world_to_camera and intrinsics; ``shades`` are checked.

    Returns centres [V, N, 2] and records [V, N, 4]; without gradients the rest of the centres beyond single precision
    [V, N, 2], radii, keys, wides and tiles [V, N].
    """

    @staticmethod
    def forward(
        ctx: Any, options: Options, shades: tuple[Tensor, Tensor], means: Tensor, *others: Tensor
    ) -> tuple[Tensor, ...]:
        inputs = (means, *others)
        views, count = len(inputs[4]), len(means)
        width, height, eps2d, antialias, near = options
        means2d, records = means.new_empty(views, count, 2), means.new_empty(views, count, RECORD)
        radii, keys = means.new_empty(views, count), means.new_empty(views, count, dtype=torch.int64)
        wides, tiles = torch.empty_like(radii, dtype=torch.int32), torch.empty_like(radii, dtype=torch.int32)
        rests = torch.empty_like(means2d)
        outputs = (means2d, rests, records, radii, keys, wides, tiles)
        triton_project.project[(triton.cdiv(count, BLOCK), views)](
            *inputs, *shades, *outputs, width, height, -(-width // TILE), -(-height // TILE), count,
            shades[0].shape[1], eps2d, near,
            ANTIALIAS=antialias, **LAUNCHES["project"],
        )  # fmt: skip
        ctx.save_for_backward(*inputs, radii)
        ctx.options = options
        ctx.mark_non_differentiable(rests, *outputs[3:])
        return outputs

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, g_means2d: Tensor, *rest: Tensor) -> tuple[Tensor | None, ...]:
        *inputs, radii = ctx.saved_tensors
        (world_to_camera, intrinsics), g_records = inputs[4:], rest[1]
        (views, count), (width, height, eps2d, antialias, _) = radii.shape, ctx.options
        blocks, with_cameras = triton.cdiv(count, BLOCK), any(ctx.needs_input_grad[6:8])
        gradients = [torch.empty_like(tensor) for tensor in inputs[:4]]
        v_cameras = radii.new_empty(blocks if with_cameras else 0, views, CAMERA, dtype=torch.float64)
        with torch.cuda.device_of(radii):
            triton_project.project_backward[(blocks,)](
                *inputs, radii, g_means2d.contiguous(), g_records.contiguous(), *gradients, v_cameras,
                width, height, views, count, eps2d, ANTIALIAS=antialias, CAMERAS=with_cameras,
                **LAUNCHES["project_backward"],
            )  # fmt: skip
        v_world_to_camera = v_intrinsics = None
        if with_cameras:
            v_world_to_camera, v_intrinsics = camera_gradients(v_cameras.sum(dim=0), world_to_camera, intrinsics)
        return None, None, *gradients, v_world_to_camera, v_intrinsics


class _TileLists(NamedTuple):
    """The Gaussians of each tile, front to back. A row is a view and a Gaussian: view * N + Gaussian.

    Attributes:
        tiles: tiles across and down.
        starts: first index in ``entries`` of the list of each tile of each view, and their end, [V * tiles + 1].
        entries: rows, tile by tile, nearest first, [room].
        slots: each entry's index in an order by rows, [room].
        counts: entries of each row, [V, N].
        ends: their running sum, [V * N].
        pages: buckets of entries, see `triton_blend.blend`, that there is room for.
    """

    tiles: tuple[int, int]
    starts: Tensor
    entries: Tensor
    slots: Tensor
    counts: Tensor
    ends: Tensor
    pages: int


@torch.no_grad()
def _list_tiles(
    keys: Tensor, wides: Tensor, counts: Tensor, ends: Tensor, room: int, views: int, across: int, down: int
) -> _TileLists:
    """Repeat each row over its rectangle of tiles, and sort by tile, then depth, then row.

    Args:
        keys: of the first tile of each row, see `triton_project.project`, [V, N].
        wides, counts: tiles across and of each rectangle, [V, N].
        ends: running sum of the counts, [V * N].
        room: pairs of a row and a tile that there is room for.
        views: V.
        across, down: tiles across and down an image.
    """
    rows, number = counts.numel(), views * across * down + 1
    entry_keys, owners = keys.new_empty(room), counts.new_empty(room)
    triton_tiles.list_entries[(triton.cdiv(room, ENTRIES),)](
        ends, counts, wides, keys, entry_keys, owners, room, rows, rows.bit_length(), across,
        **LAUNCHES["list_entries"],
    )  # fmt: skip
    entry_keys, slots = entry_keys.sort(stable=True)
    entries, starts = torch.empty_like(owners), keys.new_empty(number)
    triton_tiles.start_tiles[(triton.cdiv(max(room, number), ENTRIES),)](
        entry_keys, slots, owners, entries, starts, room, number, room.bit_length(), **LAUNCHES["start_tiles"]
    )
    return _TileLists((across, down), starts, entries, slots, counts, ends, room // BUCKET + number)


class _Blend(torch.autograd.Function):
    """Blend image-space Gaussians to features [V, C, h, w] and alpha [V, 1, h, w]."""

    @staticmethod
    def forward(
        ctx: Any, means2d: Tensor, rests: Tensor, records: Tensor, features: Tensor, background: Tensor,
        lists: _TileLists, size: tuple[int, int],
    ) -> tuple[Tensor, Tensor]:  # fmt: skip
        views, (count, channels), (width, height) = len(records), features.shape, size
        image, alpha = features.new_empty(views, channels, height, width), features.new_empty(views, 1, height, width)
        part = min(MOST_CHANNELS, triton.next_power_of_2(channels))
        kept = features.new_empty(lists.pages if any(ctx.needs_input_grad) else 0, 1 + channels, PIXELS)
        triton_blend.blend[(len(lists.starts) - 1, triton.cdiv(channels, part))](
            lists.starts, lists.entries, means2d, rests, records, features, background, image, alpha,
            kept, width, height, *lists.tiles, count, CHANNELS=channels, PART=part, KEEP=len(kept) > 0,
            **LAUNCHES["blend"],
        )  # fmt: skip
        ctx.save_for_backward(means2d, rests, records, features, image, alpha, kept)
        ctx.lists = lists
        return image, alpha

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, g_image: Tensor, g_alpha: Tensor) -> tuple[Tensor | None, ...]:
        means2d, rests, records, features, image, alpha, kept = ctx.saved_tensors
        lists: _TileLists = ctx.lists
        views, channels, height, width = image.shape
        count, part = len(features), min(MOST_CHANNELS, triton.next_power_of_2(channels))
        sums = records.new_empty(len(lists.slots), MOMENTS + channels)
        gradients = [torch.empty_like(tensor) for tensor in (means2d, records, features)]
        with torch.cuda.device_of(records):
            tiles = len(lists.starts) - 1
            triton_blend.blend_backward[(lists.pages,)](
                lists.starts, lists.entries, lists.slots, means2d, rests, records, features, image, alpha,
                kept, g_image.contiguous(), g_alpha.contiguous(), sums, tiles, tiles.bit_length(),
                width, height, *lists.tiles, count, CHANNELS=channels, **LAUNCHES["blend_backward"],
            )  # fmt: skip
            triton_tiles.gather[(triton.cdiv(count, OWNERS), triton.cdiv(channels, part))](
                lists.ends, lists.counts, sums, records, *gradients, len(lists.slots), views, count,
                CHANNELS=channels, PART=part, **LAUNCHES["gather"],
            )  # fmt: skip
        v_background = (g_image * (1 - alpha)).sum(dim=(2, 3)) if ctx.needs_input_grad[4] else None
        v_means2d, v_records, v_features = gradients
        return v_means2d, None, v_records, v_features, v_background, None, None
