"""The gradient of projection, eight Gaussians at a time, in double precision.

The gradient of a record holds, in its columns TT, TU and UU, the sums of dL/dexponent times t^2, t u and u^2.
"""

from typing import Any

import numpy as np

from rewild4d.kernels.compiling import inlined, kernel
from rewild4d.kernels.doubles import WIDTH, any_gt, lane_numbers, load_columns, spread, store_columns, where_gt
from rewild4d.rasterizer.conventions import MIN_COMPENSATION
from rewild4d.rasterizer.projection import (
    HALF_LOG2_E,
    LOG_OPACITY,
    RECORD,
    added,
    camera_axes,
    clamp,
    dot,
    factor,
    image_axes,
    mix,
    pinhole,
    rotation_columns,
    scaled,
    slope_limits,
    unit_quat,
)

# Columns of a record's gradient, beside LOG_OPACITY.
TT, TU, UU = 2, 3, 4
CAMERA = 16
"""Numbers of a camera's gradient: the upper three rows of world_to_camera, then fx, fy, cx, cy."""
CHUNK = 1024
"""Gaussians in a unit of work; the camera's gradient is summed by these for any number of threads."""


@inlined
def _covariance_gradient(
    raw_xx: Any, xy: Any, raw_yy: Any, eps2d: float, antialias: bool, g_tt: Any, g_tu: Any, g_uu: Any, g_log: Any
) -> tuple:
    """Return the gradient of the projected covariance (xx, xy, yy) from that of a record."""
    xx, yy = raw_xx + eps2d, raw_yy + eps2d
    det = xx * yy - xy * xy
    a, b, c = factor(xx, xy, yy, det)
    k = 1 / HALF_LOG2_E
    v_xx = k * a * a * g_tt
    v_xy = 2 * k * a * (b * g_tt + c * g_tu)
    v_yy = k * (b * b * g_tt + 2 * b * c * g_tu + c * c * g_uu)
    if antialias:
        raw_det = raw_xx * raw_yy - xy * xy
        zero = spread(0.0)
        h = where_gt(raw_det, MIN_COMPENSATION * det, HALF_LOG2_E * g_log, zero)
        raw_inverse = where_gt(raw_det, MIN_COMPENSATION * det, 1.0 / raw_det, zero)
        inverse = 1.0 / det
        v_xx = v_xx + h * (raw_yy * raw_inverse - yy * inverse)
        v_xy = v_xy + 2 * h * xy * (inverse - raw_inverse)
        v_yy = v_yy + h * (raw_xx * raw_inverse - xx * inverse)
    return v_xx, v_xy, v_yy


@inlined
def _rotation_gradient(quat: tuple, a: tuple, b: tuple, c: tuple) -> tuple:
    """Return the gradient of the raw quaternion from that of the rotation's three columns."""
    w, x, y, z, inverse = quat
    v_w = 2 * (z * (a[1] - b[0]) + y * (c[0] - a[2]) + x * (b[2] - c[1]))
    v_x = 2 * (y * (a[1] + b[0]) + z * (a[2] + c[0]) + w * (b[2] - c[1]) - 2 * x * (b[1] + c[2]))
    v_y = 2 * (x * (a[1] + b[0]) + z * (b[2] + c[1]) + w * (c[0] - a[2]) - 2 * y * (a[0] + c[2]))
    v_z = 2 * (x * (a[2] + c[0]) + y * (b[2] + c[1]) + w * (a[1] - b[0]) - 2 * z * (a[0] + b[1]))
    along = w * v_w + x * v_x + y * v_y + z * v_z
    return (
        (v_w - along * w) * inverse,
        (v_x - along * x) * inverse,
        (v_y - along * y) * inverse,
        (v_z - along * z) * inverse,
    )


@inlined
def _pinhole_gradient(
    slope: Any, near_by: Any, focal: float, limits: tuple, g_center: Any, g_direct: Any, g_depth: Any
) -> tuple:
    """Return gradients of (x / z, z, focal) along one axis from those of the centre and the Jacobian's entries."""
    tangent = clamp(slope, limits)
    inside = where_gt(slope, limits[0], where_gt(limits[1], slope, g_depth, spread(0.0)), spread(0.0))
    g_slope = focal * (g_center - inside * near_by)
    rest = g_direct - g_depth * tangent
    return g_slope, (0.0 - rest) * focal * near_by * near_by, g_center * slope + rest * near_by


@inlined
def _add(sums: np.ndarray, place: int, value: Any) -> None:
    store_columns(sums, place, (load_columns(sums, place, 1)[0] + value,))


@inlined
def _add_camera(
    sums: np.ndarray, view: int, fresh: Any, mean: tuple, local: tuple, jacobian: tuple, v_linear_x: tuple,
    v_linear_y: tuple, v_focal: tuple, g_center: tuple,
) -> None:  # fmt: skip
    """Add eight Gaussians' shares to a camera's gradient; lanes with fresh = 0 were counted before."""
    direct_x, depth_x, direct_y, depth_y = jacobian
    place = view * CAMERA * WIDTH
    for i in range(3):
        m, x, y = mean[i], v_linear_x[i], v_linear_y[i]
        _add(sums, place + i * WIDTH, fresh * (local[0] * m + direct_x * x))
        _add(sums, place + (4 + i) * WIDTH, fresh * (local[1] * m + direct_y * y))
        _add(sums, place + (8 + i) * WIDTH, fresh * (local[2] * m + depth_x * x + depth_y * y))
        _add(sums, place + (4 * i + 3) * WIDTH, fresh * local[i])
    for i in range(2):
        _add(sums, place + (12 + i) * WIDTH, fresh * v_focal[i])
        _add(sums, place + (14 + i) * WIDTH, fresh * g_center[i])


@kernel
def project_backward(
    begin: int, end: int, gaussians: tuple, cameras: tuple, options: tuple, with_cameras: bool, radii: np.ndarray,
    g_means2d: np.ndarray, g_records: np.ndarray, v_gaussians: tuple, v_cameras: np.ndarray,
) -> None:  # fmt: skip
    """Fill v_gaussians for Gaussians begin..end, at least eight; add to this chunk's own zeroed v_cameras.

    v_cameras is [V, 16, 8], double precision, to be summed over the last axis; it is used only with_cameras. All arrays
    but the cameras are flat; the first arguments are those of `project`.
    """
    means, quats, scales, opacities = gaussians
    world_to_camera, intrinsics = cameras
    width, height, eps2d, antialias, _ = options
    v_means, v_quats, v_scales, v_opacities = v_gaussians
    zero, count = spread(0.0), len(opacities)
    for start in range(begin, end, WIDTH):
        n = min(start, end - WIDTH)  # the last eight overlap those before
        fresh = where_gt(lane_numbers(), spread(start - n - 0.5), spread(1.0), zero)
        mean, scale = load_columns(means, 3 * n, 3), load_columns(scales, 3 * n, 3)
        quat = unit_quat(load_columns(quats, 4 * n, 4))
        axes = rotation_columns(quat[0], quat[1], quat[2], quat[3])
        v_mean, v_opacity = (zero, zero, zero), zero
        column_a, column_b, column_c = (zero, zero, zero), (zero, zero, zero), (zero, zero, zero)
        for view in range(world_to_camera.shape[0]):
            row = view * count + n
            (radius,) = load_columns(radii, row, 1)
            if not any_gt(radius, zero):
                continue
            rows, move = camera_axes(world_to_camera, view)
            fx, fy, cx, cy = pinhole(intrinsics, view)
            z = where_gt(radius, zero, dot(rows[2], mean) + move[2], spread(1.0))
            near_by = 1.0 / z
            slope_x, slope_y = (dot(rows[0], mean) + move[0]) * near_by, (dot(rows[1], mean) + move[1]) * near_by
            limits_x, limits_y = slope_limits(fx, cx, width), slope_limits(fy, cy, height)
            direct_x, direct_y = fx * near_by, fy * near_by
            depth_x, depth_y = (0.0 - direct_x) * clamp(slope_x, limits_x), (0.0 - direct_y) * clamp(slope_y, limits_y)
            linear_x, linear_y = mix(direct_x, rows[0], depth_x, rows[2]), mix(direct_y, rows[1], depth_y, rows[2])
            half_x, half_y = image_axes(linear_x, linear_y, axes, scale)
            record = load_columns(g_records, RECORD * row, RECORD)
            g_u, g_v = load_columns(g_means2d, 2 * row, 2)
            # invisible lanes get a valid covariance and no gradient
            g_u, g_v = where_gt(radius, zero, g_u, zero), where_gt(radius, zero, g_v, zero)
            raw_xx, raw_yy = (
                where_gt(radius, zero, dot(half_x, half_x), spread(1.0)),
                where_gt(radius, zero, dot(half_y, half_y), spread(1.0)),
            )
            v_xx, v_xy, v_yy = _covariance_gradient(
                raw_xx, where_gt(radius, zero, dot(half_x, half_y), zero), raw_yy, eps2d, antialias,
                record[TT], record[TU], record[UU], record[LOG_OPACITY],
            )  # fmt: skip
            v_opacity = v_opacity + record[LOG_OPACITY]
            v_half_x, v_half_y = mix(2 * v_xx, half_x, v_xy, half_y), mix(v_xy, half_x, 2 * v_yy, half_y)
            # column k of (rotation x scales) has gradient linear_x v_half_x[k] + linear_y v_half_y[k]
            column_a = added(column_a, mix(v_half_x[0], linear_x, v_half_y[0], linear_y))
            column_b = added(column_b, mix(v_half_x[1], linear_x, v_half_y[1], linear_y))
            column_c = added(column_c, mix(v_half_x[2], linear_x, v_half_y[2], linear_y))
            a, b, c = scale
            v_linear_x = added(
                mix(v_half_x[0] * a, axes[0], v_half_x[1] * b, axes[1]), scaled(v_half_x[2] * c, axes[2])
            )
            v_linear_y = added(
                mix(v_half_y[0] * a, axes[0], v_half_y[1] * b, axes[1]), scaled(v_half_y[2] * c, axes[2])
            )
            v_slope_x, v_z_x, v_fx = _pinhole_gradient(
                slope_x, near_by, fx, limits_x, g_u, dot(v_linear_x, rows[0]), dot(v_linear_x, rows[2])
            )
            v_slope_y, v_z_y, v_fy = _pinhole_gradient(
                slope_y, near_by, fy, limits_y, g_v, dot(v_linear_y, rows[1]), dot(v_linear_y, rows[2])
            )
            local_z = v_z_x + v_z_y - (v_slope_x * slope_x + v_slope_y * slope_y) * near_by
            local = v_slope_x * near_by, v_slope_y * near_by, local_z
            v_mean = added(added(v_mean, scaled(local[0], rows[0])), mix(local[1], rows[1], local[2], rows[2]))
            if with_cameras:
                _add_camera(
                    v_cameras, view, fresh, mean, local, (direct_x, depth_x, direct_y, depth_y), v_linear_x, v_linear_y,
                    (v_fx, v_fy), (g_u, g_v),
                )  # fmt: skip
        (opacity,) = load_columns(opacities, n, 1)
        v_opacity = where_gt(opacity, zero, 2 * HALF_LOG2_E * v_opacity / opacity, zero)
        store_columns(v_means, 3 * n, v_mean)
        store_columns(v_scales, 3 * n, (dot(column_a, axes[0]), dot(column_b, axes[1]), dot(column_c, axes[2])))
        store_columns(v_opacities, n, (v_opacity,))
        a, b, c = scale
        columns = scaled(a, column_a), scaled(b, column_b), scaled(c, column_c)
        store_columns(v_quats, 4 * n, _rotation_gradient(quat, columns[0], columns[1], columns[2]))
