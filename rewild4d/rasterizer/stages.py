"""The stages of a call, in few rounds of threads: see kernels/phases.py."""

import numpy as np

from rewild4d.kernels.compiling import kernel
from rewild4d.kernels.phases import end_phase, enter_phase, phase_ticket
from rewild4d.kernels.simd import take_ticket
from rewild4d.rasterizer.binning import mark_pairs, scatter_pairs, sort_by_depth, start_tiles
from rewild4d.rasterizer.blending import blend
from rewild4d.rasterizer.blending_backward import blend_backward, gather_slots
from rewild4d.rasterizer.projection import project
from rewild4d.rasterizer.projection_backward import project_backward


@kernel
def _join_numbers(slots: np.ndarray, bounds: np.ndarray, totals: np.ndarray) -> None:
    """Offset the slots of each view and piece, numbered from 0, by the number of those before."""
    before = 0
    for view in range(len(slots)):
        for piece in range(len(bounds)):
            for n in range(bounds[piece, 0], bounds[piece, 1]):
                slots[view, n] += before
            before += totals[piece, view]
        slots[view, -1] = before


@kernel
def project_and_sort(
    counters: np.ndarray, bounds: np.ndarray, gaussians: tuple, cameras: tuple, options: tuple, means2d: np.ndarray,
    records: np.ndarray, radii: np.ndarray, depths: np.ndarray, tiles: np.ndarray, slots: np.ndarray,
    order: np.ndarray, counts: np.ndarray, totals: np.ndarray, keys: np.ndarray,
) -> None:  # fmt: skip
    """Project Gaussians (`project`), number their tiles, and sort the visible ones.

    Args:
        counters: of two phases.
        bounds: first and one past the last Gaussian of each piece, [P, 2].
        order, counts: set to the visible Gaussians of a view, nearest first, [V, N], and their number, [V].
        totals, keys: scratch, [P, V] and [V, 2, N].
        slots: as in `project`, but continued from view to view, [V, N + 1].
        radii: [V, N], like depths; all other arguments as in `project`.
    """
    views = len(slots)
    enter_phase(counters, 0)
    while True:
        piece = phase_ticket(counters, 0)
        if piece >= len(bounds):
            break
        project(
            bounds[piece, 0], bounds[piece, 1], gaussians, cameras, options, means2d, records, radii.reshape(-1),
            depths.reshape(-1), tiles, slots.reshape(-1), totals[piece],
        )  # fmt: skip
    end_phase(counters, 0)
    while True:
        unit = phase_ticket(counters, 1)
        if unit > views:
            return
        if unit == views:
            _join_numbers(slots, bounds, totals)
        else:
            counts[unit] = sort_by_depth(unit, depths, order, keys[unit, 0], keys[unit, 1])


@kernel
def bin_and_blend(
    counters: np.ndarray, tickets: np.ndarray, counts: np.ndarray, depths: np.ndarray, order: np.ndarray,
    tiles: np.ndarray, slots: np.ndarray, tiles_x: int, tiles_y: int, block_left: np.ndarray, block_top: np.ndarray,
    pair_tile: np.ndarray, pair_bits: np.ndarray, histograms: np.ndarray, lists: tuple, constants: np.ndarray,
    records: np.ndarray, features: np.ndarray, background: np.ndarray, image: np.ndarray, alpha: np.ndarray,
    through: np.ndarray,
) -> None:  # fmt: skip
    """Make the tiles' lists and blend them.

    Args:
        counters: of three phases.
        counts: visible Gaussians of each view, [V].
        histograms: zero, [P, P, tiles of all views]: a view's Gaussians are marked, and scattered, in P parts.
        records: [V, N, 8]; all other arguments as in `mark_pairs`, `scatter_pairs` and `blend`.
    """
    parts, units, count = len(histograms), len(histograms) * len(counts), records.shape[1]
    starts, entry_gaussian, entry_slot, entry_bits = lists
    enter_phase(counters, 0)
    while True:
        unit = phase_ticket(counters, 0)
        if unit >= units:
            break
        view, part = unit // parts, unit % parts
        if counts[view] > 0:
            firsts = order[view][counts[view] * np.arange(parts) // parts]
            mark_pairs(
                view, count * part // parts, count * (part + 1) // parts, firsts, depths, records, tiles, slots,
                tiles_x, tiles_y, block_left, block_top, pair_tile, pair_bits, histograms[part],
            )  # fmt: skip
    end_phase(counters, 0)
    enter_phase(counters, 1)
    if phase_ticket(counters, 1) == 0:
        start_tiles(histograms, starts)
    end_phase(counters, 1)
    enter_phase(counters, 2)
    while True:
        unit = phase_ticket(counters, 2)
        if unit >= units:
            break
        view, part = unit // parts, unit % parts
        scatter_pairs(
            view, counts[view] * part // parts, counts[view] * (part + 1) // parts, order, slots, pair_tile,
            pair_bits, histograms[0, part], entry_gaussian, entry_slot, entry_bits,
        )  # fmt: skip
    end_phase(counters, 2)
    blend(
        tickets, constants, tiles_x, tiles_y, lists, pair_bits, records.reshape(-1), features, background, image,
        alpha, through,
    )  # fmt: skip


@kernel
def blend_back(
    counters: np.ndarray, tickets: np.ndarray, bounds: np.ndarray, tiles_x: int, tiles_y: int, lists: tuple,
    pair_bits: np.ndarray, records: np.ndarray, features: np.ndarray, background: np.ndarray, image: np.ndarray,
    alpha: np.ndarray, g_image: np.ndarray, g_alpha: np.ndarray, geometry: bool, crowd: int, sums: np.ndarray,
    slots: np.ndarray, width: int, v_means2d: np.ndarray, v_records: np.ndarray, v_features: np.ndarray,
) -> None:  # fmt: skip
    """Compute the gradient of `bin_and_blend`: slots of all tiles, then their sums for each Gaussian.

    Args:
        counters: of two phases.
        bounds: first and one past the last Gaussian of each piece, [P, 2].
        v_features: zero, [N, C]; all other arguments as in `blend_backward` and `gather_slots`.
    """
    enter_phase(counters, 0)
    blend_backward(
        tickets, tiles_x, tiles_y, lists, records.reshape(-1), features, background, image, alpha, g_image, g_alpha,
        geometry, crowd, sums,
    )  # fmt: skip
    end_phase(counters, 0)
    while True:
        piece = phase_ticket(counters, 1)
        if piece >= len(bounds):
            return
        for view in range(len(records)):
            gather_slots(
                view, bounds[piece, 0], bounds[piece, 1], slots, pair_bits, records, sums, width, v_means2d, v_records,
                v_features,
            )  # fmt: skip


@kernel
def project_back(
    tickets: np.ndarray, bounds: np.ndarray, gaussians: tuple, cameras: tuple, options: tuple, with_cameras: bool,
    radii: np.ndarray, g_means2d: np.ndarray, g_records: np.ndarray, v_gaussians: tuple, v_cameras: np.ndarray,
) -> None:  # fmt: skip
    """Compute the gradient of `project_and_sort`.

    Args:
        bounds: first and one past the last Gaussian of each piece, [P, 2].
        v_cameras: zero, [P, V 16 8]; all other arguments as in `project_backward`.
    """
    while True:
        piece = take_ticket(tickets)
        if piece >= len(bounds):
            return
        project_backward(
            bounds[piece, 0], bounds[piece, 1], gaussians, cameras, options, with_cameras, radii, g_means2d, g_records,
            v_gaussians, v_cameras[piece],
        )  # fmt: skip
