"""L1 and SSIM of a render and its target as Triton kernels: blurs along rows, then along columns, a lane a pixel.

The twin is `ours.losses.images.colour_losses` over the whole image: zero padding, a window of `TAPS` pixels. With means
m, n of render and target and the blurred products xx, yy, xy, SSIM is (2 m n + C1) (2 (xy - m n) + C2) over
(m^2 + n^2 + C1) (xx - m^2 + yy - n^2 + C2).
"""

import triton
import triton.language as tl

TAPS = tl.constexpr(11)
BLOCK = tl.constexpr(256)

SIZES = ["width", "height"]


@triton.jit
def _composed(
    rgb: tl.tensor, alpha: tl.tensor, behind: tl.tensor, place: tl.tensor, pixel: tl.tensor, real: tl.tensor
) -> tl.tensor:
    """Return a channel over its background, 0 outside the image."""
    over = tl.load(rgb + place, real, 0.0) + (1.0 - tl.load(alpha + pixel, real, 0.0)) * behind
    return tl.where(real, over, 0.0)


@triton.jit(do_not_specialize=SIZES)
def blur_rows(
    rgb: tl.tensor, alpha: tl.tensor, target: tl.tensor, mask: tl.tensor, background: tl.tensor, window: tl.tensor,
    made: tl.tensor, width: tl.tensor, height: tl.tensor,
) -> None:  # fmt: skip
    """Fill made [5, 3, h, w] with x, y, x x, y y and x y blurred along rows; program (block of pixels, channel)."""
    area, channel = width * height, tl.program_id(1)
    pixel = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    column, behind = pixel % width, tl.load(background + channel)
    none = tl.zeros((BLOCK,), tl.float32)
    m, n, xx, yy, xy = none, none, none, none, none
    for k in range(TAPS):
        shift = k - TAPS // 2
        real = (pixel < area) & (column + shift >= 0) & (column + shift < width)
        near = pixel + shift
        x = _composed(rgb, alpha, behind, near + channel * area, near, real)
        y = _composed(target, mask, behind, near + channel * area, near, real)
        weight = tl.load(window + k)
        m, n, xx, yy, xy = m + weight * x, n + weight * y, xx + weight * x * x, yy + weight * y * y, xy + weight * x * y
    place, inside = made + channel * area + pixel, pixel < area
    tl.store(place, m, inside)
    tl.store(place + 3 * area, n, inside)
    tl.store(place + 6 * area, xx, inside)
    tl.store(place + 9 * area, yy, inside)
    tl.store(place + 12 * area, xy, inside)


@triton.jit(do_not_specialize=[*SIZES, "c1", "c2"])
def compare(
    rows: tl.tensor, rgb: tl.tensor, alpha: tl.tensor, target: tl.tensor, mask: tl.tensor, background: tl.tensor,
    window: tl.tensor, slopes: tl.tensor, sums: tl.tensor, width: tl.tensor, height: tl.tensor, c1: tl.tensor,
    c2: tl.tensor,
) -> None:  # fmt: skip
    """Blur rows [5, 3, h, w] of `blur_rows` along columns; fill sums [2, programs] with those of |x - y| and 1 - SSIM,
    and slopes [3, 3, h, w] with the derivatives of SSIM by m, xx and xy; program (block of pixels, channel)."""
    area, channel = width * height, tl.program_id(1)
    pixel = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    row, inside = pixel // width, pixel < area
    none = tl.zeros((BLOCK,), tl.float32)
    m, n, xx, yy, xy = none, none, none, none, none
    for k in range(TAPS):
        shift = k - TAPS // 2
        real = inside & (row + shift >= 0) & (row + shift < height)
        place, weight = rows + channel * area + pixel + shift * width, tl.load(window + k)
        m += weight * tl.load(place, real, 0.0)
        n += weight * tl.load(place + 3 * area, real, 0.0)
        xx += weight * tl.load(place + 6 * area, real, 0.0)
        yy += weight * tl.load(place + 9 * area, real, 0.0)
        xy += weight * tl.load(place + 12 * area, real, 0.0)
    over, under = 2 * m * n + c1, m * m + n * n + c1
    shared, spread = 2 * (xy - m * n) + c2, xx + yy - m * m - n * n + c2
    by = 1.0 / (under * spread)
    ssim = over * shared * by
    place = slopes + channel * area + pixel
    tl.store(place, 2 * n * (shared - over) * by + 2 * m * ssim * (1.0 / spread - 1.0 / under), inside)
    tl.store(place + 3 * area, -ssim / spread, inside)
    tl.store(place + 6 * area, 2 * over * by, inside)
    behind = tl.load(background + channel)
    x = _composed(rgb, alpha, behind, pixel + channel * area, pixel, inside)
    y = _composed(target, mask, behind, pixel + channel * area, pixel, inside)
    program = tl.program_id(0) * 3 + channel
    tl.store(sums + program, tl.sum(tl.abs(x - y), 0))
    tl.store(sums + tl.num_programs(0) * 3 + program, tl.sum(tl.where(inside, 1.0 - ssim, 0.0), 0))


@triton.jit(do_not_specialize=SIZES)
def blur_slopes(slopes: tl.tensor, window: tl.tensor, made: tl.tensor, width: tl.tensor, height: tl.tensor) -> None:
    """Blur slopes [9, h, w] along rows; program (block of pixels, map)."""
    area = width * height
    pixel = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    column, base, total = pixel % width, tl.program_id(1) * area + pixel, tl.zeros((BLOCK,), tl.float32)
    for k in range(TAPS):
        shift = k - TAPS // 2
        real = (pixel < area) & (column + shift >= 0) & (column + shift < width)
        total += tl.load(window + k) * tl.load(slopes + base + shift, real, 0.0)
    tl.store(made + base, total, pixel < area)


@triton.jit(do_not_specialize=SIZES)
def compare_backward(
    rows: tl.tensor, rgb: tl.tensor, alpha: tl.tensor, target: tl.tensor, mask: tl.tensor, background: tl.tensor,
    window: tl.tensor, g_l1: tl.tensor, g_ssim: tl.tensor, v_rgb: tl.tensor, v_alpha: tl.tensor, width: tl.tensor,
    height: tl.tensor,
) -> None:  # fmt: skip
    """Blur rows [3, 3, h, w] of `blur_slopes` along columns; fill v_rgb [3, h, w] and v_alpha [h, w] from the gradients
    of the two sums, scalars; program (block of pixels)."""
    area = width * height
    pixel = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    row, inside = pixel // width, pixel < area
    on_l1, on_ssim = tl.load(g_l1), tl.load(g_ssim)
    on_alpha = tl.zeros((BLOCK,), tl.float32)
    for channel in range(3):
        none = tl.zeros((BLOCK,), tl.float32)
        by_m, by_xx, by_xy = none, none, none
        for k in range(TAPS):
            shift = k - TAPS // 2
            real = inside & (row + shift >= 0) & (row + shift < height)
            place, weight = rows + channel * area + pixel + shift * width, tl.load(window + k)
            by_m += weight * tl.load(place, real, 0.0)
            by_xx += weight * tl.load(place + 3 * area, real, 0.0)
            by_xy += weight * tl.load(place + 6 * area, real, 0.0)
        behind = tl.load(background + channel)
        x = _composed(rgb, alpha, behind, pixel + channel * area, pixel, inside)
        y = _composed(target, mask, behind, pixel + channel * area, pixel, inside)
        sign = tl.where(x > y, 1.0, tl.where(x < y, -1.0, 0.0))
        on_x = on_l1 * sign - on_ssim * (by_m + 2 * x * by_xx + y * by_xy)
        tl.store(v_rgb + channel * area + pixel, on_x, inside)
        on_alpha -= on_x * behind
    tl.store(v_alpha + pixel, on_alpha, inside)
