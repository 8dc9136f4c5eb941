"""EWA projection and its gradient as Triton kernels, a lane a Gaussian, in double precision as on the CPU.

The formulas are those of projection.py and projection_backward.py: t = ALONG_X dx + ALONG_Y dy, u = DOWN dy,
exponent = LOG_OPACITY - t^2 - u^2. A record has these four columns; in its gradient they are the sums of dL/dexponent
times t^2, t u, u^2 and one.
"""

import triton
import triton.language as tl

from rewild4d.rasterizer import conventions, projection
from rewild4d.rasterizer.checks import MOST_FEATURE
from rewild4d.rasterizer.triton_blend import SIDE

BLOCK = tl.constexpr(64)
RECORD = tl.constexpr(4)
CAMERA = tl.constexpr(16)
"""Numbers of a camera's gradient: the upper three rows of world_to_camera, then fx, fy, cx, cy."""
UNUSABLE = tl.constexpr(1 << 30)
"""Number of tiles that marks a Gaussian with invalid input."""
DEPTH_BITS = tl.constexpr(40)
"""Of a sorting key, below the tile: exponent and 29 bits of the depth's mantissa."""

_HALF_LOG2_E = tl.constexpr(projection.HALF_LOG2_E)
_WEAKEST = tl.constexpr(projection.LOG2_MIN_ALPHA)
_MIN_ALPHA = tl.constexpr(conventions.MIN_ALPHA)
_MARGIN = tl.constexpr(conventions.FRUSTUM_MARGIN)
_FLOOR = tl.constexpr(conventions.MIN_COMPENSATION)
_MOST_FEATURE = tl.constexpr(MOST_FEATURE)

SIZES = ["width", "height", "across", "down", "views", "count", "channels"]


@triton.jit
def _row(pointer: tl.tensor, place: tl.tensor, real: tl.tensor) -> tuple:
    """Load three numbers from an address on, in double precision."""
    return (
        tl.load(pointer + place, real, 0.0).to(tl.float64),
        tl.load(pointer + place + 1, real, 0.0).to(tl.float64),
        tl.load(pointer + place + 2, real, 0.0).to(tl.float64),
    )


@triton.jit
def _unit_quat(quats: tl.tensor, n: tl.tensor, real: tl.tensor) -> tuple:
    """Return the unit quaternion and one over the length."""
    w = tl.load(quats + 4 * n, real, 1.0).to(tl.float64)
    x, y, z = _row(quats, 4 * n + 1, real)
    inverse = 1.0 / tl.maximum(tl.sqrt(w * w + x * x + y * y + z * z), 1e-12)
    return w * inverse, x * inverse, y * inverse, z * inverse, inverse


@triton.jit
def _axes(w: tl.tensor, x: tl.tensor, y: tl.tensor, z: tl.tensor) -> tuple:
    """Return the rotation matrix, column by column."""
    return (
        1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y),
        2 * (x * y - w * z), 1 - 2 * (x * x + z * z), 2 * (y * z + w * x),
        2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y),
    )  # fmt: skip


@triton.jit
def _camera_row(world_to_camera: tl.tensor, view: tl.tensor, row: tl.constexpr) -> tuple:
    """Return a row of a camera's matrix."""
    place = world_to_camera + view * 16 + row * 4
    return (
        tl.load(place).to(tl.float64), tl.load(place + 1).to(tl.float64),
        tl.load(place + 2).to(tl.float64), tl.load(place + 3).to(tl.float64),
    )  # fmt: skip


@triton.jit
def _pinhole(intrinsics: tl.tensor, view: tl.tensor, axis: tl.constexpr) -> tuple:
    """Return the focal length and principal point along one image axis."""
    place = intrinsics + view * 9 + axis * 3
    return tl.load(place + axis).to(tl.float64), tl.load(place + 2).to(tl.float64)


@triton.jit
def _tangent(slope: tl.tensor, focal: tl.tensor, center: tl.tensor, size: tl.tensor) -> tuple:
    """Return the slope for the Jacobian, at most a little outside the frame, and whether it is the true slope."""
    margin = size * (0.5 * _MARGIN) / focal
    low, high = -center / focal - margin, (size - center) / focal + margin
    return tl.minimum(tl.maximum(slope, low), high), (slope > low) & (slope < high)


@triton.jit
def _factor(xx: tl.tensor, xy: tl.tensor, yy: tl.tensor, det: tl.tensor) -> tuple:
    """Return the triangular factor of the inverse covariance, times log2(e) / 2."""
    along_x = tl.sqrt(yy * _HALF_LOG2_E / det)
    return along_x, -along_x * xy / yy, tl.sqrt(1.0 / yy * _HALF_LOG2_E)


@triton.jit
def _span(center: tl.tensor, extent: tl.tensor, size: tl.tensor) -> tuple:
    """Return the first and last pixel along an axis whose centre lies in the extent, with a margin for rounding."""
    half = extent * 1.0001
    return tl.maximum(tl.ceil(center - half - 0.5), 0.0), tl.minimum(tl.floor(center + half - 0.5), size - 1.0)


@triton.jit
def _flaw_of_camera(
    world_to_camera: tl.tensor, intrinsics: tl.tensor, background: tl.tensor, view: tl.tensor, channels: tl.tensor
) -> tl.tensor:
    """Return 0 if a view's numbers, pinhole and background are valid (see checks.py), else NaN."""
    lane = tl.arange(0, 16)
    total = tl.sum(tl.load(world_to_camera + view * 16 + lane).to(tl.float64))
    k = intrinsics + view * 9
    total += tl.sum(tl.load(k + lane, lane < 9, 0.0).to(tl.float64))
    sound = (total - total == 0) & (tl.load(k) > 0) & (tl.load(k + 4) > 0) & (tl.load(k + 8) == 1)
    sound &= (tl.load(k + 1) == 0) & (tl.load(k + 3) == 0) & (tl.load(k + 6) == 0) & (tl.load(k + 7) == 0)
    for channel in range(channels):
        sound &= tl.abs(tl.load(background + view * channels + channel)) <= _MOST_FEATURE
    return tl.where(sound, 0.0, float("nan"))


@triton.jit
def _store_in_two(high: tl.tensor, low: tl.tensor, value: tl.tensor, real: tl.tensor) -> None:
    """Store a number in single precision, and the rest, 0 above 1e30."""
    rounded = value.to(tl.float32)
    tl.store(high, rounded, real)
    tl.store(low, tl.where(tl.abs(value) < 1e30, value - rounded.to(tl.float64), 0.0).to(tl.float32), real)


@triton.jit(do_not_specialize=[*SIZES, "eps2d", "near"])
def project(
    means: tl.tensor, quats: tl.tensor, scales: tl.tensor, opacities: tl.tensor, world_to_camera: tl.tensor,
    intrinsics: tl.tensor, features: tl.tensor, background: tl.tensor, means2d: tl.tensor, rests: tl.tensor,
    records: tl.tensor, radii: tl.tensor, keys: tl.tensor, wides: tl.tensor, tiles: tl.tensor, width: tl.tensor,
    height: tl.tensor, across: tl.tensor, down: tl.tensor, count: tl.tensor, channels: tl.tensor, eps2d: tl.tensor,
    near: tl.tensor, ANTIALIAS: tl.constexpr,
) -> None:  # fmt: skip
    """Fill means2d, rests [V, N, 2], records [V, N, 4], radii [V, N] and what lists the tiles; program (block, view).

    A centre is means2d + rests, more exact than single precision. Keys [V, N] sort by tile, then depth, and are those
    of the first tile of each bounding rectangle. The rectangle is wides [V, N] tiles across and has tiles [V, N] in
    all, 0 if nothing is drawn, `UNUSABLE` if the Gaussian or, for the first block, the view's input is invalid.
    """
    n, view = tl.program_id(0).to(tl.int64) * BLOCK + tl.arange(0, BLOCK), tl.program_id(1)
    real = n < count
    x, y, z = _row(means, 3 * n, real)
    r00, r01, r02, t0 = _camera_row(world_to_camera, view, 0)
    r10, r11, r12, t1 = _camera_row(world_to_camera, view, 1)
    r20, r21, r22, t2 = _camera_row(world_to_camera, view, 2)
    fx, cx = _pinhole(intrinsics, view, 0)
    fy, cy = _pinhole(intrinsics, view, 1)
    depth = r20 * x + r21 * y + r22 * z + t2
    ahead = depth > near
    by = 1.0 / tl.where(ahead, depth, 1.0)
    slope_x, slope_y = (r00 * x + r01 * y + r02 * z + t0) * by, (r10 * x + r11 * y + r12 * z + t1) * by
    u, v = fx * slope_x + cx, fy * slope_y + cy
    tangent_x, _ = _tangent(slope_x, fx, cx, width)
    tangent_y, _ = _tangent(slope_y, fy, cy, height)
    jx, jy = fx * by, fy * by
    px, py, pz = jx * (r00 - tangent_x * r20), jx * (r01 - tangent_x * r21), jx * (r02 - tangent_x * r22)
    qx, qy, qz = jy * (r10 - tangent_y * r20), jy * (r11 - tangent_y * r21), jy * (r12 - tangent_y * r22)
    quat_w, quat_x, quat_y, quat_z, _ = _unit_quat(quats, n, real)
    a0, a1, a2, b0, b1, b2, c0, c1, c2 = _axes(quat_w, quat_x, quat_y, quat_z)
    sa, sb, sc = _row(scales, 3 * n, real)
    xa, xb = (px * a0 + py * a1 + pz * a2) * sa, (px * b0 + py * b1 + pz * b2) * sb
    ya, yb = (qx * a0 + qy * a1 + qz * a2) * sa, (qx * b0 + qy * b1 + qz * b2) * sb
    xc, yc = (px * c0 + py * c1 + pz * c2) * sc, (qx * c0 + qy * c1 + qz * c2) * sc
    raw_xx, xy, raw_yy = xa * xa + xb * xb + xc * xc, xa * ya + xb * yb + xc * yc, ya * ya + yb * yb + yc * yc
    xx, yy = raw_xx + eps2d, raw_yy + eps2d
    det = xx * yy - xy * xy
    drawn = tl.load(opacities + n, real, 0.0).to(tl.float64)
    whole = x + y + z + quat_w + quat_x + quat_y + quat_z + sa + sb + sc + drawn
    if tl.program_id(0) == 0:
        whole += _flaw_of_camera(world_to_camera, intrinsics, background, view, channels)
    usable = whole - whole == 0
    if view == 0:
        for channel in range(channels):
            usable &= tl.abs(tl.load(features + n * channels + channel, real, 0.0)) <= _MOST_FEATURE
    sound = real & ahead & (det > 0)
    if ANTIALIAS:
        drawn *= tl.sqrt(tl.maximum((raw_xx * raw_yy - xy * xy) / tl.where(sound, det, 1.0), _FLOOR))
    sound &= drawn > _MIN_ALPHA
    top = tl.log2(tl.where(sound, drawn, 1.0))
    support = tl.maximum(top - _WEAKEST, 0.0) / _HALF_LOG2_E
    extent_x, extent_y = tl.sqrt(support * tl.where(sound, xx, 1.0)), tl.sqrt(support * tl.where(sound, yy, 1.0))
    sound &= (u + extent_x > 0) & (u - extent_x < width) & (v + extent_y > 0) & (v - extent_y < height)
    half = 0.5 * (xx - yy)
    radius = tl.sqrt(tl.where(sound, support * (0.5 * (xx + yy) + tl.sqrt(half * half + xy * xy)), 0.0))
    along_x, along_y, fall = _factor(
        tl.where(sound, xx, 1.0), tl.where(sound, xy, 0.0), tl.where(sound, yy, 1.0), tl.where(sound, det, 1.0)
    )
    row = view * count + n
    _store_in_two(means2d + 2 * row, rests + 2 * row, tl.where(ahead, u, 0.0), real)
    _store_in_two(means2d + 2 * row + 1, rests + 2 * row + 1, tl.where(ahead, v, 0.0), real)
    tl.store(radii + row, radius.to(tl.float32), real)
    tl.store(records + row * RECORD, along_x.to(tl.float32), real)
    tl.store(records + row * RECORD + 1, along_y.to(tl.float32), real)
    tl.store(records + row * RECORD + 2, fall.to(tl.float32), real)
    tl.store(records + row * RECORD + 3, top.to(tl.float32), real)
    left, right = _span(tl.where(sound, u, 0.0), extent_x, width)
    upper, lower = _span(tl.where(sound, v, 0.0), extent_y, height)
    sound &= (left <= right) & (upper <= lower)
    left, upper = left.to(tl.int32) // SIDE, upper.to(tl.int32) // SIDE
    wide, high = right.to(tl.int32) // SIDE - left + 1, lower.to(tl.int32) // SIDE - upper + 1
    tile = ((view * down + upper) * across + left).to(tl.int64)
    near_first = tl.where(ahead, depth, 1.0).to(tl.int64, bitcast=True) >> (63 - DEPTH_BITS)
    tl.store(keys + row, (tile << DEPTH_BITS) + near_first, real)
    tl.store(wides + row, wide, real)
    tl.store(tiles + row, tl.where(usable, tl.where(sound, wide * high, 0), UNUSABLE), real)


@triton.jit
def _store_row(pointer: tl.tensor, place: tl.tensor, x: tl.tensor, y: tl.tensor, z: tl.tensor, real: tl.tensor) -> None:
    tl.store(pointer + place, x.to(tl.float32), real)
    tl.store(pointer + place + 1, y.to(tl.float32), real)
    tl.store(pointer + place + 2, z.to(tl.float32), real)


@triton.jit(do_not_specialize=[*SIZES, "eps2d"])
def project_backward(
    means: tl.tensor, quats: tl.tensor, scales: tl.tensor, opacities: tl.tensor, world_to_camera: tl.tensor,
    intrinsics: tl.tensor, radii: tl.tensor, g_means2d: tl.tensor, g_records: tl.tensor, v_means: tl.tensor,
    v_quats: tl.tensor, v_scales: tl.tensor, v_opacities: tl.tensor, v_cameras: tl.tensor, width: tl.tensor,
    height: tl.tensor, views: tl.tensor, count: tl.tensor, eps2d: tl.tensor, ANTIALIAS: tl.constexpr,
    CAMERAS: tl.constexpr,
) -> None:  # fmt: skip
    """Fill the v_ arrays; program (block). v_cameras [blocks, V, 16], in double precision, only with CAMERAS."""
    n = tl.program_id(0).to(tl.int64) * BLOCK + tl.arange(0, BLOCK)
    real = n < count
    x, y, z = _row(means, 3 * n, real)
    quat_w, quat_x, quat_y, quat_z, inverse = _unit_quat(quats, n, real)
    a0, a1, a2, b0, b1, b2, c0, c1, c2 = _axes(quat_w, quat_x, quat_y, quat_z)
    sa, sb, sc = _row(scales, 3 * n, real)
    none = tl.zeros((BLOCK,), tl.float64)
    v_x, v_y, v_z, v_log = none, none, none, none
    v_a0, v_a1, v_a2, v_b0, v_b1, v_b2, v_c0, v_c1, v_c2 = none, none, none, none, none, none, none, none, none
    for view in range(views):
        row = view * count + n
        shown = tl.load(radii + row, real, 0.0) > 0
        r00, r01, r02, t0 = _camera_row(world_to_camera, view, 0)
        r10, r11, r12, t1 = _camera_row(world_to_camera, view, 1)
        r20, r21, r22, t2 = _camera_row(world_to_camera, view, 2)
        fx, cx = _pinhole(intrinsics, view, 0)
        fy, cy = _pinhole(intrinsics, view, 1)
        by = 1.0 / tl.where(shown, r20 * x + r21 * y + r22 * z + t2, 1.0)
        slope_x, slope_y = (r00 * x + r01 * y + r02 * z + t0) * by, (r10 * x + r11 * y + r12 * z + t1) * by
        tangent_x, free_x = _tangent(slope_x, fx, cx, width)
        tangent_y, free_y = _tangent(slope_y, fy, cy, height)
        jx, jy = fx * by, fy * by
        px, py, pz = jx * (r00 - tangent_x * r20), jx * (r01 - tangent_x * r21), jx * (r02 - tangent_x * r22)
        qx, qy, qz = jy * (r10 - tangent_y * r20), jy * (r11 - tangent_y * r21), jy * (r12 - tangent_y * r22)
        xa, xb = (px * a0 + py * a1 + pz * a2) * sa, (px * b0 + py * b1 + pz * b2) * sb
        ya, yb = (qx * a0 + qy * a1 + qz * a2) * sa, (qx * b0 + qy * b1 + qz * b2) * sb
        xc, yc = (px * c0 + py * c1 + pz * c2) * sc, (qx * c0 + qy * c1 + qz * c2) * sc
        # invisible Gaussians get a valid covariance and no gradient
        raw_xx = tl.where(shown, xa * xa + xb * xb + xc * xc, 1.0)
        raw_yy = tl.where(shown, ya * ya + yb * yb + yc * yc, 1.0)
        xy = tl.where(shown, xa * ya + xb * yb + xc * yc, 0.0)
        g_tt, g_tu, g_uu = _row(g_records, row * RECORD, shown)
        g_log = tl.load(g_records + row * RECORD + 3, shown, 0.0).to(tl.float64)
        g_u = tl.load(g_means2d + 2 * row, shown, 0.0).to(tl.float64)
        g_v = tl.load(g_means2d + 2 * row + 1, shown, 0.0).to(tl.float64)
        v_log += g_log
        xx, yy = raw_xx + eps2d, raw_yy + eps2d
        det = xx * yy - xy * xy
        a, b, c = _factor(xx, xy, yy, det)
        v_xx = a * a * g_tt / _HALF_LOG2_E
        v_xy = 2 * a * (b * g_tt + c * g_tu) / _HALF_LOG2_E
        v_yy = (b * b * g_tt + 2 * b * c * g_tu + c * c * g_uu) / _HALF_LOG2_E
        if ANTIALIAS:
            raw_det = raw_xx * raw_yy - xy * xy
            thick = raw_det > det * _FLOOR
            h, raw_inverse = tl.where(thick, g_log * _HALF_LOG2_E, 0.0), 1.0 / tl.where(thick, raw_det, 1.0)
            v_xx += h * (raw_yy * raw_inverse - yy / det)
            v_xy += 2 * h * xy * (1.0 / det - raw_inverse)
            v_yy += h * (raw_xx * raw_inverse - xx / det)
        v_xa, v_xb, v_xc = 2 * v_xx * xa + v_xy * ya, 2 * v_xx * xb + v_xy * yb, 2 * v_xx * xc + v_xy * yc
        v_ya, v_yb, v_yc = v_xy * xa + 2 * v_yy * ya, v_xy * xb + 2 * v_yy * yb, v_xy * xc + 2 * v_yy * yc
        v_a0, v_a1, v_a2 = v_a0 + v_xa * px + v_ya * qx, v_a1 + v_xa * py + v_ya * qy, v_a2 + v_xa * pz + v_ya * qz
        v_b0, v_b1, v_b2 = v_b0 + v_xb * px + v_yb * qx, v_b1 + v_xb * py + v_yb * qy, v_b2 + v_xb * pz + v_yb * qz
        v_c0, v_c1, v_c2 = v_c0 + v_xc * px + v_yc * qx, v_c1 + v_xc * py + v_yc * qy, v_c2 + v_xc * pz + v_yc * qz
        v_xa, v_xb, v_xc, v_ya, v_yb, v_yc = v_xa * sa, v_xb * sb, v_xc * sc, v_ya * sa, v_yb * sb, v_yc * sc
        v_p0, v_q0 = v_xa * a0 + v_xb * b0 + v_xc * c0, v_ya * a0 + v_yb * b0 + v_yc * c0
        v_p1, v_q1 = v_xa * a1 + v_xb * b1 + v_xc * c1, v_ya * a1 + v_yb * b1 + v_yc * c1
        v_p2, v_q2 = v_xa * a2 + v_xb * b2 + v_xc * c2, v_ya * a2 + v_yb * b2 + v_yc * c2
        # the Jacobian's rows are (jx, -jx tangent) along the camera's x and z
        direct_x, depth_x = v_p0 * r00 + v_p1 * r01 + v_p2 * r02, v_p0 * r20 + v_p1 * r21 + v_p2 * r22
        direct_y, depth_y = v_q0 * r10 + v_q1 * r11 + v_q2 * r12, v_q0 * r20 + v_q1 * r21 + v_q2 * r22
        rest_x, rest_y = direct_x - depth_x * tangent_x, direct_y - depth_y * tangent_y
        v_slope_x = fx * (g_u - tl.where(free_x, depth_x, 0.0) * by)
        v_slope_y = fy * (g_v - tl.where(free_y, depth_y, 0.0) * by)
        local_x, local_y = v_slope_x * by, v_slope_y * by
        local_z = -(rest_x * jx + rest_y * jy + v_slope_x * slope_x + v_slope_y * slope_y) * by
        v_x += local_x * r00 + local_y * r10 + local_z * r20
        v_y += local_x * r01 + local_y * r11 + local_z * r21
        v_z += local_x * r02 + local_y * r12 + local_z * r22
        if CAMERAS:
            place = v_cameras + (tl.program_id(0) * views + view) * CAMERA
            jz_x, jz_y = -jx * tangent_x, -jy * tangent_y
            tl.store(place, tl.sum(local_x * x + jx * v_p0))
            tl.store(place + 1, tl.sum(local_x * y + jx * v_p1))
            tl.store(place + 2, tl.sum(local_x * z + jx * v_p2))
            tl.store(place + 3, tl.sum(local_x))
            tl.store(place + 4, tl.sum(local_y * x + jy * v_q0))
            tl.store(place + 5, tl.sum(local_y * y + jy * v_q1))
            tl.store(place + 6, tl.sum(local_y * z + jy * v_q2))
            tl.store(place + 7, tl.sum(local_y))
            tl.store(place + 8, tl.sum(local_z * x + jz_x * v_p0 + jz_y * v_q0))
            tl.store(place + 9, tl.sum(local_z * y + jz_x * v_p1 + jz_y * v_q1))
            tl.store(place + 10, tl.sum(local_z * z + jz_x * v_p2 + jz_y * v_q2))
            tl.store(place + 11, tl.sum(local_z))
            tl.store(place + 12, tl.sum(g_u * slope_x + rest_x * by))
            tl.store(place + 13, tl.sum(g_v * slope_y + rest_y * by))
            tl.store(place + 14, tl.sum(g_u))
            tl.store(place + 15, tl.sum(g_v))
    opacity = tl.load(opacities + n, real, 0.0).to(tl.float64)
    v_opacity = tl.where(opacity > 0, v_log * (2 * _HALF_LOG2_E) / tl.where(opacity > 0, opacity, 1.0), 0.0)
    tl.store(v_opacities + n, v_opacity.to(tl.float32), real)
    _store_row(v_means, 3 * n, v_x, v_y, v_z, real)
    _store_row(
        v_scales, 3 * n, v_a0 * a0 + v_a1 * a1 + v_a2 * a2, v_b0 * b0 + v_b1 * b1 + v_b2 * b2,
        v_c0 * c0 + v_c1 * c1 + v_c2 * c2, real,
    )  # fmt: skip
    v_a0, v_a1, v_a2, v_b0, v_b1, v_b2 = v_a0 * sa, v_a1 * sa, v_a2 * sa, v_b0 * sb, v_b1 * sb, v_b2 * sb
    v_c0, v_c1, v_c2 = v_c0 * sc, v_c1 * sc, v_c2 * sc
    w, i, j, k = quat_w, quat_x, quat_y, quat_z
    v_w = 2 * (k * (v_a1 - v_b0) + j * (v_c0 - v_a2) + i * (v_b2 - v_c1))
    v_i = 2 * (j * (v_a1 + v_b0) + k * (v_a2 + v_c0) + w * (v_b2 - v_c1) - 2 * i * (v_b1 + v_c2))
    v_j = 2 * (i * (v_a1 + v_b0) + k * (v_b2 + v_c1) + w * (v_c0 - v_a2) - 2 * j * (v_a0 + v_c2))
    v_k = 2 * (i * (v_a2 + v_c0) + j * (v_b2 + v_c1) + w * (v_a1 - v_b0) - 2 * k * (v_a0 + v_b1))
    along = w * v_w + i * v_i + j * v_j + k * v_k
    tl.store(v_quats + 4 * n, ((v_w - along * w) * inverse).to(tl.float32), real)
    _store_row(
        v_quats, 4 * n + 1, (v_i - along * i) * inverse, (v_j - along * j) * inverse, (v_k - along * k) * inverse, real
    )
