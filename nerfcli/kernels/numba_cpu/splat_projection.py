"""Projection of Gaussian splats on CPU threads, and its gradient: see `reference.project_splats`.

Arithmetic is in float64; rows and footprints are float32. A row holds the parameters of a Gaussian from `MEAN` to
`COLOUR`, where its K harmonics begin, three channels each.

Harmonics of splat files, up to degree 3, are in one array, `step` numbers apart from each other, from `at` on: of one
direction, or of a vector of them. Source: Sloan 2013, Efficient spherical harmonic evaluation, JCGT 2(2), appendix A2;
signs as `splat_harmonics`.

A lens is a table, the same code for every lens model. A point p in camera axes has the stereographic coordinates
s = (x, y) / (|p| + z), which are smooth for all directions but straight behind. The table holds the coefficients of a
bicubic B-spline of the pixel over s; it is twice differentiable, as the gradient of a Jacobian requires.
"""

import math
from typing import Any

import numba
import numpy as np

from nerfcli.kernels.interface import BEYOND, LOW_PASS, SMALLEST_ALPHA

# Constants are float32, with which Numba would not multiply a literal.
_0, _1 = np.float32(math.sqrt(1 / (4 * math.pi))), np.float32(math.sqrt(3 / (4 * math.pi)))
_2A, _2B = np.float32(math.sqrt(15 / (4 * math.pi))), np.float32(math.sqrt(5 / (16 * math.pi)))
_2C, _3A = np.float32(math.sqrt(15 / (16 * math.pi))), np.float32(math.sqrt(35 / (32 * math.pi)))
_3B, _3C = np.float32(math.sqrt(105 / (4 * math.pi))), np.float32(math.sqrt(21 / (32 * math.pi)))
_3D, _3E = np.float32(math.sqrt(7 / (16 * math.pi))), np.float32(math.sqrt(105 / (16 * math.pi)))
_I, _II, _III, _V = np.float32(1), np.float32(2), np.float32(3), np.float32(5)
_VI, _X, _XV = np.float32(6), np.float32(10), np.float32(15)


@numba.njit(cache=True, inline="always")
def harmonics(degree: Any, x: Any, y: Any, z: Any, out: Any, at: Any, step: Any) -> None:
    """Write the (degree + 1)^2 harmonics in the unit direction (x, y, z)."""
    out[at] = _0
    if degree > 0:
        out[at + step], out[at + 2 * step], out[at + 3 * step] = -_1 * y, _1 * z, -_1 * x
    if degree > 1:
        out[at + 4 * step], out[at + 5 * step], out[at + 7 * step] = _2A * x * y, -_2A * y * z, -_2A * x * z
        out[at + 6 * step], out[at + 8 * step] = _2B * (_III * z * z - _I), _2C * (x * x - y * y)
    if degree > 2:
        out[at + 9 * step], out[at + 10 * step] = -_3A * y * (_III * x * x - y * y), _3B * x * y * z
        out[at + 11 * step], out[at + 12 * step] = -_3C * y * (_V * z * z - _I), _3D * z * (_V * z * z - _III)
        out[at + 13 * step], out[at + 14 * step] = -_3C * x * (_V * z * z - _I), _3E * z * (x * x - y * y)
        out[at + 15 * step] = -_3A * x * (x * x - _III * y * y)


@numba.njit(cache=True, inline="always")
def slopes_1(by: Any, at: Any, step: Any) -> Any:
    """Return d loss / d (x, y, z) through the harmonics of degree 1, given d loss / d harmonics in their places."""
    return -_1 * by[at + 3 * step], -_1 * by[at + step], _1 * by[at + 2 * step]


@numba.njit(cache=True, inline="always")
def slopes_2(x: Any, y: Any, z: Any, by: Any, at: Any, step: Any) -> Any:
    """Return the same for degree 2."""
    b4, b5, b6, b7, b8 = by[at + 4 * step], by[at + 5 * step], by[at + 6 * step], by[at + 7 * step], by[at + 8 * step]
    return (
        _2A * (y * b4 - z * b7) + _II * _2C * x * b8,
        _2A * (x * b4 - z * b5) - _II * _2C * y * b8,
        _VI * _2B * z * b6 - _2A * (y * b5 + x * b7),
    )


@numba.njit(cache=True, inline="always")
def slopes_3(x: Any, y: Any, z: Any, by: Any, at: Any, step: Any) -> Any:
    """Return the same for degree 3."""
    b9, b10, b11, b12 = by[at + 9 * step], by[at + 10 * step], by[at + 11 * step], by[at + 12 * step]
    b13, b14, b15 = by[at + 13 * step], by[at + 14 * step], by[at + 15 * step]
    apart, ring = x * x - y * y, _V * z * z - _I
    by_x = _3B * y * z * b10 - _VI * _3A * x * y * b9 - _3C * ring * b13
    by_y = _3B * x * z * b10 - _III * _3A * apart * b9 - _3C * ring * b11
    by_z = _3B * x * y * b10 - _X * _3C * z * (y * b11 + x * b13)
    return (
        by_x + _II * _3E * x * z * b14 - _III * _3A * apart * b15,
        by_y - _II * _3E * y * z * b14 + _VI * _3A * x * y * b15,
        by_z + _3D * (_XV * z * z - _III) * b12 + _3E * apart * b14,
    )


@numba.njit(cache=True, inline="always")
def _weights(t: Any) -> Any:
    """Return the four weights of a uniform cubic B-spline at t in [0, 1), and of its first two derivatives by t."""
    u = 1.0 - t
    tt, uu = t * t, u * u
    return (
        (u * uu / 6.0, 2.0 / 3.0 - tt + t * tt / 2.0, 2.0 / 3.0 - uu + u * uu / 2.0, t * tt / 6.0),
        (-uu / 2.0, 1.5 * tt - 2.0 * t, 2.0 * u - 1.5 * uu, tt / 2.0),
        (u, 3.0 * t - 2.0, 3.0 * u - 2.0, t),
    )


@numba.njit(cache=True, inline="always")
def _dot(a: Any, b: Any) -> Any:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2] + a[3] * b[3]


@numba.njit(cache=True, fastmath={"contract"})
def _evaluate(table: Any, axis: Any, i: Any, j: Any, wx: Any, wy: Any) -> Any:
    """Return value, d/dx, d/dy, d2/dx2, d2/dxdy and d2/dy2, per step of the table."""
    r0 = (table[axis, j, i], table[axis, j, i + 1], table[axis, j, i + 2], table[axis, j, i + 3])
    r1 = (table[axis, j + 1, i], table[axis, j + 1, i + 1], table[axis, j + 1, i + 2], table[axis, j + 1, i + 3])
    r2 = (table[axis, j + 2, i], table[axis, j + 2, i + 1], table[axis, j + 2, i + 2], table[axis, j + 2, i + 3])
    r3 = (table[axis, j + 3, i], table[axis, j + 3, i + 1], table[axis, j + 3, i + 2], table[axis, j + 3, i + 3])
    values = (_dot(wx[0], r0), _dot(wx[0], r1), _dot(wx[0], r2), _dot(wx[0], r3))
    slopes = (_dot(wx[1], r0), _dot(wx[1], r1), _dot(wx[1], r2), _dot(wx[1], r3))
    bends = (_dot(wx[2], r0), _dot(wx[2], r1), _dot(wx[2], r2), _dot(wx[2], r3))
    return (
        _dot(wy[0], values), _dot(wy[0], slopes), _dot(wy[1], values),
        _dot(wy[0], bends), _dot(wy[1], slopes), _dot(wy[2], values),
    )  # fmt: skip


@numba.njit(cache=True, fastmath={"contract"}, error_model="numpy")
def project_point(p: Any, table: Any, first: Any, step: Any, lens: Any, g: Any, jacobian: Any) -> bool:
    """Project a point (3,) in camera axes; return whether the table reaches it.

    Args:
        table, first, step: see `SplatView`.
        lens: (12,), written: for each pixel axis its value and derivatives by s, d/dx, d/dy, d2/dx2, d2/dxdy, d2/dy2.
        g: (6,), written: d s / d p by rows, (e_i - s_i n) / w with w = |p| + z and n = d w / d p = e_z + p / |p|.
        jacobian: (6,), written: d pixel / d p by rows.
    """
    length = np.sqrt(p[0] * p[0] + p[1] * p[1] + p[2] * p[2])
    w = length + p[2]
    if not w > 1e-9 * length:
        return False
    sx, sy = p[0] / w, p[1] / w
    x, y = (sx - first[0]) / step[0], (sy - first[1]) / step[1]
    # `not` makes NaN count as outside.
    if not (x >= 1.0 and y >= 1.0 and x < table.shape[2] - 2.0 and y < table.shape[1] - 2.0):
        return False
    i, j = int(x), int(y)
    wx, wy = _weights(x - i), _weights(y - j)
    ix, iy = 1.0 / step[0], 1.0 / step[1]
    for axis in range(2):
        v, vx, vy, vxx, vxy, vyy = _evaluate(table, axis, i - 1, j - 1, wx, wy)
        at = 6 * axis
        lens[at], lens[at + 1], lens[at + 2] = v, vx * ix, vy * iy
        lens[at + 3], lens[at + 4], lens[at + 5] = vxx * ix * ix, vxy * ix * iy, vyy * iy * iy
    iw, il = 1.0 / w, 1.0 / length
    for k in range(3):
        n = p[k] * il + (1.0 if k == 2 else 0.0)
        g[k] = ((1.0 if k == 0 else 0.0) - sx * n) * iw
        g[3 + k] = ((1.0 if k == 1 else 0.0) - sy * n) * iw
        jacobian[k] = lens[1] * g[k] + lens[2] * g[3 + k]
        jacobian[3 + k] = lens[7] * g[k] + lens[8] * g[3 + k]
    return True


# First columns of a row.
MEAN, SCALE, QUATERNION, LOGIT, COLOUR = 0, 3, 6, 10, 11
# Columns of a footprint: centre u, v; A, B, C and E, so that log2 of alpha is A dx^2 + B dx dy + C dy^2 + E; colour;
# distance.
FOOTPRINT = 10
# Sums over the pixels of a Gaussian, with q = alpha d loss / d alpha: of q, q dx, q dy, q dx^2, q dx dy, q dy^2, and
# d loss / d red, green and blue.
SUMS = 9
# Multiply and add may be fused; nothing else is relaxed.
FUSED = {"contract"}
LOG2E = 1.4426950408889634
# Number of Gaussians for which scratch arrays are made once.
_BLOCK = 256


@numba.njit(cache=True, fastmath=FUSED)
def to_camera(row: Any, rotation: Any, translation: Any, point: Any) -> None:
    """Write a mean in camera axes."""
    for i in range(3):
        point[i] = translation[i] + (
            rotation[i, 0] * row[MEAN] + rotation[i, 1] * row[MEAN + 1] + rotation[i, 2] * row[MEAN + 2]
        )


@numba.njit(cache=True, fastmath=FUSED, error_model="numpy")
def _axes(row: Any, r: Any, sizes: Any) -> None:
    """Write the rotation of a Gaussian by rows (9,), and its sizes (3,)."""
    w, x = np.float64(row[QUATERNION]), np.float64(row[QUATERNION + 1])
    y, z = np.float64(row[QUATERNION + 2]), np.float64(row[QUATERNION + 3])
    inverse = 1.0 / np.sqrt(w * w + x * x + y * y + z * z)
    w, x, y, z = w * inverse, x * inverse, y * inverse, z * inverse
    r[0], r[1], r[2] = 1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - w * z), 2.0 * (x * z + w * y)
    r[3], r[4], r[5] = 2.0 * (x * y + w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - w * x)
    r[6], r[7], r[8] = 2.0 * (x * z - w * y), 2.0 * (y * z + w * x), 1.0 - 2.0 * (x * x + y * y)
    for k in range(3):
        sizes[k] = np.exp(np.float64(row[SCALE + k]))


@numba.njit(cache=True, fastmath=FUSED)
def _in_pixels(jacobian: Any, rotation: Any, r: Any, sizes: Any, t: Any, a: Any) -> None:
    """Write T = J W and A = T R diag(s), both (2, 3) by rows, so that the covariance is A A^T + 0.3."""
    for k in range(3):
        for i in range(0, 6, 3):
            t[i + k] = (
                jacobian[i] * rotation[0, k] + jacobian[i + 1] * rotation[1, k] + jacobian[i + 2] * rotation[2, k]
            )
    for k in range(3):
        for i in range(0, 6, 3):
            a[i + k] = (t[i] * r[k] + t[i + 1] * r[3 + k] + t[i + 2] * r[6 + k]) * sizes[k]


@numba.njit(parallel=True, cache=True, nogil=True, error_model="numpy")
def project(rows: Any, camera: Any, width: Any, height: Any, near: Any, footprints: Any, boxes: Any) -> None:
    """Project N Gaussians.

    Args:
        rows: (N, 11 + 3 K) float32.
        camera: rotation, translation, table, first and step, as width, height and near of a `SplatView`.
        footprints: (N, FOOTPRINT) float32, written where a Gaussian is seen.
        boxes: (N, 4) int32 of the pixels that a Gaussian reaches: x from, x to, y from, y to; equal where it is unseen.
    """
    rotation, translation, table, first, step = camera
    count, degree = len(rows), degree_of(rows.shape[1])
    centre = -(translation @ rotation)
    for block in numba.prange((count + _BLOCK - 1) // _BLOCK):
        point, values, lens, g, jacobian = np.empty(3), np.empty(16), np.empty(12), np.empty(6), np.empty(6)
        r, sizes, t, a = np.empty(9), np.empty(3), np.empty(6), np.empty(6)
        for n in range(block * _BLOCK, min(count, (block + 1) * _BLOCK)):
            row, box = rows[n], boxes[n]
            box[0], box[1], box[2], box[3] = 0, 0, 0, 0
            to_camera(row, rotation, translation, point)
            distance = np.sqrt(point[0] * point[0] + point[1] * point[1] + point[2] * point[2])
            if not distance > near or not project_point(point, table, first, step, lens, g, jacobian):
                continue
            u, v = lens[0], lens[6]
            if not (abs(u - 0.5 * width) < (0.5 + BEYOND) * width and abs(v - 0.5 * height) < (0.5 + BEYOND) * height):
                continue
            opacity = 1.0 / (1.0 + np.exp(-np.float64(row[LOGIT])))
            _axes(row, r, sizes)
            _in_pixels(jacobian, rotation, r, sizes, t, a)
            cxx = a[0] * a[0] + a[1] * a[1] + a[2] * a[2] + LOW_PASS
            cyy = a[3] * a[3] + a[4] * a[4] + a[5] * a[5] + LOW_PASS
            cxy = a[0] * a[3] + a[1] * a[4] + a[2] * a[5]
            inverse = 1.0 / (cxx * cyy - cxy * cxy)
            if not (opacity > SMALLEST_ALPHA and inverse > 0.0 and cxx * cyy < np.inf):
                continue
            # Alpha is at least 1/255 inside an ellipse, and this is its box.
            reach = 2.0 * np.log(opacity / SMALLEST_ALPHA)
            dx, dy = np.sqrt(reach * cxx), np.sqrt(reach * cyy)
            x0, x1 = max(0.0, np.floor(u - dx)), min(float(width), np.ceil(u + dx))
            y0, y1 = max(0.0, np.floor(v - dy)), min(float(height), np.ceil(v + dy))
            if not (x0 < x1 and y0 < y1):
                continue
            box[0], box[1], box[2], box[3] = int(x0), int(x1), int(y0), int(y1)
            f = footprints[n]
            f[0], f[1] = u, v
            f[2], f[3], f[4] = -0.5 * LOG2E * cyy * inverse, LOG2E * cxy * inverse, -0.5 * LOG2E * cxx * inverse
            f[5] = LOG2E * np.log(opacity)
            x, y, z = row[0] - centre[0], row[1] - centre[1], row[2] - centre[2]
            harmonics(degree, x / distance, y / distance, z / distance, values, 0, 1)
            for c in range(3):
                total = 0.5
                for k in range((degree + 1) ** 2):
                    total += values[k] * row[COLOUR + 3 * k + c]
                f[6 + c] = max(total, 0.0)
            f[9] = distance


@numba.njit(cache=True)
def degree_of(columns: Any) -> int:
    """Return the degree of the harmonics of rows with this many columns."""
    return int(np.sqrt((columns - COLOUR) // 3)) - 1
