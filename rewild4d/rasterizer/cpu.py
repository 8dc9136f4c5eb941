"""The CPU backend: numba kernels behind two autograd functions, projection and blending.

The projected centres between them are a tensor of their own, so that densification can read its gradient.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from rewild4d.kernels.arrays import array
from rewild4d.kernels.doubles import WIDTH
from rewild4d.kernels.memory import keep_freed_memory
from rewild4d.kernels.phases import phase_counters
from rewild4d.kernels.threads import run, spans, thread_count
from rewild4d.rasterizer.binning import BLOCK_LEFT, BLOCK_TOP
from rewild4d.rasterizer.blending import CONSTANTS
from rewild4d.rasterizer.blending_backward import slot_width
from rewild4d.rasterizer.conventions import Options, RasterInfo, RasterInput, Rendered, camera_gradients
from rewild4d.rasterizer.crowds import CROWD, NOWHERE
from rewild4d.rasterizer.projection import RECORD, TILE
from rewild4d.rasterizer.projection_backward import CAMERA, CHUNK
from rewild4d.rasterizer.stages import bin_and_blend, blend_back, project_and_sort, project_back

keep_freed_memory()

SERIAL_BELOW = 512
"""Number of Gaussians up to which one thread is fastest."""
MOST_PARTS = 4
"""Most parts in which a view's Gaussians are marked: one thread adds the square of that many counts a tile."""


def rasterize(given: RasterInput) -> Rendered:
    """Render like `rewild4d.rasterizer.rasterize`, on float32 CPU input."""
    features, world_to_camera, intrinsics, width, height, background = given[4:10]
    means2d, records, radii, *binning = _Project.apply(given.options, *given[:4], world_to_camera, intrinsics)
    if means2d.requires_grad:
        means2d.retain_grad()
    if background is None:
        background = features.new_zeros(world_to_camera.shape[0], features.shape[1])
    crowd = CROWD if world_to_camera.requires_grad or intrinsics.requires_grad else NOWHERE
    image, alpha = _Blend.apply(means2d, records, features, background, binning, (width, height), crowd)
    return image, alpha, RasterInfo(radii, means2d)


def _zeros(*shape: int) -> Tensor:
    # torch's OpenMP threads would keep spinning and take the cores from the next kernel
    return torch.from_numpy(np.zeros(shape, np.float32))


def _padded(tensor: Tensor, rows: int, dimension: int = 0) -> Tensor:
    """Return the tensor padded with zeros to a number of rows: kernels take eight Gaussians at a time."""
    missing = rows - tensor.shape[dimension]
    if missing == 0:
        return tensor
    shape = list(tensor.shape)
    shape[dimension] = missing
    return torch.cat([tensor, tensor.new_zeros(shape)], dimension)


def _bounds(count: int, parts: int) -> np.ndarray:
    """Return the first and one past the last of each part, [P, 2]."""
    return np.array(spans(count, parts), np.int64).reshape(-1, 2)


class _Project(torch.autograd.Function):
    """Project means, quats, scales and opacities by world_to_camera and intrinsics.

    Returns centres [V, N, 2] and records [V, N, 8]; without gradients radii, depths and order [V, N], tiles [V, N, 4],
    slots [V, N + 1] and counts [V], see `project_and_sort`.
    """

    @staticmethod
    def forward(ctx: Any, options: Options, *inputs: Tensor) -> tuple[Tensor, ...]:
        *gaussian_tensors, world_to_camera, intrinsics = inputs
        means = inputs[0]
        views, count = world_to_camera.shape[0], means.shape[0]
        room = max(count, WIDTH)
        means2d, records = means.new_empty(views, room, 2), means.new_empty(views, room, RECORD)
        radii, order = means.new_empty(views, room), torch.empty(views, room, dtype=torch.int32)
        depths = torch.empty(views, room, dtype=torch.float64)
        tiles, slots = means.new_empty(views, room, 4), torch.empty(views, room + 1, dtype=torch.int64)
        counts = np.empty(views, np.int64)
        gaussians = tuple(array(_padded(tensor, room)).ravel() for tensor in gaussian_tensors)
        cameras = array(world_to_camera).astype(np.float64), array(intrinsics).astype(np.float64)
        threads = thread_count() if count * views > SERIAL_BELOW else 1
        bounds = _bounds(room, min(threads, room // WIDTH))  # `project` takes eight at a time
        call = (
            phase_counters(2), bounds, gaussians, cameras, options, means2d.numpy().ravel(), records.numpy().ravel(),
            radii.numpy(), depths.numpy(), tiles.numpy().ravel(), slots.numpy(), order.numpy(), counts,
            np.empty((len(bounds), views), np.int64), np.empty((views, 2, room), np.int64),
        )  # fmt: skip
        run(project_and_sort, [call] * threads)
        outputs = [means2d, records, radii, depths, order, tiles, slots]
        if room > count:
            outputs = [tensor[:, : count + (tensor is slots)].contiguous() for tensor in outputs]
        outputs.append(torch.from_numpy(counts))
        ctx.save_for_backward(*inputs, outputs[2])
        ctx.options = options
        ctx.mark_non_differentiable(*outputs[2:])
        ctx.set_materialize_grads(True)
        return tuple(outputs)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, g_means2d: Tensor, g_records: Tensor, *_: Tensor) -> tuple[Tensor | None, ...]:
        *inputs, radii = ctx.saved_tensors
        world_to_camera, intrinsics = inputs[4:]
        views, count = radii.shape
        room = max(count, WIDTH)
        arrays = tuple(array(_padded(tensor, room)).ravel() for tensor in inputs[:4])
        cameras = array(world_to_camera).astype(np.float64), array(intrinsics).astype(np.float64)
        gradients = [tensor.new_empty(room, *tensor.shape[1:]) for tensor in inputs[:4]]
        outputs = tuple(tensor.numpy().ravel() for tensor in gradients)
        shared = tuple(array(_padded(tensor, room, 1)).ravel() for tensor in (radii, g_means2d, g_records))
        bounds = _bounds(room, -(-room // CHUNK))
        v_cameras = np.zeros((len(bounds), views * CAMERA * WIDTH))
        with_cameras = any(ctx.needs_input_grad[5:7])
        call = (
            np.zeros(1, np.int64), bounds, arrays, cameras, ctx.options, with_cameras, *shared, outputs, v_cameras,
        )  # fmt: skip
        run(project_back, [call] * min(thread_count(), len(bounds)))
        v_world_to_camera = v_intrinsics = None
        if with_cameras:
            totals = torch.from_numpy(v_cameras.reshape(-1, views, CAMERA, WIDTH).sum(axis=(0, 3)))
            v_world_to_camera, v_intrinsics = camera_gradients(totals, world_to_camera, intrinsics)
        return None, *(gradient[:count] for gradient in gradients), v_world_to_camera, v_intrinsics


class _Lists(NamedTuple):
    """The tiles' Gaussians, front to back, of one call (see binning.py)."""

    tiles: tuple[int, int]
    slots: np.ndarray
    pair_bits: np.ndarray
    entries: tuple[np.ndarray, ...]
    """starts, entry_gaussian, entry_slot and entry_bits."""


class _Blend(torch.autograd.Function):
    """Blend image-space Gaussians to features [V, C, h, w] and alpha [V, 1, h, w]; ``binning`` is from `_Project`."""

    @staticmethod
    def forward(
        ctx: Any, means2d: Tensor, records: Tensor, features: Tensor, background: Tensor, binning: Sequence[Tensor],
        size: tuple[int, int], crowd: int,
    ) -> tuple[Tensor, Tensor]:  # fmt: skip
        (views, channels), (width, height) = (records.shape[0], features.shape[1]), size
        depths, order, tiles, slots, counts = (tensor.numpy() for tensor in binning)
        tiles_x, tiles_y = -(-width // TILE), -(-height // TILE)
        threads = thread_count() if counts.sum() > SERIAL_BELOW else 1
        parts = min(threads, MOST_PARTS)
        pairs = int(slots[-1, -1])
        lists = _Lists(
            (tiles_x, tiles_y), slots, np.empty(pairs, np.uint16),
            (np.empty(views * tiles_x * tiles_y + 1, np.int64), np.empty(pairs, np.int32), np.empty(pairs, np.int32),
             np.empty(pairs, np.uint16)),
        )  # fmt: skip
        image, alpha = features.new_empty(views, channels, height, width), features.new_empty(views, 1, height, width)
        through = np.empty(alpha.numel() if ctx.needs_input_grad[3] else 0, np.float32)
        call = (
            phase_counters(3), np.zeros(1, np.int64), counts, depths, order, tiles, slots, tiles_x, tiles_y,
            BLOCK_LEFT, BLOCK_TOP, np.empty(pairs, np.int32), lists.pair_bits,
            np.zeros((parts, parts, views * tiles_x * tiles_y), np.int32), lists.entries, CONSTANTS, records.numpy(),
            array(features).ravel(), array(background), image.numpy(), alpha.numpy(), through,
        )  # fmt: skip
        run(bin_and_blend, [call] * threads)
        ctx.save_for_backward(records, features, background, image, alpha)
        ctx.lists, ctx.crowd, ctx.through = lists, crowd, torch.from_numpy(through)
        return image, alpha

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, g_image: Tensor, g_alpha: Tensor) -> tuple[Tensor | None, ...]:
        records, features, background, image, alpha = ctx.saved_tensors
        lists: _Lists = ctx.lists
        width = slot_width(features.shape[1])
        sums = records.new_empty(len(lists.pair_bits) * width).numpy()  # torch's memory begins with a cache line
        v_means2d, v_records = _zeros(*records.shape[:2], 2), _zeros(*records.shape)
        v_features = _zeros(*features.shape)
        threads = thread_count() if len(lists.pair_bits) > SERIAL_BELOW else 1
        call = (
            phase_counters(2), np.zeros(1, np.int64), _bounds(records.shape[1], threads),
            *lists.tiles, lists.entries, lists.pair_bits, records.numpy(), array(features).ravel(), array(background),
            image.numpy(), alpha.numpy(), array(g_image), array(g_alpha), any(ctx.needs_input_grad[:2]), ctx.crowd,
            sums, lists.slots, width, v_means2d.numpy(), v_records.numpy(), v_features.numpy(),
        )  # fmt: skip
        run(blend_back, [call] * threads)
        v_background = None
        if ctx.needs_input_grad[3]:
            v_background = (g_image * ctx.through.view_as(alpha)).sum(dim=(2, 3))
        return v_means2d, v_records, v_features, v_background, None, None, None
