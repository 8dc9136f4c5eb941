"""Between projection and blending on a GPU: list the tiles' entries, and sum a Gaussian's gradients over its tiles."""

import math

import triton
import triton.language as tl

from rewild4d.rasterizer.triton_blend import MOMENTS
from rewild4d.rasterizer.triton_project import DEPTH_BITS, RECORD

ENTRIES = tl.constexpr(256)
"""Entries of one program of `list_entries` or `start_tiles`."""
OWNERS = tl.constexpr(32)
"""Gaussians of one program of `gather`."""
ROWS = tl.constexpr(4)
"""Rows that it reads at once, to hide latency."""

_LN2 = tl.constexpr(math.log(2.0))

LAST = tl.constexpr((1 << 63) - 1)
"""Key of room that no entry takes; it sorts behind all others."""

SIZES = ["room", "rows", "steps", "across", "views", "count", "number"]


@triton.jit(do_not_specialize=SIZES)
def list_entries(
    ends: tl.tensor, tiles: tl.tensor, wides: tl.tensor, first_keys: tl.tensor, keys: tl.tensor, owners: tl.tensor,
    room: tl.tensor, rows: tl.tensor, steps: tl.tensor, across: tl.tensor,
) -> None:  # fmt: skip
    """Fill keys and owners [room] with each row's rectangle of tiles, row after row, then `LAST`; program (block).

    A row is a view and a Gaussian, view * N + Gaussian. ``ends`` [rows] is the running sum of ``tiles``; each entry
    finds its row by binary search in ``steps`` steps. Entries beyond the room are left out.
    """
    entry = tl.program_id(0).to(tl.int64) * ENTRIES + tl.arange(0, ENTRIES)
    within = entry < room
    real = within & (entry < tl.load(ends + rows - 1))
    low = tl.zeros((ENTRIES,), tl.int32)
    high = low + rows - 1
    for _ in range(steps):
        middle = (low + high) // 2
        beyond = tl.load(ends + middle, real, 0) <= entry
        low, high = tl.where(beyond, tl.minimum(middle + 1, high), low), tl.where(beyond, high, middle)
    rank = (entry - tl.load(ends + low, real, 0)).to(tl.int32) + tl.load(tiles + low, real, 1)
    wide = tl.load(wides + low, real, 1)
    step = (rank // wide * across + rank % wide).to(tl.int64)
    tl.store(keys + entry, tl.where(real, tl.load(first_keys + low, real, 0) + (step << DEPTH_BITS), LAST), within)
    tl.store(owners + entry, tl.where(real, low, 0), within)


@triton.jit(do_not_specialize=SIZES)
def start_tiles(
    keys: tl.tensor, slots: tl.tensor, owners: tl.tensor, entries: tl.tensor, starts: tl.tensor, room: tl.tensor,
    number: tl.tensor, steps: tl.tensor,
) -> None:  # fmt: skip
    """Fill entries [room], the owners in the order of the sorted keys, and starts [tiles + 1]; program (block).

    Each of ``number`` starts is the index of the first key that is not before its tile, found by binary search.
    """
    index = tl.program_id(0).to(tl.int64) * ENTRIES + tl.arange(0, ENTRIES)
    real = index < room
    tl.store(entries + index, tl.load(owners + tl.load(slots + index, real, 0), real, 0), real)
    low = tl.zeros((ENTRIES,), tl.int64)
    high = low + room
    for _ in range(steps):
        middle = (low + high) // 2
        before = (low < high) & (tl.load(keys + middle, low < high, 0) < (index << DEPTH_BITS))
        low, high = tl.where(before, middle + 1, low), tl.where(before, high, middle)
    tl.store(starts + index, low, index < number)


@triton.jit(do_not_specialize=SIZES)
def gather(
    ends: tl.tensor, tiles: tl.tensor, sums: tl.tensor, records: tl.tensor, v_means2d: tl.tensor, v_records: tl.tensor,
    v_features: tl.tensor, room: tl.tensor, views: tl.tensor, count: tl.tensor, CHANNELS: tl.constexpr,
    PART: tl.constexpr,
) -> None:  # fmt: skip
    """Add a Gaussian's rows of the sums [room, 6 + C]; program (block, part of the channels).

    Fills v_means2d [V, N, 2] and v_records [V, N, 4] (see triton_project.py) and v_features [N, C], over all views.
    """
    n = tl.program_id(0).to(tl.int64) * OWNERS + tl.arange(0, OWNERS)
    channel = tl.program_id(1) * PART + tl.arange(0, PART)
    real, real_channel = n < count, channel < CHANNELS
    shade = tl.zeros((OWNERS, PART), tl.float32)
    for view in range(views):
        row = view * count + n
        end = tl.load(ends + row, real, 0)
        place = tl.maximum(end - tl.load(tiles + row, real, 0), 0)
        end = tl.minimum(end, room)
        none = tl.zeros((OWNERS,), tl.float32)
        m, mt, mu, mtt, mtu, muu = none, none, none, none, none, none
        while tl.max(end - place, 0) > 0:
            for _ in tl.static_range(ROWS):
                live = place < end
                at = sums + place * (MOMENTS + CHANNELS)
                m += tl.load(at, live, 0.0)
                mt += tl.load(at + 1, live, 0.0)
                mu += tl.load(at + 2, live, 0.0)
                mtt += tl.load(at + 3, live, 0.0)
                mtu += tl.load(at + 4, live, 0.0)
                muu += tl.load(at + 5, live, 0.0)
                shade += tl.load(at[:, None] + (channel + MOMENTS)[None, :], live[:, None] & real_channel[None, :], 0.0)
                place += 1
        if tl.program_id(1) == 0:
            along_x = tl.load(records + row * RECORD, real, 0.0)
            along_y = tl.load(records + row * RECORD + 1, real, 0.0)
            fall = tl.load(records + row * RECORD + 2, real, 0.0)
            tl.store(v_means2d + 2 * row, along_x * mt * (2 * _LN2), real)
            tl.store(v_means2d + 2 * row + 1, (along_y * mt + fall * mu) * (2 * _LN2), real)
            tl.store(v_records + row * RECORD, mtt * _LN2, real)
            tl.store(v_records + row * RECORD + 1, mtu * _LN2, real)
            tl.store(v_records + row * RECORD + 2, muu * _LN2, real)
            tl.store(v_records + row * RECORD + 3, m * _LN2, real)
    tl.store(v_features + n[:, None] * CHANNELS + channel[None, :], shade, real[:, None] & real_channel[None, :])
