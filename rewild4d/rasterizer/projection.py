"""EWA projection: eight Gaussians at a time, in double precision, to records that the blend reads.

A record, per view and Gaussian, gives alpha = 2 ** (exponent) of a pixel, with d = pixel - centre,
exponent = LOG_OPACITY - t^2 - u^2, t = ALONG_X dx + ALONG_Y dy, u = DOWN dy. A sum of squares has no cancellation,
unlike the expanded form of thin Gaussians. The centre is CENTER + REST, two single numbers, equally exact in the whole
image. The record of an invisible Gaussian is zero. projection_backward.py has the gradient.
"""

import math
from typing import Any

import numpy as np

from rewild4d.kernels.compiling import inlined, kernel
from rewild4d.kernels.doubles import WIDTH, any_gt, floor, load_columns, log2, root, spread, store_columns, where_gt
from rewild4d.rasterizer.conventions import FRUSTUM_MARGIN, MIN_ALPHA, MIN_COMPENSATION

# Columns of a record.
CENTER_X, CENTER_Y, ALONG_X, ALONG_Y, DOWN, LOG_OPACITY, REST_X, REST_Y, RECORD = 0, 1, 2, 3, 4, 5, 6, 7, 8
TILE = 16
"""Side of a tile in pixels."""

HALF_LOG2_E = 0.5 / math.log(2.0)
LOG2_MIN_ALPHA = math.log2(MIN_ALPHA)


@inlined
def dot(a: tuple, b: tuple) -> Any:
    """Return the scalar product of two triples."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@inlined
def mix(x: Any, a: tuple, y: Any, b: tuple) -> tuple:
    """Return the triple x a + y b."""
    return x * a[0] + y * b[0], x * a[1] + y * b[1], x * a[2] + y * b[2]


@inlined
def scaled(x: Any, a: tuple) -> tuple:
    """Return the triple x a."""
    return x * a[0], x * a[1], x * a[2]


@inlined
def added(a: tuple, b: tuple) -> tuple:
    """Return the triple a + b."""
    return a[0] + b[0], a[1] + b[1], a[2] + b[2]


@inlined
def camera_axes(world_to_camera: np.ndarray, view: int) -> tuple:
    """Return the rows of a camera's rotation and its translation."""
    m = world_to_camera[view]
    rows = (m[0, 0], m[0, 1], m[0, 2]), (m[1, 0], m[1, 1], m[1, 2]), (m[2, 0], m[2, 1], m[2, 2])
    return rows, (m[0, 3], m[1, 3], m[2, 3])


@inlined
def pinhole(intrinsics: np.ndarray, view: int) -> tuple:
    """Return the focal lengths and principal point."""
    return intrinsics[view, 0, 0], intrinsics[view, 1, 1], intrinsics[view, 0, 2], intrinsics[view, 1, 2]


@inlined
def unit_quat(quat: tuple) -> tuple:
    """Return the unit quaternion and one over the length."""
    w, x, y, z = quat
    length = root(w * w + x * x + y * y + z * z)
    inverse = 1.0 / where_gt(length, spread(1e-12), length, spread(1e-12))
    return w * inverse, x * inverse, y * inverse, z * inverse, inverse


@inlined
def rotation_columns(w: Any, x: Any, y: Any, z: Any) -> tuple:
    """Return columns of the rotation matrix."""
    return (
        (1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y)),
        (2 * (x * y - w * z), 1 - 2 * (x * x + z * z), 2 * (y * z + w * x)),
        (2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)),
    )


@inlined
def slope_limits(focal: float, center: float, size: int) -> tuple:
    """Return the limits of x / z for the Jacobian, a little outside the frame."""
    margin = FRUSTUM_MARGIN * 0.5 * size / focal
    return spread(-center / focal - margin), spread((size - center) / focal + margin)


@inlined
def clamp(value: Any, limits: tuple) -> Any:
    """Clamp the value between two limits."""
    low, high = limits
    value = where_gt(low, value, low, value)
    return where_gt(value, high, high, value)


@inlined
def image_axes(linear_x: tuple, linear_y: tuple, axes: tuple, scales: tuple) -> tuple:
    """Return the Gaussian's half axes in the image, rows of three: covariance = rows times their transpose."""
    a, b, c = scales
    row_x = dot(linear_x, axes[0]) * a, dot(linear_x, axes[1]) * b, dot(linear_x, axes[2]) * c
    row_y = dot(linear_y, axes[0]) * a, dot(linear_y, axes[1]) * b, dot(linear_y, axes[2]) * c
    return row_x, row_y


@inlined
def factor(xx: Any, xy: Any, yy: Any, det: Any) -> tuple:
    """Return the triangular factor of the inverse covariance, times log2(e) / 2."""
    along_x = root(HALF_LOG2_E * yy / det)
    return along_x, (0.0 - along_x) * xy / yy, root(HALF_LOG2_E / yy)


@inlined
def _in_two(value: Any) -> tuple:
    """Split a value into its single precision and the rest (Dekker 1971)."""
    shifted = value * 536870913.0  # 2^29 + 1: 53 digits less 24
    high = shifted - (shifted - value)
    return high, value - high


@inlined
def _shown(
    opacity: Any, det: Any, z: Any, near: float, u: Any, v: Any, extent_x: Any, extent_y: Any, size: tuple
) -> Any:
    """Return one where a Gaussian can be seen, zero elsewhere."""
    zero = spread(0.0)
    shown = where_gt(opacity, spread(MIN_ALPHA), where_gt(det, zero, spread(1.0), zero), zero)
    shown = where_gt(z, spread(near), shown, zero)
    shown = where_gt(u + extent_x, zero, where_gt(spread(float(size[0])), u - extent_x, shown, zero), zero)
    return where_gt(v + extent_y, zero, where_gt(spread(float(size[1])), v - extent_y, shown, zero), zero)


@inlined
def _tile_span(shown: Any, center: Any, extent: Any, size: int) -> tuple:
    """Return the first and one past the last tile, along one axis, with a pixel centre in the extent; equal if none."""
    zero, last = spread(0.0), spread(float(-(-size // TILE) * TILE - 1))
    half = extent * 1.0001
    first = 0.0 - floor(half - center + 0.5)
    first = where_gt(zero, first, zero, first)
    end = floor(center + half - 0.5)
    end = where_gt(end, last, last, end)
    shown = where_gt(first, end, zero, shown)
    first, end = floor(first * (1 / TILE)), floor(end * (1 / TILE)) + 1.0
    return where_gt(shown, zero, first, zero), where_gt(shown, zero, end, zero)


@inlined
def _number_slots(view: int, begin: int, end: int, count: int, tiles: np.ndarray, slots: np.ndarray) -> int:
    """Number the (Gaussian, tile) pairs of begin..end in one view from 0; return their number."""
    number = 0
    for n in range(begin, end):
        slots[view * (count + 1) + n] = number
        place = 4 * (view * count + n)
        wide, high = tiles[place + 1] - tiles[place], tiles[place + 3] - tiles[place + 2]
        number += int(wide * high)
    return number


@kernel
def project(
    begin: int, end: int, gaussians: tuple, cameras: tuple, options: tuple, means2d: np.ndarray, records: np.ndarray,
    radii: np.ndarray, depths: np.ndarray, tiles: np.ndarray, slots: np.ndarray, totals: np.ndarray,
) -> None:  # fmt: skip
    """Fill means2d [V, N, 2], records [V, N, 8], radii, depths [V, N] and tiles [V, N, 4] for Gaussians begin..end.

    At least eight of them. ``gaussians`` are means, quats, scales and opacities, ``cameras`` world_to_camera and
    intrinsics, ``options`` width, height, eps2d, antialias and near. A row of tiles holds the first and one past the
    last column and row of a Gaussian's bounding rectangle; slots [V, N + 1] numbers the tiles of these rectangles from
    0 in each view, and totals [V] is their number. All arrays but the cameras' are flat.
    """
    means, quats, scales, opacities = gaussians
    world_to_camera, intrinsics = cameras
    width, height, eps2d, antialias, near = options
    views, zero = world_to_camera.shape[0], spread(0.0)
    count = len(opacities)
    for start in range(begin, end, WIDTH):
        n = min(start, end - WIDTH)  # the last eight overlap those before
        mean, scale = load_columns(means, 3 * n, 3), load_columns(scales, 3 * n, 3)
        (opacity,) = load_columns(opacities, n, 1)
        w, x, y, z, _ = unit_quat(load_columns(quats, 4 * n, 4))
        axes = rotation_columns(w, x, y, z)
        for view in range(views):
            rows, move = camera_axes(world_to_camera, view)
            fx, fy, cx, cy = pinhole(intrinsics, view)
            z = dot(rows[2], mean) + move[2]
            near_by = 1.0 / z
            slope_x, slope_y = (dot(rows[0], mean) + move[0]) * near_by, (dot(rows[1], mean) + move[1]) * near_by
            u, v = fx * slope_x + cx, fy * slope_y + cy
            direct_x, direct_y = fx * near_by, fy * near_by
            linear_x = mix(direct_x, rows[0], direct_x * (0.0 - clamp(slope_x, slope_limits(fx, cx, width))), rows[2])
            linear_y = mix(direct_y, rows[1], direct_y * (0.0 - clamp(slope_y, slope_limits(fy, cy, height))), rows[2])
            half_x, half_y = image_axes(linear_x, linear_y, axes, scale)
            raw_xx, xy, raw_yy = dot(half_x, half_x), dot(half_x, half_y), dot(half_y, half_y)
            xx, yy = raw_xx + eps2d, raw_yy + eps2d
            det = xx * yy - xy * xy
            drawn = opacity
            if antialias:
                share = (raw_xx * raw_yy - xy * xy) / det
                drawn = opacity * root(where_gt(share, spread(MIN_COMPENSATION), share, spread(MIN_COMPENSATION)))
            log_opacity = log2(drawn)
            support = (log_opacity - LOG2_MIN_ALPHA) * (1 / HALF_LOG2_E)
            extent_x, extent_y = root(support * xx), root(support * yy)
            shown = _shown(drawn, det, z, near, u, v, extent_x, extent_y, (width, height))
            center_x, center_y = where_gt(z, spread(near), u, zero), where_gt(z, spread(near), v, zero)
            row = view * count + n
            store_columns(means2d, 2 * row, (center_x, center_y))
            if any_gt(shown, zero):
                spread_xy = 0.5 * (xx - yy)
                radius = root(support * (0.5 * (xx + yy) + root(spread_xy * spread_xy + xy * xy)))
                along_x, along_y, down = factor(xx, xy, yy, det)
                left, right = _tile_span(shown, u, extent_x, width)
                top, bottom = _tile_span(shown, v, extent_y, height)
                store_columns(tiles, 4 * row, (left, right, top, bottom))
                store_columns(radii, row, (where_gt(shown, zero, radius, zero),))
                store_columns(depths, row, (where_gt(shown, zero, z, zero),))
                high_u, rest_u = _in_two(where_gt(shown, zero, u, zero))
                high_v, rest_v = _in_two(where_gt(shown, zero, v, zero))
                store_columns(records, RECORD * row, (
                    high_u, high_v,
                    where_gt(shown, zero, along_x, zero), where_gt(shown, zero, along_y, zero),
                    where_gt(shown, zero, down, zero), where_gt(shown, zero, log_opacity, zero),
                    rest_u, rest_v,
                ))  # fmt: skip
            else:
                store_columns(tiles, 4 * row, (zero, zero, zero, zero))
                store_columns(radii, row, (zero,))
                store_columns(depths, row, (zero,))
                store_columns(records, RECORD * row, (zero, zero, zero, zero, zero, zero, zero, zero))
    for view in range(views):
        totals[view] = _number_slots(view, begin, end, count, tiles, slots)
