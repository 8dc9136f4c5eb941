"""Triton kernels for what a step does with each Gaussian's orientation: a lane a Gaussian, in single precision.

Their twins in torch are products by small matrices, for which a GPU has no good kernel. A rotation's columns are
quadratic in the unit quaternion (w, x, y, z); gradients pass through the normalisation.
"""

import triton
import triton.language as tl

from rewild4d.kernels import harmonics

BLOCK = tl.constexpr(128)
SIDE = tl.constexpr(16)
"""Matrices of one program of `squared_axes`."""

_C0, _C1 = tl.constexpr(harmonics.C0), tl.constexpr(harmonics.C1)
_C20, _C22, _C24 = (tl.constexpr(harmonics.C2[i]) for i in (0, 2, 4))
_C30, _C31, _C32, _C33, _C35 = (tl.constexpr(harmonics.C3[i]) for i in (0, 1, 2, 3, 5))


@triton.jit
def _quat(pointer: tl.tensor, n: tl.tensor, real: tl.tensor) -> tuple:
    return (
        tl.load(pointer + 4 * n, real, 1.0), tl.load(pointer + 4 * n + 1, real, 0.0),
        tl.load(pointer + 4 * n + 2, real, 0.0), tl.load(pointer + 4 * n + 3, real, 0.0),
    )  # fmt: skip


@triton.jit
def _vector(pointer: tl.tensor, n: tl.tensor, real: tl.tensor) -> tuple:
    return (
        tl.load(pointer + 3 * n, real, 0.0),
        tl.load(pointer + 3 * n + 1, real, 0.0),
        tl.load(pointer + 3 * n + 2, real, 0.0),
    )


@triton.jit
def _unit(w: tl.tensor, x: tl.tensor, y: tl.tensor, z: tl.tensor) -> tuple:
    """Return the unit quaternion and one over the length."""
    inverse = 1.0 / tl.maximum(tl.sqrt(w * w + x * x + y * y + z * z), 1e-12)
    return w * inverse, x * inverse, y * inverse, z * inverse, inverse


@triton.jit
def _product(
    a: tl.tensor, b: tl.tensor, c: tl.tensor, d: tl.tensor, w: tl.tensor, x: tl.tensor, y: tl.tensor, z: tl.tensor
) -> tuple:
    return (
        a * w - b * x - c * y - d * z,
        a * x + b * w + c * z - d * y,
        a * y - b * z + c * w + d * x,
        a * z + b * y - c * x + d * w,
    )


@triton.jit(do_not_specialize=["count"])
def multiply(
    first: tl.tensor, second: tl.tensor, made: tl.tensor, count: tl.tensor, LEFT: tl.constexpr, RIGHT: tl.constexpr
) -> None:
    """Fill made [n, 4] with products of quaternions [n, 4]; the vectors of the first times LEFT, of the second times
    RIGHT, where -1 conjugates."""
    n = tl.program_id(0).to(tl.int64) * BLOCK + tl.arange(0, BLOCK)
    real = n < count
    a, b, c, d = _quat(first, n, real)
    w, x, y, z = _quat(second, n, real)
    e, f, g, h = _product(a, LEFT * b, LEFT * c, LEFT * d, w, RIGHT * x, RIGHT * y, RIGHT * z)
    tl.store(made + 4 * n, e, real)
    tl.store(made + 4 * n + 1, f, real)
    tl.store(made + 4 * n + 2, g, real)
    tl.store(made + 4 * n + 3, h, real)


@triton.jit
def _thinnest(log_scales: tl.tensor, n: tl.tensor, real: tl.tensor) -> tuple:
    """Return whether the first axis is the thinnest, and whether the second one is."""
    a, b, c = _vector(log_scales, n, real)
    first = (a <= b) & (a <= c)
    return first, (b <= c) & ~first


@triton.jit
def _column(first: tl.tensor, second: tl.tensor, w: tl.tensor, x: tl.tensor, y: tl.tensor, z: tl.tensor) -> tuple:
    """Return the chosen column of the rotation matrix."""
    return (
        tl.where(first, w * w + x * x - y * y - z * z, tl.where(second, 2 * (x * y - w * z), 2 * (x * z + w * y))),
        tl.where(first, 2 * (x * y + w * z), tl.where(second, w * w - x * x + y * y - z * z, 2 * (y * z - w * x))),
        tl.where(first, 2 * (x * z - w * y), tl.where(second, 2 * (y * z + w * x), w * w - x * x - y * y + z * z)),
    )


@triton.jit(do_not_specialize=["count"])
def axes(
    quats: tl.tensor, log_scales: tl.tensor, means: tl.tensor, eye: tl.tensor, made: tl.tensor, count: tl.tensor
) -> None:
    """Fill made [n, 3] with each Gaussian's thinnest axis, pointing to ``eye`` [3]."""
    n = tl.program_id(0).to(tl.int64) * BLOCK + tl.arange(0, BLOCK)
    real = n < count
    w, x, y, z = _quat(quats, n, real)
    w, x, y, z, _ = _unit(w, x, y, z)
    first, second = _thinnest(log_scales, n, real)
    p, q, r = _column(first, second, w, x, y, z)
    a, b, c = _vector(means, n, real)
    towards = (tl.load(eye) - a) * p + (tl.load(eye + 1) - b) * q + (tl.load(eye + 2) - c) * r
    sign = tl.where(towards < 0, -1.0, 1.0)
    tl.store(made + 3 * n, sign * p, real)
    tl.store(made + 3 * n + 1, sign * q, real)
    tl.store(made + 3 * n + 2, sign * r, real)


@triton.jit(do_not_specialize=["count"])
def axes_backward(
    quats: tl.tensor, log_scales: tl.tensor, made: tl.tensor, g_made: tl.tensor, v_quats: tl.tensor, count: tl.tensor
) -> None:
    """Fill v_quats [n, 4] from the gradient of `axes`."""
    n = tl.program_id(0).to(tl.int64) * BLOCK + tl.arange(0, BLOCK)
    real = n < count
    w, x, y, z = _quat(quats, n, real)
    w, x, y, z, inverse = _unit(w, x, y, z)
    first, second = _thinnest(log_scales, n, real)
    p, q, r = _column(first, second, w, x, y, z)
    a, b, c = _vector(made, n, real)
    sign = tl.where(a * p + b * q + c * r < 0, -1.0, 1.0)
    g0, g1, g2 = _vector(g_made, n, real)
    g0, g1, g2 = sign * g0, sign * g1, sign * g2
    along = 2 * (g0 * x + g1 * y + g2 * z)
    # derivatives of each column by w, x, y, z
    k = 2 * (g0 * w + g1 * z - g2 * y)
    i = 2 * (-g0 * z + g1 * w + g2 * x)
    j = 2 * (g0 * y - g1 * x + g2 * w)
    v_w = tl.where(first, k, tl.where(second, i, j))
    v_x = tl.where(first, along, tl.where(second, j, -i))
    v_y = tl.where(first, -j, tl.where(second, along, k))
    v_z = tl.where(first, i, tl.where(second, -k, along))
    radial = w * v_w + x * v_x + y * v_y + z * v_z
    tl.store(v_quats + 4 * n, (v_w - radial * w) * inverse, real)
    tl.store(v_quats + 4 * n + 1, (v_x - radial * x) * inverse, real)
    tl.store(v_quats + 4 * n + 2, (v_y - radial * y) * inverse, real)
    tl.store(v_quats + 4 * n + 3, (v_z - radial * z) * inverse, real)


@triton.jit
def _plain_direction(means: tl.tensor, eye: tl.tensor, n: tl.tensor, real: tl.tensor) -> tuple:
    """Return the direction from the eye."""
    x, y, z = _vector(means, n, real)
    x, y, z = x - tl.load(eye), y - tl.load(eye + 1), z - tl.load(eye + 2)
    inverse = 1.0 / tl.maximum(tl.sqrt(x * x + y * y + z * z), 1e-12)
    return x * inverse, y * inverse, z * inverse


@triton.jit
def _direction(
    means: tl.tensor, quats: tl.tensor, rest: tl.tensor, eye: tl.tensor, n: tl.tensor, real: tl.tensor
) -> tuple:
    """Return the direction from the eye, turned from the posed to the rest orientation."""
    x, y, z = _plain_direction(means, eye, n, real)
    a, b, c, d = _quat(quats, n, real)
    e, f, g, h = _quat(rest, n, real)
    e, f, g, h, _ = _unit(e, f, g, h)
    a, b, c, d = _product(a, b, c, d, e, -f, -g, -h)
    a, b, c, d, _ = _unit(a, b, c, d)
    none = 0.0 * x
    e, f, g, h = _product(a, -b, -c, -d, none, x, y, z)
    _, x, y, z = _product(e, f, g, h, a, b, c, d)
    return x, y, z


@triton.jit
def _value(k: tl.constexpr, x: tl.tensor, y: tl.tensor, z: tl.tensor) -> tl.tensor:
    """Return basis function k of a unit direction, 1 to 15."""
    xx, yy, zz = x * x, y * y, z * z
    if k == 1:
        value = -_C1 * y
    elif k == 2:
        value = _C1 * z
    elif k == 3:
        value = -_C1 * x
    elif k == 4:
        value = _C20 * x * y
    elif k == 5:
        value = -_C20 * y * z
    elif k == 6:
        value = _C22 * (2 * zz - xx - yy)
    elif k == 7:
        value = -_C20 * x * z
    elif k == 8:
        value = _C24 * (xx - yy)
    elif k == 9:
        value = _C30 * y * (3 * xx - yy)
    elif k == 10:
        value = _C31 * x * y * z
    elif k == 11:
        value = _C32 * y * (4 * zz - xx - yy)
    elif k == 12:
        value = _C33 * z * (2 * zz - 3 * xx - 3 * yy)
    elif k == 13:
        value = _C32 * x * (4 * zz - xx - yy)
    elif k == 14:
        value = _C35 * z * (xx - yy)
    else:
        value = _C30 * x * (xx - 3 * yy)
    return value


@triton.jit(do_not_specialize=["count", "coefficients", "gain"])
def colours(
    colors: tl.tensor, means: tl.tensor, quats: tl.tensor, rest: tl.tensor, eye: tl.tensor, made: tl.tensor,
    count: tl.tensor, coefficients: tl.tensor, gain: tl.tensor, USED: tl.constexpr,
) -> None:  # fmt: skip
    """Fill made [n, 3] with colours [n, coefficients, 3] seen from ``eye`` [3], the first ``USED`` coefficients."""
    n = tl.program_id(0).to(tl.int64) * BLOCK + tl.arange(0, BLOCK)
    real = n < count
    x, y, z = _direction(means, quats, rest, eye, n, real)
    row = n * coefficients
    red, green, blue = _vector(colors, row, real)
    for k in tl.static_range(1, USED):
        value = _value(k, x, y, z) / gain
        r, g, b = _vector(colors, row + k, real)
        red, green, blue = red + value * r, green + value * g, blue + value * b
    tl.store(made + 3 * n, tl.maximum(red, 0.0), real)
    tl.store(made + 3 * n + 1, tl.maximum(green, 0.0), real)
    tl.store(made + 3 * n + 2, tl.maximum(blue, 0.0), real)


@triton.jit(do_not_specialize=["count"])
def splat_colours(
    colors: tl.tensor, means: tl.tensor, eye: tl.tensor, made: tl.tensor, count: tl.tensor, USED: tl.constexpr
) -> None:
    """Fill made [n, 3] with the colours of splats, all of whose coefficients [n, USED, 3] are in use."""
    n = tl.program_id(0).to(tl.int64) * BLOCK + tl.arange(0, BLOCK)
    real = n < count
    x, y, z = _plain_direction(means, eye, n, real)
    red, green, blue = _vector(colors, n * USED, real)
    red, green, blue = red * _C0 + 0.5, green * _C0 + 0.5, blue * _C0 + 0.5
    for k in tl.static_range(1, USED):
        value = _value(k, x, y, z)
        r, g, b = _vector(colors, n * USED + k, real)
        red, green, blue = red + value * r, green + value * g, blue + value * b
    tl.store(made + 3 * n, tl.maximum(red, 0.0), real)
    tl.store(made + 3 * n + 1, tl.maximum(green, 0.0), real)
    tl.store(made + 3 * n + 2, tl.maximum(blue, 0.0), real)


@triton.jit(do_not_specialize=["count", "coefficients", "gain"])
def colours_backward(
    made: tl.tensor, g_made: tl.tensor, means: tl.tensor, quats: tl.tensor, rest: tl.tensor, eye: tl.tensor,
    v_colors: tl.tensor, count: tl.tensor, coefficients: tl.tensor, gain: tl.tensor, USED: tl.constexpr,
) -> None:  # fmt: skip
    """Fill the first ``USED`` coefficients of v_colors [n, coefficients, 3]."""
    n = tl.program_id(0).to(tl.int64) * BLOCK + tl.arange(0, BLOCK)
    real = n < count
    x, y, z = _direction(means, quats, rest, eye, n, real)
    red, green, blue = _vector(g_made, n, real)
    a, b, c = _vector(made, n, real)
    red, green, blue = tl.where(a > 0, red, 0.0), tl.where(b > 0, green, 0.0), tl.where(c > 0, blue, 0.0)
    row = v_colors + 3 * n * coefficients
    tl.store(row, red, real)
    tl.store(row + 1, green, real)
    tl.store(row + 2, blue, real)
    for k in tl.static_range(1, USED):
        value = _value(k, x, y, z) / gain
        tl.store(row + 3 * k, value * red, real)
        tl.store(row + 3 * k + 1, value * green, real)
        tl.store(row + 3 * k + 2, value * blue, real)


@triton.jit(do_not_specialize=["count"])
def squared_axes(matrices: tl.tensor, made: tl.tensor, count: tl.tensor, SQUARINGS: tl.constexpr) -> None:
    """Fill made [J, 3] with the unit eigenvectors of the largest eigenvalues of positive matrices [J, 3, 3], from their
    2^SQUARINGS-th powers."""
    n = tl.program_id(0) * SIDE + tl.arange(0, SIDE)
    real = n < count
    place = matrices + 9 * n
    a, b, c = (
        tl.load(place, real, 1.0).to(tl.float64), tl.load(place + 1, real, 0.0).to(tl.float64),
        tl.load(place + 2, real, 0.0).to(tl.float64),
    )  # fmt: skip
    d, e = tl.load(place + 4, real, 1.0).to(tl.float64), tl.load(place + 5, real, 0.0).to(tl.float64)
    f = tl.load(place + 8, real, 1.0).to(tl.float64)
    for _ in range(SQUARINGS):
        by = 1.0 / tl.maximum(a + d + f, 1e-300)
        a, b, c, d, e, f = a * by, b * by, c * by, d * by, e * by, f * by
        a, b, c, d, e, f = (
            a * a + b * b + c * c, a * b + b * d + c * e, a * c + b * e + c * f,
            b * b + d * d + e * e, b * c + d * e + e * f, c * c + e * e + f * f,
        )  # fmt: skip
    first, second = (a >= d) & (a >= f), d >= f
    x = tl.where(first, a, tl.where(second, b, c))
    y = tl.where(first, b, tl.where(second, d, e))
    z = tl.where(first, c, tl.where(second, e, f))
    by = 1.0 / tl.maximum(tl.sqrt(x * x + y * y + z * z), 1e-300)
    tl.store(made + 3 * n, (x * by).to(tl.float32), real)
    tl.store(made + 3 * n + 1, (y * by).to(tl.float32), real)
    tl.store(made + 3 * n + 2, (z * by).to(tl.float32), real)
