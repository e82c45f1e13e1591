"""Gradient of the projection of splats: 16 Gaussians at a time, each step of the formulas for all of them at once.

LLVM vectorises the loops over the 16 lanes because all numbers are in one buffer at constant offsets, and because the
loops have no branch. One Gaussian after the other takes three times as long: every number waits for the one before.
Arithmetic is in float32, but for the lens, see `splat_projection`.
"""

from typing import Any

import numba
import numpy as np

from nerfcli.kernels.numba_cpu.exponential import exponential, sigmoid
from nerfcli.kernels.numba_cpu.splat_projection import (
    COLOUR,
    FUSED,
    LOG2E,
    LOGIT,
    MEAN,
    QUATERNION,
    SCALE,
    SUMS,
    harmonics,
    project_point,
    slopes_1,
    slopes_2,
    slopes_3,
    to_camera,
)
from nerfcli.kernels.numba_cpu.vector import LANES

# Offsets in the buffer: the point in camera axes, `lens` of `project_point`, the row, its sums, A, B and C of the
# footprint, 1 where a colour is above 0; then the direction of view, harmonics, and the gradient by the row.
_POINT, _LENS, _ROW, _SUMS, _SHAPE, _SHOWN = (LANES * at for at in (0, 3, 15, 74, 83, 86))
_VIEW, _HARMONICS, _OUT = (LANES * at for at in (89, 92, 108))
BUFFER = LANES * 167
_0, _1, _2 = np.float32(0), np.float32(1), np.float32(2)
_TO_CONIC = np.float32(-1 / LOG2E)


@numba.njit(cache=True, fastmath=FUSED, error_model="numpy")
def gather_lane(lane: Any, row: Any, footprint: Any, sums: Any, camera: Any, scratch: Any, buffer: Any) -> None:
    """Copy a Gaussian to a lane of the buffer; `sums` (slots, SUMS) are those of the tiles that it is in."""
    rotation, translation, table, first, step = camera
    point, lens, g, jacobian = scratch
    to_camera(row, rotation, translation, point)
    project_point(point, table, first, step, lens, g, jacobian)
    for k in range(3):
        buffer[_POINT + LANES * k + lane] = point[k]
        buffer[_SHAPE + LANES * k + lane] = footprint[2 + k]
        buffer[_SHOWN + LANES * k + lane] = _1 if footprint[6 + k] > _0 else _0
    for k in range(12):
        buffer[_LENS + LANES * k + lane] = lens[k]
    for k in range(len(row)):
        buffer[_ROW + LANES * k + lane] = row[k]
    for k in range(SUMS):
        total = 0.0
        for slot in range(len(sums)):
            total += sums[slot, k]
        buffer[_SUMS + LANES * k + lane] = total


@numba.njit(cache=True, inline="always")
def gradient_of_lane(buffer: Any, lane: Any, column: Any) -> Any:
    """Return d loss / d (column of the row) of a lane, after `gradients_of_lanes`."""
    return buffer[_OUT + LANES * column + lane]


@numba.njit(cache=True, fastmath=FUSED, error_model="numpy")
def gradients_of_lanes(buffer: Any, degree: Any, rotation: Any) -> None:
    """Write d loss / d row of all lanes.

        d loss / d centre = Q sum q d,  d loss / d covariance = Q (sum q d d^T) Q / 2,  Q the inverse covariance
        d loss / d logit = (1 - opacity) sum q

    With J = d pixel / d point, T = J W, A = T M, M = R diag(s), covariance = A A^T + 0.3:

        D = 2 d loss / d covariance A,  d loss / d M = T^T D,  d loss / d T = D M^T

    With s the stereographic coordinates of the point p, n = e_z + p / |p|, w = |p| + z, g_j = d s_j / d p =
    (e_j - s_j n) / w, U = d pixel / d s, J_i = sum_j U_ij g_j and G_j = sum_i U_ij d loss / d J_i:

        d loss / d U_ij = (d loss / d J_i) . g_j, which reaches p through the second derivatives of the lens
        d loss / d s_j = -G_j . n / w,  d loss / d n = -sum_j s_j G_j / w,  d loss / d w = -sum_j G_j . g_j / w
    """
    w00, w01, w02 = np.float32(rotation[0, 0]), np.float32(rotation[0, 1]), np.float32(rotation[0, 2])
    w10, w11, w12 = np.float32(rotation[1, 0]), np.float32(rotation[1, 1]), np.float32(rotation[1, 2])
    w20, w21, w22 = np.float32(rotation[2, 0]), np.float32(rotation[2, 1]), np.float32(rotation[2, 2])
    for i in range(np.uint64(LANES)):
        px, py, pz = buffer[_POINT + i], buffer[_POINT + LANES + i], buffer[_POINT + 2 * LANES + i]
        # The lens: its value is not needed.
        u1, u2 = buffer[_LENS + LANES + i], buffer[_LENS + 2 * LANES + i]
        u3, u4, u5 = buffer[_LENS + 3 * LANES + i], buffer[_LENS + 4 * LANES + i], buffer[_LENS + 5 * LANES + i]
        v1, v2 = buffer[_LENS + 7 * LANES + i], buffer[_LENS + 8 * LANES + i]
        v3, v4, v5 = buffer[_LENS + 9 * LANES + i], buffer[_LENS + 10 * LANES + i], buffer[_LENS + 11 * LANES + i]
        length = np.sqrt(px * px + py * py + pz * pz)
        il, iw = _1 / length, _1 / (length + pz)
        sx, sy = px * iw, py * iw
        rx, ry, rz = px * il, py * il, pz * il
        nz = _1 + rz
        gx0, gx1, gx2 = (_1 - sx * rx) * iw, -sx * ry * iw, -sx * nz * iw
        gy0, gy1, gy2 = -sy * rx * iw, (_1 - sy * ry) * iw, -sy * nz * iw
        j00, j01, j02 = u1 * gx0 + u2 * gy0, u1 * gx1 + u2 * gy1, u1 * gx2 + u2 * gy2
        j10, j11, j12 = v1 * gx0 + v2 * gy0, v1 * gx1 + v2 * gy1, v1 * gx2 + v2 * gy2
        t00, t01 = j00 * w00 + j01 * w10 + j02 * w20, j00 * w01 + j01 * w11 + j02 * w21
        t02 = j00 * w02 + j01 * w12 + j02 * w22
        t10, t11 = j10 * w00 + j11 * w10 + j12 * w20, j10 * w01 + j11 * w11 + j12 * w21
        t12 = j10 * w02 + j11 * w12 + j12 * w22
        # The Gaussian's axes.
        at = _ROW + LANES * QUATERNION + i
        qw, qx, qy, qz = buffer[at], buffer[at + LANES], buffer[at + 2 * LANES], buffer[at + 3 * LANES]
        inverse = _1 / np.sqrt(qw * qw + qx * qx + qy * qy + qz * qz)
        qw, qx, qy, qz = qw * inverse, qx * inverse, qy * inverse, qz * inverse
        r00, r01, r02 = _1 - _2 * (qy * qy + qz * qz), _2 * (qx * qy - qw * qz), _2 * (qx * qz + qw * qy)
        r10, r11, r12 = _2 * (qx * qy + qw * qz), _1 - _2 * (qx * qx + qz * qz), _2 * (qy * qz - qw * qx)
        r20, r21, r22 = _2 * (qx * qz - qw * qy), _2 * (qy * qz + qw * qx), _1 - _2 * (qx * qx + qy * qy)
        at = _ROW + LANES * SCALE + i
        s0, s1, s2 = exponential(buffer[at]), exponential(buffer[at + LANES]), exponential(buffer[at + 2 * LANES])
        a00, a01 = (t00 * r00 + t01 * r10 + t02 * r20) * s0, (t00 * r01 + t01 * r11 + t02 * r21) * s1
        a02 = (t00 * r02 + t01 * r12 + t02 * r22) * s2
        a10, a11 = (t10 * r00 + t11 * r10 + t12 * r20) * s0, (t10 * r01 + t11 * r11 + t12 * r21) * s1
        a12 = (t10 * r02 + t11 * r12 + t12 * r22) * s2
        # The inverse covariance (p, q, w): the footprint's exponent is -1/2 (p dx^2 + 2 q dx dy + w dy^2) / ln 2.
        p, q = _2 * _TO_CONIC * buffer[_SHAPE + i], _TO_CONIC * buffer[_SHAPE + LANES + i]
        w = _2 * _TO_CONIC * buffer[_SHAPE + 2 * LANES + i]
        at = _SUMS + i
        by_u = p * buffer[at + LANES] + q * buffer[at + 2 * LANES]
        by_v = q * buffer[at + LANES] + w * buffer[at + 2 * LANES]
        m00, m01, m11 = buffer[at + 3 * LANES], buffer[at + 4 * LANES], buffer[at + 5 * LANES]
        h00, h01, h10, h11 = p * m00 + q * m01, p * m01 + q * m11, q * m00 + w * m01, q * m01 + w * m11
        # Twice d loss / d covariance, and D.
        cxx, cxy, cyy = h00 * p + h01 * q, h00 * q + h01 * w, h10 * q + h11 * w
        d00, d01, d02 = cxx * a00 + cxy * a10, cxx * a01 + cxy * a11, cxx * a02 + cxy * a12
        d10, d11, d12 = cxy * a00 + cyy * a10, cxy * a01 + cyy * a11, cxy * a02 + cyy * a12
        # d loss / d R, and with it the sizes.
        e00, e10, e20 = (t00 * d00 + t10 * d10) * s0, (t01 * d00 + t11 * d10) * s0, (t02 * d00 + t12 * d10) * s0
        e01, e11, e21 = (t00 * d01 + t10 * d11) * s1, (t01 * d01 + t11 * d11) * s1, (t02 * d01 + t12 * d11) * s1
        e02, e12, e22 = (t00 * d02 + t10 * d12) * s2, (t01 * d02 + t11 * d12) * s2, (t02 * d02 + t12 * d12) * s2
        at = _OUT + LANES * SCALE + i
        buffer[at] = e00 * r00 + e10 * r10 + e20 * r20
        buffer[at + LANES] = e01 * r01 + e11 * r11 + e21 * r21
        buffer[at + 2 * LANES] = e02 * r02 + e12 * r12 + e22 * r22
        # The quaternion: d loss / d (its direction), normal to it.
        fx, fy, fz = e21 - e12, e02 - e20, e10 - e01
        xy, xz, yz = e01 + e10, e02 + e20, e12 + e21
        by_w = _2 * (qx * fx + qy * fy + qz * fz)
        by_x = _2 * (qy * xy + qz * xz + qw * fx - _2 * qx * (e11 + e22))
        by_y = _2 * (qx * xy + qz * yz + qw * fy - _2 * qy * (e00 + e22))
        by_z = _2 * (qx * xz + qy * yz + qw * fz - _2 * qz * (e00 + e11))
        along = by_w * qw + by_x * qx + by_y * qy + by_z * qz
        at = _OUT + LANES * QUATERNION + i
        buffer[at], buffer[at + LANES] = (by_w - along * qw) * inverse, (by_x - along * qx) * inverse
        buffer[at + 2 * LANES], buffer[at + 3 * LANES] = (by_y - along * qy) * inverse, (by_z - along * qz) * inverse
        buffer[_OUT + LANES * LOGIT + i] = buffer[_SUMS + i] * sigmoid(-buffer[_ROW + LANES * LOGIT + i])
        # d loss / d T = D M^T, d loss / d J = d loss / d T W^T.
        d00, d01, d02, d10, d11, d12 = d00 * s0, d01 * s1, d02 * s2, d10 * s0, d11 * s1, d12 * s2
        t00, t01 = d00 * r00 + d01 * r01 + d02 * r02, d00 * r10 + d01 * r11 + d02 * r12
        t02 = d00 * r20 + d01 * r21 + d02 * r22
        t10, t11 = d10 * r00 + d11 * r01 + d12 * r02, d10 * r10 + d11 * r11 + d12 * r12
        t12 = d10 * r20 + d11 * r21 + d12 * r22
        b00, b01 = t00 * w00 + t01 * w01 + t02 * w02, t00 * w10 + t01 * w11 + t02 * w12
        b02 = t00 * w20 + t01 * w21 + t02 * w22
        b10, b11 = t10 * w00 + t11 * w01 + t12 * w02, t10 * w10 + t11 * w11 + t12 * w12
        b12 = t10 * w20 + t11 * w21 + t12 * w22
        # The point: G, d loss / d U, d loss / d s, w and n.
        kx0, kx1, kx2 = u1 * b00 + v1 * b10, u1 * b01 + v1 * b11, u1 * b02 + v1 * b12
        ky0, ky1, ky2 = u2 * b00 + v2 * b10, u2 * b01 + v2 * b11, u2 * b02 + v2 * b12
        ux, uy = b00 * gx0 + b01 * gx1 + b02 * gx2, b00 * gy0 + b01 * gy1 + b02 * gy2
        vx, vy = b10 * gx0 + b11 * gx1 + b12 * gx2, b10 * gy0 + b11 * gy1 + b12 * gy2
        by_sx = ux * u3 + uy * u4 + vx * v3 + vy * v4 - (kx0 * rx + kx1 * ry + kx2 * nz) * iw
        by_sy = ux * u4 + uy * u5 + vx * v4 + vy * v5 - (ky0 * rx + ky1 * ry + ky2 * nz) * iw
        by_w = -(kx0 * gx0 + kx1 * gx1 + kx2 * gx2 + ky0 * gy0 + ky1 * gy1 + ky2 * gy2) * iw
        n0, n1, n2 = -(sx * kx0 + sy * ky0) * iw, -(sx * kx1 + sy * ky1) * iw, -(sx * kx2 + sy * ky2) * iw
        along = n0 * rx + n1 * ry + n2 * rz
        p0 = (n0 - along * rx) * il + by_w * rx + by_sx * gx0 + by_sy * gy0 + by_u * j00 + by_v * j10
        p1 = (n1 - along * ry) * il + by_w * ry + by_sx * gx1 + by_sy * gy1 + by_u * j01 + by_v * j11
        p2 = (n2 - along * rz) * il + by_w * nz + by_sx * gx2 + by_sy * gy2 + by_u * j02 + by_v * j12
        at = _OUT + LANES * MEAN + i
        buffer[at] = w00 * p0 + w10 * p1 + w20 * p2
        buffer[at + LANES] = w01 * p0 + w11 * p1 + w21 * p2
        buffer[at + 2 * LANES] = w02 * p0 + w12 * p1 + w22 * p2
    _colour_gradients(buffer, degree, rotation)


@numba.njit(cache=True, fastmath=FUSED, error_model="numpy")
def _colour_gradients(buffer: Any, degree: Any, rotation: Any) -> None:
    """Write d loss / d harmonics, and add what reaches the mean through the direction of view."""
    w00, w01, w02 = np.float32(rotation[0, 0]), np.float32(rotation[0, 1]), np.float32(rotation[0, 2])
    w10, w11, w12 = np.float32(rotation[1, 0]), np.float32(rotation[1, 1]), np.float32(rotation[1, 2])
    w20, w21, w22 = np.float32(rotation[2, 0]), np.float32(rotation[2, 1]), np.float32(rotation[2, 2])
    for i in range(np.uint64(LANES)):
        px, py, pz = buffer[_POINT + i], buffer[_POINT + LANES + i], buffer[_POINT + 2 * LANES + i]
        il = _1 / np.sqrt(px * px + py * py + pz * pz)
        buffer[_VIEW + i] = (w00 * px + w10 * py + w20 * pz) * il
        buffer[_VIEW + LANES + i] = (w01 * px + w11 * py + w21 * pz) * il
        buffer[_VIEW + 2 * LANES + i] = (w02 * px + w12 * py + w22 * pz) * il
    for i in range(np.uint64(LANES)):
        x, y, z = buffer[_VIEW + i], buffer[_VIEW + LANES + i], buffer[_VIEW + 2 * LANES + i]
        harmonics(degree, x, y, z, buffer, _HARMONICS + i, LANES)
    for k in range((degree + 1) ** 2):
        row, out, value = _ROW + LANES * (COLOUR + 3 * k), _OUT + LANES * (COLOUR + 3 * k), _HARMONICS + LANES * k
        for i in range(LANES):
            red = buffer[_SUMS + 6 * LANES + i] * buffer[_SHOWN + i]
            green = buffer[_SUMS + 7 * LANES + i] * buffer[_SHOWN + LANES + i]
            blue = buffer[_SUMS + 8 * LANES + i] * buffer[_SHOWN + 2 * LANES + i]
            y = buffer[value + i]
            # From here on, d loss / d harmonic stands in the place of the harmonic.
            by_y = red * buffer[row + i] + green * buffer[row + LANES + i] + blue * buffer[row + 2 * LANES + i]
            buffer[value + i] = by_y
            buffer[out + i], buffer[out + LANES + i], buffer[out + 2 * LANES + i] = y * red, y * green, y * blue
    if degree > 0:
        _add_slopes(buffer, 1)
    if degree > 1:
        _add_slopes(buffer, 2)
    if degree > 2:
        _add_slopes(buffer, 3)


@numba.njit(cache=True, fastmath=FUSED, error_model="numpy", inline="always")
def _add_slopes(buffer: Any, degree: Any) -> None:
    """Add to d loss / d mean what reaches it through the harmonics of one degree."""
    for i in range(np.uint64(LANES)):
        px, py, pz = buffer[_POINT + i], buffer[_POINT + LANES + i], buffer[_POINT + 2 * LANES + i]
        il = _1 / np.sqrt(px * px + py * py + pz * pz)
        x, y, z = buffer[_VIEW + i], buffer[_VIEW + LANES + i], buffer[_VIEW + 2 * LANES + i]
        if degree == 1:
            by_x, by_y, by_z = slopes_1(buffer, _HARMONICS + i, LANES)
        elif degree == 2:
            by_x, by_y, by_z = slopes_2(x, y, z, buffer, _HARMONICS + i, LANES)
        else:
            by_x, by_y, by_z = slopes_3(x, y, z, buffer, _HARMONICS + i, LANES)
        along = by_x * x + by_y * y + by_z * z
        buffer[_OUT + i] += (by_x - along * x) * il
        buffer[_OUT + LANES + i] += (by_y - along * y) * il
        buffer[_OUT + 2 * LANES + i] += (by_z - along * z) * il
