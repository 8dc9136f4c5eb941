"""EWA projection and its gradient: one Gaussian at a time, in double precision, as a record that the blend reads.

A record holds, per view and Gaussian, what one pixel's alpha takes: alpha = 2 ** (exponent), with d = pixel - centre,
exponent = LOG_OPACITY - t^2 - u^2, t = ALONG_X dx + ALONG_Y dy, u = DOWN dy. A sum of squares loses nothing to
cancellation, as the form's expansion does for needles. The gradient of a record holds, in its columns TT, TU and UU,
the sums of dL/dexponent times t^2, t u and u^2. Invisible Gaussians have extent 0.
"""

import math

import numpy as np

from rewild4d.kernels.compiling import inlined, kernel
from rewild4d.rasterizer.conventions import FRUSTUM_MARGIN, MIN_ALPHA, MIN_COMPENSATION

# Columns of a record.
CENTER_X, CENTER_Y, ALONG_X, ALONG_Y, DOWN, LOG_OPACITY, EXTENT_X, EXTENT_Y, RECORD = 0, 1, 2, 3, 4, 5, 6, 7, 8
# Columns of a record's gradient.
TT, TU, UU = 2, 3, 4

CHUNK = 1024
"""Gaussians a unit of work holds; the camera's gradient is summed over these, whatever the number of threads."""

HALF_LOG2_E = 0.5 / math.log(2.0)
LOG2_MIN_ALPHA = math.log2(MIN_ALPHA)


@inlined
def _dot(a: tuple, b: tuple) -> float:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@inlined
def _mix(x: float, a: tuple, y: float, b: tuple) -> tuple:
    return x * a[0] + y * b[0], x * a[1] + y * b[1], x * a[2] + y * b[2]


@inlined
def _row(matrix: np.ndarray, view: int, row: int) -> tuple:
    return matrix[view, row, 0], matrix[view, row, 1], matrix[view, row, 2]


@inlined
def _unit_quat(quats: np.ndarray, n: int) -> tuple:
    w, x, y, z = np.float64(quats[n, 0]), np.float64(quats[n, 1]), np.float64(quats[n, 2]), np.float64(quats[n, 3])
    inverse = 1.0 / max(math.sqrt(w * w + x * x + y * y + z * z), 1e-12)
    return w * inverse, x * inverse, y * inverse, z * inverse, inverse


@inlined
def _axes(w: float, x: float, y: float, z: float) -> tuple:
    """Columns of the rotation matrix."""
    return (
        (1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y)),
        (2 * (x * y - w * z), 1 - 2 * (x * x + z * z), 2 * (y * z + w * x)),
        (2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)),
    )


@inlined
def _limits(focal: float, center: float, size: int) -> tuple:
    """Between which x / z the Jacobian is taken: a little outside the frame."""
    margin = FRUSTUM_MARGIN * 0.5 * size / focal
    return -center / focal - margin, (size - center) / focal + margin


@inlined
def _clamp(value: float, limits: tuple) -> float:
    return min(max(value, limits[0]), limits[1])


@inlined
def _image_axes(linear_x: tuple, linear_y: tuple, axes: tuple, scales: np.ndarray, n: int) -> tuple:
    """The Gaussian's half axes in the image, two rows of three: covariance = rows times their transpose."""
    a, b, c = np.float64(scales[n, 0]), np.float64(scales[n, 1]), np.float64(scales[n, 2])
    row_x = _dot(linear_x, axes[0]) * a, _dot(linear_x, axes[1]) * b, _dot(linear_x, axes[2]) * c
    row_y = _dot(linear_y, axes[0]) * a, _dot(linear_y, axes[1]) * b, _dot(linear_y, axes[2]) * c
    return row_x, row_y


@inlined
def _factor(xx: float, xy: float, yy: float, det: float) -> tuple:
    """The triangular factor of the inverse covariance, times log2(e) / 2."""
    down = math.sqrt(HALF_LOG2_E / yy)
    along_x = math.sqrt(HALF_LOG2_E * yy / det)
    return along_x, -along_x * xy / yy, down


@kernel
def project(
    begin: int,
    end: int,
    means: np.ndarray,
    quats: np.ndarray,
    scales: np.ndarray,
    opacities: np.ndarray,
    world_to_camera: np.ndarray,
    intrinsics: np.ndarray,
    width: int,
    height: int,
    eps2d: float,
    antialias: bool,
    near: float,
    means2d: np.ndarray,
    records: np.ndarray,
    radii: np.ndarray,
    depths: np.ndarray,
) -> None:
    """Fill means2d [V, N, 2], records [V, N, 8], radii [V, N] and depths [V, N] for Gaussians begin..end."""
    for view in range(world_to_camera.shape[0]):
        row_x, row_y, row_z = (
            _row(world_to_camera, view, 0),
            _row(world_to_camera, view, 1),
            _row(world_to_camera, view, 2),
        )
        move = world_to_camera[view, 0, 3], world_to_camera[view, 1, 3], world_to_camera[view, 2, 3]
        fx, fy, cx, cy = intrinsics[view, 0, 0], intrinsics[view, 1, 1], intrinsics[view, 0, 2], intrinsics[view, 1, 2]
        limits_x, limits_y = _limits(fx, cx, width), _limits(fy, cy, height)
        for n in range(begin, end):
            # One by one: a slice would call memset.
            means2d[view, n, 0], means2d[view, n, 1], radii[view, n], depths[view, n] = 0, 0, 0, 0
            for column in range(RECORD):
                records[view, n, column] = 0
            mean = np.float64(means[n, 0]), np.float64(means[n, 1]), np.float64(means[n, 2])
            z = _dot(row_z, mean) + move[2]
            if not z > near:
                continue
            near_by = 1 / z
            slope_x, slope_y = (_dot(row_x, mean) + move[0]) * near_by, (_dot(row_y, mean) + move[1]) * near_by
            u, v = fx * slope_x + cx, fy * slope_y + cy
            means2d[view, n, 0], means2d[view, n, 1] = u, v
            linear_x = _mix(fx * near_by, row_x, -fx * near_by * _clamp(slope_x, limits_x), row_z)
            linear_y = _mix(fy * near_by, row_y, -fy * near_by * _clamp(slope_y, limits_y), row_z)
            qw, qx, qy, qz, _ = _unit_quat(quats, n)
            half_x, half_y = _image_axes(linear_x, linear_y, _axes(qw, qx, qy, qz), scales, n)
            raw_xx, xy, raw_yy = _dot(half_x, half_x), _dot(half_x, half_y), _dot(half_y, half_y)
            xx, yy = raw_xx + eps2d, raw_yy + eps2d
            det = xx * yy - xy * xy
            opacity = np.float64(opacities[n])
            if antialias and det > 0:
                opacity *= math.sqrt(max((raw_xx * raw_yy - xy * xy) / det, MIN_COMPENSATION))
            if not (opacity > MIN_ALPHA and det > 0):
                continue
            log_opacity = math.log2(opacity)
            reach = (log_opacity - LOG2_MIN_ALPHA) / HALF_LOG2_E
            extent_x, extent_y = math.sqrt(reach * xx), math.sqrt(reach * yy)
            if not (u + extent_x > 0 and u - extent_x < width and v + extent_y > 0 and v - extent_y < height):
                continue
            spread = 0.5 * (xx - yy)
            radii[view, n] = math.sqrt(reach * (0.5 * (xx + yy) + math.sqrt(spread * spread + xy * xy)))
            depths[view, n] = z
            records[view, n, CENTER_X], records[view, n, CENTER_Y] = u, v
            along_x, along_y, down = _factor(xx, xy, yy, det)
            records[view, n, ALONG_X], records[view, n, ALONG_Y], records[view, n, DOWN] = along_x, along_y, down
            records[view, n, LOG_OPACITY] = log_opacity
            records[view, n, EXTENT_X], records[view, n, EXTENT_Y] = extent_x, extent_y


@inlined
def _covariance_gradient(
    raw_xx: float,
    xy: float,
    raw_yy: float,
    eps2d: float,
    antialias: bool,
    g_tt: float,
    g_tu: float,
    g_uu: float,
    g_log: float,
) -> tuple:
    """Gradient of the projected covariance (xx, xy, yy) from that of a record."""
    xx, yy = raw_xx + eps2d, raw_yy + eps2d
    det = xx * yy - xy * xy
    a, b, c = _factor(xx, xy, yy, det)
    k = 1 / HALF_LOG2_E
    v_xx = k * a * a * g_tt
    v_xy = 2 * k * a * (b * g_tt + c * g_tu)
    v_yy = k * (b * b * g_tt + 2 * b * c * g_tu + c * c * g_uu)
    raw_det = raw_xx * raw_yy - xy * xy
    if antialias and raw_det > MIN_COMPENSATION * det:
        h = HALF_LOG2_E * g_log
        v_xx += h * (raw_yy / raw_det - yy / det)
        v_xy += h * 2 * (xy / det - xy / raw_det)
        v_yy += h * (raw_xx / raw_det - xx / det)
    return v_xx, v_xy, v_yy


@inlined
def _rotation_gradient(w: float, x: float, y: float, z: float, inverse: float, a: tuple, b: tuple, c: tuple) -> tuple:
    """Gradient of the raw quaternion from that of the rotation's three columns."""
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
    slope: float, near_by: float, focal: float, limits: tuple, g_center: float, g_direct: float, g_depth: float
) -> tuple:
    """One image axis: gradients of (slope x / z, z, focal) from those of the centre and the Jacobian's two entries."""
    tangent = _clamp(slope, limits)
    g_slope = g_center * focal
    if tangent == slope:
        g_slope -= g_depth * focal * near_by
    g_z = (g_depth * tangent - g_direct) * focal * near_by * near_by
    g_focal = g_center * slope + (g_direct - g_depth * tangent) * near_by
    return g_slope, g_z, g_focal


@kernel
def project_backward(
    begin: int,
    end: int,
    means: np.ndarray,
    quats: np.ndarray,
    scales: np.ndarray,
    opacities: np.ndarray,
    world_to_camera: np.ndarray,
    intrinsics: np.ndarray,
    width: int,
    height: int,
    eps2d: float,
    antialias: bool,
    with_cameras: bool,
    radii: np.ndarray,
    g_means2d: np.ndarray,
    g_records: np.ndarray,
    v_means: np.ndarray,
    v_quats: np.ndarray,
    v_scales: np.ndarray,
    v_opacities: np.ndarray,
    v_cameras: np.ndarray,
    v_pinholes: np.ndarray,
) -> None:
    """Add the gradients of Gaussians begin..end to the zeroed v_ arrays; v_cameras and v_pinholes are this chunk's own.

    v_cameras is [V, 3, 4] and v_pinholes [V, 4] (fx, fy, cx, cy), double precision; left alone unless with_cameras.
    """
    for view in range(world_to_camera.shape[0]):
        row_x, row_y, row_z = (
            _row(world_to_camera, view, 0),
            _row(world_to_camera, view, 1),
            _row(world_to_camera, view, 2),
        )
        move = world_to_camera[view, 0, 3], world_to_camera[view, 1, 3], world_to_camera[view, 2, 3]
        fx, fy, cx, cy = intrinsics[view, 0, 0], intrinsics[view, 1, 1], intrinsics[view, 0, 2], intrinsics[view, 1, 2]
        limits_x, limits_y = _limits(fx, cx, width), _limits(fy, cy, height)
        for n in range(begin, end):
            if radii[view, n] == 0:
                continue
            mean = np.float64(means[n, 0]), np.float64(means[n, 1]), np.float64(means[n, 2])
            z = _dot(row_z, mean) + move[2]
            near_by = 1 / z
            slope_x, slope_y = (_dot(row_x, mean) + move[0]) * near_by, (_dot(row_y, mean) + move[1]) * near_by
            direct_x, depth_x = fx * near_by, -fx * near_by * _clamp(slope_x, limits_x)
            direct_y, depth_y = fy * near_by, -fy * near_by * _clamp(slope_y, limits_y)
            linear_x, linear_y = _mix(direct_x, row_x, depth_x, row_z), _mix(direct_y, row_y, depth_y, row_z)
            qw, qx, qy, qz, inverse = _unit_quat(quats, n)
            axes = _axes(qw, qx, qy, qz)
            half_x, half_y = _image_axes(linear_x, linear_y, axes, scales, n)
            g_log = np.float64(g_records[view, n, LOG_OPACITY])
            v_xx, v_xy, v_yy = _covariance_gradient(
                _dot(half_x, half_x), _dot(half_x, half_y), _dot(half_y, half_y), eps2d, antialias,
                g_records[view, n, TT], g_records[view, n, TU], g_records[view, n, UU], g_log,
            )  # fmt: skip
            v_opacities[n] += 2 * HALF_LOG2_E * g_log / opacities[n]
            v_half_x, v_half_y = _mix(2 * v_xx, half_x, v_xy, half_y), _mix(v_xy, half_x, 2 * v_yy, half_y)

            # Column k of (rotation x scales) has gradient linear_x v_half_x[k] + linear_y v_half_y[k].
            a, b, c = np.float64(scales[n, 0]), np.float64(scales[n, 1]), np.float64(scales[n, 2])
            column_a = _mix(v_half_x[0], linear_x, v_half_y[0], linear_y)
            column_b = _mix(v_half_x[1], linear_x, v_half_y[1], linear_y)
            column_c = _mix(v_half_x[2], linear_x, v_half_y[2], linear_y)
            v_scales[n, 0] += _dot(column_a, axes[0])
            v_scales[n, 1] += _dot(column_b, axes[1])
            v_scales[n, 2] += _dot(column_c, axes[2])
            v_w, v_x, v_y, v_z = _rotation_gradient(
                qw, qx, qy, qz, inverse, _mix(a, column_a, 0.0, column_a), _mix(b, column_b, 0.0, column_b),
                _mix(c, column_c, 0.0, column_c),
            )  # fmt: skip
            v_quats[n, 0] += v_w
            v_quats[n, 1] += v_x
            v_quats[n, 2] += v_y
            v_quats[n, 3] += v_z

            v_linear_x = _mix(1.0, _mix(v_half_x[0] * a, axes[0], v_half_x[1] * b, axes[1]), v_half_x[2] * c, axes[2])
            v_linear_y = _mix(1.0, _mix(v_half_y[0] * a, axes[0], v_half_y[1] * b, axes[1]), v_half_y[2] * c, axes[2])
            g_u, g_v = np.float64(g_means2d[view, n, 0]), np.float64(g_means2d[view, n, 1])
            v_slope_x, v_z_x, v_fx = _pinhole_gradient(
                slope_x, near_by, fx, limits_x, g_u, _dot(v_linear_x, row_x), _dot(v_linear_x, row_z)
            )
            v_slope_y, v_z_y, v_fy = _pinhole_gradient(
                slope_y, near_by, fy, limits_y, g_v, _dot(v_linear_y, row_y), _dot(v_linear_y, row_z)
            )
            local_x, local_y = v_slope_x * near_by, v_slope_y * near_by
            local_z = v_z_x + v_z_y - (v_slope_x * slope_x + v_slope_y * slope_y) * near_by
            for i in range(3):
                v_means[n, i] += local_x * row_x[i] + local_y * row_y[i] + local_z * row_z[i]
            if not with_cameras:
                continue
            for i in range(3):
                v_cameras[view, 0, i] += local_x * mean[i] + direct_x * v_linear_x[i]
                v_cameras[view, 1, i] += local_y * mean[i] + direct_y * v_linear_y[i]
                v_cameras[view, 2, i] += local_z * mean[i] + depth_x * v_linear_x[i] + depth_y * v_linear_y[i]
            v_cameras[view, 0, 3] += local_x
            v_cameras[view, 1, 3] += local_y
            v_cameras[view, 2, 3] += local_z
            v_pinholes[view, 0] += v_fx
            v_pinholes[view, 1] += v_fy
            v_pinholes[view, 2] += g_u
            v_pinholes[view, 3] += g_v
