"""A lens as a table: pixels of directions and their first two derivatives, the same code for every lens model.

A point p in camera axes has the stereographic coordinates s = (x, y) / (|p| + z), which are smooth for all directions
but straight behind. The table holds the coefficients of a bicubic B-spline of the pixel over s; it is twice
differentiable, as the gradient of a Jacobian requires.
"""

from typing import Any

import numba
import numpy as np


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
