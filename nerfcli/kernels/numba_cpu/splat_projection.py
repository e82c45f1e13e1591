"""Projection of Gaussian splats on CPU threads, and its gradient: see `reference.project_splats`.

Arithmetic is in float64; rows and footprints are float32. A row holds the parameters of a Gaussian from `MEAN` to
`COLOUR`, where its K harmonics begin, three channels each.
"""

from typing import Any

import numba
import numpy as np

from nerfcli.kernels.interface import BEYOND, LOW_PASS, SMALLEST_ALPHA
from nerfcli.kernels.numba_cpu.splat_harmonics import harmonics
from nerfcli.kernels.numba_cpu.splat_lens import project_point

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
