"""The CPU backend: numba kernels behind two autograd functions, projection and blending.

Between them stand the projected centres, a tensor of their own, so that densification can read its gradient.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from rewild4d.kernels.arrays import array
from rewild4d.kernels.doubles import WIDTH
from rewild4d.kernels.memory import keep_freed_memory
from rewild4d.kernels.threads import run, spans, thread_count
from rewild4d.rasterizer.binning import (
    BLOCK_LEFT,
    BLOCK_TOP,
    mark_pairs,
    scatter_pairs,
    sort_by_depth,
    start_tiles,
)
from rewild4d.rasterizer.blending import blend
from rewild4d.rasterizer.blending_backward import blend_backward, gather_slots, slot_width
from rewild4d.rasterizer.conventions import RasterInfo
from rewild4d.rasterizer.projection import RECORD, TILE, project
from rewild4d.rasterizer.projection_backward import CAMERA, CHUNK, project_backward

keep_freed_memory()

SERIAL_BELOW = 512
"""Gaussians for which waking a second thread costs more than it saves."""


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
    """Same as `rewild4d.rasterizer.rasterize`, on checked float32 CPU input; ``background`` is [V, C]."""
    options = (width, height, eps2d, antialias, near)
    means2d, records, radii, *binning = _Project.apply(
        means, quats, scales, opacities, world_to_camera, intrinsics, options
    )
    if means2d.requires_grad:
        means2d.retain_grad()
    if background is None:
        background = features.new_zeros(world_to_camera.shape[0], features.shape[1])
    image, alpha = _Blend.apply(means2d, records, features, background, radii, *binning, width, height)
    return image, alpha, RasterInfo(radii, means2d)


def _zeros(*shape: int) -> Tensor:
    # Not torch's: filled by its OpenMP threads, which then spin and take the cores from the next kernel.
    return torch.from_numpy(np.zeros(shape, np.float32))


def _padded(tensor: Tensor, rows: int, dimension: int = 0) -> Tensor:
    """The tensor with zeros below, where it has fewer rows: kernels take Gaussians by the eight."""
    missing = rows - tensor.shape[dimension]
    if missing == 0:
        return tensor
    shape = list(tensor.shape)
    shape[dimension] = missing
    return torch.cat([tensor, tensor.new_zeros(shape)], dimension)


class _Project(torch.autograd.Function):
    """World to image: centres [V, N, 2] and records [V, N, 8].

    And without gradients radii and depths [V, N], tiles [V, N, 4] and slots [V, N + 1], see `project`.
    """

    @staticmethod
    def forward(
        ctx: Any,
        means: Tensor,
        quats: Tensor,
        scales: Tensor,
        opacities: Tensor,
        world_to_camera: Tensor,
        intrinsics: Tensor,
        options: tuple[int, int, float, bool, float],
    ) -> tuple[Tensor, ...]:
        views, count = world_to_camera.shape[0], means.shape[0]
        room = max(count, WIDTH)
        means2d, records = means.new_empty(views, room, 2), means.new_empty(views, room, RECORD)
        radii, depths = means.new_empty(views, room), means.new_empty(views, room, dtype=torch.float64)
        tiles, slots = means.new_empty(views, room, 4), torch.empty(views, room + 1, dtype=torch.int64)
        gaussians = tuple(array(_padded(tensor, room)).ravel() for tensor in (means, quats, scales, opacities))
        cameras = array(world_to_camera.double()), array(intrinsics.double())
        outputs = [means2d, records, radii, depths, tiles, slots]
        arrays = tuple(tensor.numpy().ravel() for tensor in outputs)
        pieces = spans(room, thread_count() if count * views > SERIAL_BELOW else 1)
        totals = np.empty((len(pieces), views), np.int64)
        run(project, [(*piece, *gaussians, *cameras, *options, *arrays, totals[i]) for i, piece in enumerate(pieces)])
        _join_numbers(slots.numpy(), pieces, totals)
        if room > count:
            outputs = [tensor[:, : count + (tensor is slots)].contiguous() for tensor in outputs]
        ctx.save_for_backward(means, quats, scales, opacities, world_to_camera, intrinsics, outputs[2])
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
        cameras = array(world_to_camera.double()), array(intrinsics.double())
        gradients = [tensor.new_empty(room, *tensor.shape[1:]) for tensor in inputs[:4]]
        outputs = tuple(tensor.numpy().ravel() for tensor in gradients)
        shared = tuple(array(_padded(tensor, room, 1)).ravel() for tensor in (radii, g_means2d, g_records))
        chunks = spans(room, -(-room // CHUNK))
        v_cameras = np.zeros((len(chunks), views, CAMERA, WIDTH))
        with_cameras = any(ctx.needs_input_grad[4:6])

        def work(first: int, last: int) -> None:
            for chunk in range(first, last):
                project_backward(
                    *chunks[chunk],
                    *arrays,
                    *cameras,
                    *ctx.options[:4],
                    with_cameras,
                    *shared,
                    *outputs,
                    v_cameras[chunk].ravel(),
                )

        run(work, spans(len(chunks), thread_count()))
        totals = torch.from_numpy(v_cameras.sum(axis=(0, 3))).to(world_to_camera)
        v_world_to_camera, v_intrinsics = torch.zeros_like(world_to_camera), torch.zeros_like(intrinsics)
        v_world_to_camera[:, :3] = totals[:, :12].view(views, 3, 4)
        v_intrinsics[:, (0, 1, 0, 1), (0, 1, 2, 2)] = totals[:, 12:].to(intrinsics)
        return *(gradient[:count] for gradient in gradients), v_world_to_camera, v_intrinsics, None


@dataclass(frozen=True)
class _Lists:
    """The tiles' Gaussians, front to back, of one call (see binning.py)."""

    tiles: tuple[int, int]
    slots: np.ndarray
    pair_bits: np.ndarray
    starts: np.ndarray
    entry_gaussian: np.ndarray
    entry_slot: np.ndarray


def _bin(
    records: np.ndarray,
    radii: np.ndarray,
    depths: np.ndarray,
    tiles: np.ndarray,
    slots: np.ndarray,
    width: int,
    height: int,
) -> _Lists:
    views, count = radii.shape
    tiles_x, tiles_y = -(-width // TILE), -(-height // TILE)
    order = np.empty((views, count), np.int32)
    keys, spare = np.empty(count, np.int64), np.empty(count, np.int64)
    counts = [sort_by_depth(view, radii, depths, order, keys, spare) for view in range(views)]
    parts = thread_count() if sum(counts) > SERIAL_BELOW else 1
    pieces = [(view, *span) for view in range(views) for span in spans(counts[view], parts)]
    pairs = int(slots[-1, -1])
    pair_tile, pair_bits = np.empty(pairs, np.int32), np.empty(pairs, np.uint16)
    histograms = np.zeros((max(1, len(pieces)), views * tiles_x * tiles_y), np.int32)
    grid = (tiles_x, tiles_y, BLOCK_LEFT, BLOCK_TOP)
    _run_pieces(
        mark_pairs,
        [
            (*piece, order, records, tiles, slots, *grid, pair_tile, pair_bits, histograms[i])
            for i, piece in enumerate(pieces)
        ],
    )
    starts = np.empty(histograms.shape[1] + 1, np.int64)
    start_tiles(histograms, starts)
    entry_gaussian, entry_slot = np.empty(starts[-1], np.int32), np.empty(starts[-1], np.int32)
    _run_pieces(
        scatter_pairs,
        [
            (*piece, order, slots, pair_tile, pair_bits, histograms[i], entry_gaussian, entry_slot)
            for i, piece in enumerate(pieces)
        ],
    )
    return _Lists((tiles_x, tiles_y), slots, pair_bits, starts, entry_gaussian, entry_slot)


def _join_numbers(slots: np.ndarray, pieces: list[tuple[int, int]], totals: np.ndarray) -> None:
    """Let the slots of each view and piece, numbered from 0, go on where those before end."""
    before = 0
    for view in range(len(slots)):
        for (begin, end), total in zip(pieces, totals[:, view].tolist(), strict=True):
            slots[view, begin:end] += before
            before += total
        slots[view, -1] = before


def _run_pieces(function: Any, calls: list[tuple[Any, ...]]) -> None:
    width = thread_count()
    for first in range(0, len(calls), width):
        run(function, calls[first : first + width])


class _Blend(torch.autograd.Function):
    """Image-space Gaussians to features [V, C, h, w] and alpha [V, 1, h, w]."""

    @staticmethod
    def forward(
        ctx: Any,
        means2d: Tensor,
        records: Tensor,
        features: Tensor,
        background: Tensor,
        radii: Tensor,
        depths: Tensor,
        tiles: Tensor,
        slots: Tensor,
        width: int,
        height: int,
    ) -> tuple[Tensor, Tensor]:
        views, channels = radii.shape[0], features.shape[1]
        lists = _bin(records.numpy(), radii.numpy(), depths.numpy(), tiles.numpy(), slots.numpy(), width, height)
        image, alpha = features.new_empty(views, channels, height, width), features.new_empty(views, 1, height, width)
        call = (
            np.zeros(1, np.int64), *lists.tiles, lists.starts, lists.entry_gaussian, lists.entry_slot, lists.pair_bits,
            records.numpy().ravel(), array(features).ravel(), array(background), image.numpy(), alpha.numpy(),
        )  # fmt: skip
        run(blend, [call] * _blend_threads(lists))
        ctx.save_for_backward(records, features, background, image, alpha)
        ctx.lists = lists
        return image, alpha

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, g_image: Tensor, g_alpha: Tensor) -> tuple[Tensor | None, ...]:
        records, features, background, image, alpha = ctx.saved_tensors
        lists: _Lists = ctx.lists
        channels = features.shape[1]
        width = slot_width(channels)
        sums = np.empty(len(lists.pair_bits) * width, np.float32)
        call = (
            np.zeros(1, np.int64), *lists.tiles, lists.starts, lists.entry_gaussian, lists.entry_slot, lists.pair_bits,
            records.numpy().ravel(), array(features).ravel(), image.numpy(), alpha.numpy(),
            array(g_image), array(g_alpha), sums,
        )  # fmt: skip
        run(blend_backward, [call] * _blend_threads(lists))
        v_means2d, v_records = _zeros(*records.shape[:2], 2), _zeros(*records.shape)
        v_features = _zeros(*features.shape)
        outputs = (v_means2d.numpy(), v_records.numpy(), v_features.numpy())
        given = (lists.slots, lists.pair_bits, records.numpy(), sums, width)
        pieces = spans(records.shape[1], _blend_threads(lists))
        for view in range(records.shape[0]):
            run(gather_slots, [(view, *piece, *given, *outputs) for piece in pieces])
        v_background = None
        if ctx.needs_input_grad[3]:
            v_background = (g_image * (1 - alpha)).sum(dim=(2, 3))
        return v_means2d, v_records, v_features, v_background, None, None, None, None, None, None


def _blend_threads(lists: _Lists) -> int:
    return thread_count() if len(lists.entry_slot) > SERIAL_BELOW else 1
