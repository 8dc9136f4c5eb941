"""Blending and its gradient as Triton kernels: one program a tile, one lane a pixel, a group of Gaussians at a time.

Shapes inside: P pixels of a tile, G Gaussians of a group. Scans run along G, within a thread; sums along P cross the
threads once a group. Nothing is added atomically, so results are the same bits. Sums over C avoid [G, C, P], which
Triton turns into a product in TF32 with three digits less.
With TRITON_INTERPRET=1 in the environment before Triton is imported the same code runs on the CPU, slowly.
"""

import math

import triton
import triton.language as tl

from rewild4d.rasterizer import conventions, projection

SIDE = tl.constexpr(8)
"""Side of a tile in pixels: one warp's, so that sums over its pixels need no shared memory."""
PIXELS = tl.constexpr(SIDE.value**2)
BUCKET = tl.constexpr(32)
"""Gaussians of a tile that one program of the backward pass takes; the blend keeps what it had before each bucket."""
MOMENTS = tl.constexpr(6)
"""Sums of q, q t, q u, q t^2, q t u, q u^2 that come before the channel sums in a slot, q = dL/dalpha alpha."""
_MAX_ALPHA = tl.constexpr(conventions.MAX_ALPHA)
_WEAKEST = tl.constexpr(projection.LOG2_MIN_ALPHA)
_STRONGEST = tl.constexpr(math.log2(conventions.MAX_ALPHA))
_LEAST_LEFT = tl.constexpr(conventions.MIN_TRANSMITTANCE)

SIZES = ["tiles", "steps", "width", "height", "across", "down", "count"]


@triton.jit
def _pixels(tile: tl.tensor, width: tl.tensor, height: tl.tensor, across: tl.tensor, down: tl.tensor) -> tuple:
    """Return the view of the tile; column and row of its pixels, [P]; whether they lie in the image, [P]."""
    lane = tl.arange(0, PIXELS)
    x = tile % across * SIDE + lane % SIDE
    y = tile // across % down * SIDE + lane // SIDE
    return tile // (across * down), x, y, (x < width) & (y < height)


@triton.jit
def _alphas(
    entries: tl.tensor, first: tl.tensor, end: tl.tensor, centres: tl.tensor, rests: tl.tensor, records: tl.tensor,
    x: tl.tensor, y: tl.tensor, GROUP: tl.constexpr,
) -> tuple:  # fmt: skip
    """Return the group's Gaussians and which are valid, [G]; t, u, log2 of the uncapped alpha, and alpha, [G, P]."""
    place = first + tl.arange(0, GROUP)
    real = place < end
    n = tl.load(entries + place, real, 0)
    dx = (x + 0.5)[None, :] - tl.load(centres + n * 2, real, 0.0)[:, None] - tl.load(rests + n * 2, real, 0.0)[:, None]
    dy = (y + 0.5)[None, :] - tl.load(centres + n * 2 + 1, real, 0.0)[:, None]
    dy -= tl.load(rests + n * 2 + 1, real, 0.0)[:, None]
    along_x = tl.load(records + n * 4, real, 0.0)[:, None]
    along_y = tl.load(records + n * 4 + 1, real, 0.0)[:, None]
    t, u = along_x * dx + along_y * dy, tl.load(records + n * 4 + 2, real, 0.0)[:, None] * dy
    exponent = tl.load(records + n * 4 + 3, real, -1000.0)[:, None] - (t * t + u * u)
    alpha = tl.where(exponent >= _WEAKEST, tl.minimum(tl.exp2(exponent), _MAX_ALPHA), 0.0)
    return n, real, t, u, exponent, alpha


@triton.jit
def _weights(alpha: tl.tensor, left: tl.tensor) -> tuple:
    """Return the transmittance behind each Gaussian if no pixel closed, and the Gaussian's weight, [G, P].

    The transmittance ``left`` [P] only falls: a pixel is closed where it is not above the least one.
    """
    after = left[None, :] * tl.cumprod(1.0 - alpha, 0)
    return after, tl.where(after > _LEAST_LEFT, after * (alpha / (1.0 - alpha)), 0.0)


@triton.jit(do_not_specialize=SIZES)
def blend(
    starts: tl.tensor, entries: tl.tensor, centres: tl.tensor, rests: tl.tensor, records: tl.tensor,
    features: tl.tensor, background: tl.tensor, image: tl.tensor, alpha_image: tl.tensor, kept: tl.tensor,
    width: tl.tensor, height: tl.tensor, across: tl.tensor, down: tl.tensor, count: tl.tensor, CHANNELS: tl.constexpr,
    PART: tl.constexpr, GROUP: tl.constexpr, KEEP: tl.constexpr,
) -> None:  # fmt: skip
    """Fill image [V, C, h, w] and alpha [V, 1, h, w]; program (tile, part of the channels).

    With KEEP also what was there before each bucket: kept [B, 1 + C, P] has the transmittance, 0 where nothing is left
    to blend, and the channels. The buckets of a tile are numbered from starts / BUCKET + tile on, so that no two are
    the same.
    """
    tile = tl.program_id(0)
    view, x, y, inside = _pixels(tile, width, height, across, down)
    first, end = tl.load(starts + tile), tl.load(starts + tile + 1)
    channel = tl.program_id(1) * PART + tl.arange(0, PART)
    real_channel = channel < CHANNELS
    left = tl.where(inside, 1.0, 0.0)
    through = left
    total = tl.zeros((PART, PIXELS), tl.float32)
    start, bucket = first, first // BUCKET + tile
    lane = tl.arange(0, PIXELS)
    while (first < end) & (tl.max(left, 0) > _LEAST_LEFT):
        if KEEP:  # noqa: SIM102 (a constant, and a number of the GPU)
            if (first - start) % BUCKET == 0:
                page = kept + (bucket + (first - start) // BUCKET) * ((1 + CHANNELS) * PIXELS)
                tl.store(page + (1 + channel)[:, None] * PIXELS + lane[None, :], total, real_channel[:, None])
                if tl.program_id(1) == 0:
                    tl.store(page + lane, left)
        n, real, _, _, _, alpha = _alphas(entries, first, end, centres, rests, records, x, y, GROUP)
        after, weight = _weights(alpha, left)
        place = (n - view * count)[:, None] * CHANNELS + channel[None, :]
        shade = tl.load(features + place, real[:, None] & real_channel[None, :], 0.0)
        total += tl.sum(weight[:, None, :] * shade[:, :, None], 0)
        through = tl.minimum(through, tl.min(tl.where(after > _LEAST_LEFT, after, 1.0), 0))
        left = tl.min(after, 0)
        first += GROUP
    if KEEP:  # noqa: SIM102
        if tl.program_id(1) == 0:
            page = bucket + (first - start + BUCKET - 1) // BUCKET
            while page < bucket + (end - start + BUCKET - 1) // BUCKET:
                tl.store(kept + page * ((1 + CHANNELS) * PIXELS) + lane, tl.zeros((PIXELS,), tl.float32))
                page += 1
    behind = tl.load(background + view * CHANNELS + channel, real_channel, 0.0)
    total += behind[:, None] * through[None, :]
    rows = ((view.to(tl.int64) * CHANNELS + channel) * height)[:, None] + y[None, :]
    tl.store(image + rows * width + x[None, :], total, real_channel[:, None] & inside[None, :])
    if tl.program_id(1) == 0:
        pixel = (view.to(tl.int64) * height + y) * width + x
        tl.store(alpha_image + pixel, 1.0 - through, inside)


@triton.jit(do_not_specialize=SIZES)
def blend_backward(
    starts: tl.tensor, entries: tl.tensor, slots: tl.tensor, centres: tl.tensor, rests: tl.tensor, records: tl.tensor,
    features: tl.tensor, image: tl.tensor, alpha_image: tl.tensor, kept: tl.tensor,
    g_image: tl.tensor, g_alpha: tl.tensor, sums: tl.tensor, tiles: tl.tensor, steps: tl.tensor, width: tl.tensor,
    height: tl.tensor, across: tl.tensor, down: tl.tensor, count: tl.tensor, CHANNELS: tl.constexpr,
    GROUP: tl.constexpr,
) -> None:  # fmt: skip
    """Fill the slots' rows of the sums [E, 6 + C]; program (bucket), whose tile is found by binary search.

    It goes front to back like the blend: the sum behind a Gaussian is the pixel's total minus the prefix.
    """
    bucket = tl.program_id(0)
    tile, last = tl.zeros((), tl.int32), tiles - 1
    for _ in range(steps):  # the last tile whose first bucket is not beyond
        middle = (tile + last + 1) // 2
        beyond = tl.load(starts + middle) // BUCKET + middle > bucket
        tile, last = tl.where(beyond, tile, middle), tl.where(beyond, middle - 1, last)
    start = tl.load(starts + tile)
    first = start + (bucket - start // BUCKET - tile) * BUCKET
    end = tl.minimum(first + BUCKET, tl.load(starts + tile + 1))
    if first >= end:
        return
    view, x, y, inside = _pixels(tile, width, height, across, down)
    page = kept + bucket.to(tl.int64) * ((1 + CHANNELS) * PIXELS) + tl.arange(0, PIXELS)
    pixel = (view.to(tl.int64) * height + y) * width + x
    plane = pixel + view * (CHANNELS - 1) * height.to(tl.int64) * width
    area = height.to(tl.int64) * width
    left = tl.load(page)
    # the loss's linear share of all that is blended from here on: g.out minus T dL/dalpha
    through = 1.0 - tl.load(alpha_image + pixel, inside, 1.0)
    behind = -through * tl.load(g_alpha + pixel, inside, 0.0)
    for channel in range(CHANNELS):
        gradient = tl.load(g_image + plane + channel * area, inside, 0.0)
        drawn_before = tl.load(page + (1 + channel) * PIXELS)
        behind += gradient * (tl.load(image + plane + channel * area, inside, 0.0) - drawn_before)
    while (first < end) & (tl.max(left, 0) > _LEAST_LEFT):
        n, real, t, u, exponent, alpha = _alphas(entries, first, end, centres, rests, records, x, y, GROUP)
        after, weight = _weights(alpha, left)
        row = sums + tl.load(slots + first + tl.arange(0, GROUP), real, 0) * (MOMENTS + CHANNELS)
        shade = features + (n - view * count) * CHANNELS
        drawn = tl.zeros((GROUP, PIXELS), tl.float32)
        for channel in range(CHANNELS):
            gradient = tl.load(g_image + plane + channel * area, inside, 0.0)[None, :]
            drawn += tl.load(shade + channel, real, 0.0)[:, None] * gradient
            tl.store(row + MOMENTS + channel, tl.sum(weight * gradient, 1), real)
        drawn *= weight
        rest = behind[None, :] - tl.cumsum(drawn, 0)
        # alpha dL/dalpha, where the Gaussian was blended and not capped
        pull = tl.where((weight > 0.0) & (exponent <= _STRONGEST), drawn - rest * (alpha / (1.0 - alpha)), 0.0)
        pull_t, pull_u = pull * t, pull * u
        tl.store(row, tl.sum(pull, 1), real)
        tl.store(row + 1, tl.sum(pull_t, 1), real)
        tl.store(row + 2, tl.sum(pull_u, 1), real)
        tl.store(row + 3, tl.sum(pull_t * t, 1), real)
        tl.store(row + 4, tl.sum(pull_t * u, 1), real)
        tl.store(row + 5, tl.sum(pull_u * u, 1), real)
        behind -= tl.sum(drawn, 0)
        left = tl.min(after, 0)
        first += GROUP
    while first < end:  # all pixels are closed
        place = first + tl.arange(0, GROUP)
        row = sums + tl.load(slots + place, place < end, 0) * (MOMENTS + CHANNELS)
        for column in range(MOMENTS + CHANNELS):
            tl.store(row + column, tl.zeros((GROUP,), tl.float32), place < end)
        first += GROUP
