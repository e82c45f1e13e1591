"""Spherical harmonics of directions inside kernels: `kernels.spherical_harmonics` as a row of 16, and its gradient."""

import triton.language as tl

from nerfcli.kernels.triton_cuda.launch import jit


@jit
def harmonics(x, y, z, column, DEGREE: tl.constexpr):
    """Return harmonics (BLOCK, 16), 0 above DEGREE, of directions (BLOCK, 1); `column` (1, 16) counts from 0."""
    out = tl.broadcast_to(tl.where(column == 0, 0.28209479177387814, 0.0), (x.shape[0], 16))
    if DEGREE > 0:
        out = tl.where(column == 1, 0.4886025119029199 * y, out)
        out = tl.where(column == 2, 0.4886025119029199 * z, out)
        out = tl.where(column == 3, 0.4886025119029199 * x, out)
    if DEGREE > 1:
        out = tl.where(column == 4, 1.0925484305920792 * x * y, out)
        out = tl.where(column == 5, 1.0925484305920792 * y * z, out)
        out = tl.where(column == 6, 0.31539156525252005 * (3.0 * z * z - 1.0), out)
        out = tl.where(column == 7, 1.0925484305920792 * x * z, out)
        out = tl.where(column == 8, 0.5462742152960396 * (x * x - y * y), out)
    if DEGREE > 2:
        out = tl.where(column == 9, 0.5900435899266435 * y * (3.0 * x * x - y * y), out)
        out = tl.where(column == 10, 2.890611442640554 * x * y * z, out)
        out = tl.where(column == 11, 0.4570457994644658 * y * (5.0 * z * z - 1.0), out)
        out = tl.where(column == 12, 0.3731763325901154 * z * (5.0 * z * z - 3.0), out)
        out = tl.where(column == 13, 0.4570457994644658 * x * (5.0 * z * z - 1.0), out)
        out = tl.where(column == 14, 1.445305721320277 * z * (x * x - y * y), out)
        out = tl.where(column == 15, 0.5900435899266435 * x * (x * x - 3.0 * y * y), out)
    return out


@jit
def harmonics_slopes(x, y, z, column, DEGREE: tl.constexpr):
    """Return the derivatives (BLOCK, 16) of `harmonics` by x, by y and by z."""
    none = tl.where(column == 0, 0.0, 0.0) + x * 0.0
    dx, dy, dz = none, none, none
    if DEGREE > 0:
        dy = tl.where(column == 1, 0.4886025119029199, dy)
        dz = tl.where(column == 2, 0.4886025119029199, dz)
        dx = tl.where(column == 3, 0.4886025119029199, dx)
    if DEGREE > 1:
        dx = tl.where(column == 4, 1.0925484305920792 * y, dx)
        dy = tl.where(column == 4, 1.0925484305920792 * x, dy)
        dy = tl.where(column == 5, 1.0925484305920792 * z, dy)
        dz = tl.where(column == 5, 1.0925484305920792 * y, dz)
        dz = tl.where(column == 6, 1.8923493915151202 * z, dz)
        dx = tl.where(column == 7, 1.0925484305920792 * z, dx)
        dz = tl.where(column == 7, 1.0925484305920792 * x, dz)
        dx = tl.where(column == 8, 1.0925484305920792 * x, dx)
        dy = tl.where(column == 8, -1.0925484305920792 * y, dy)
    if DEGREE > 2:
        dx = tl.where(column == 9, 3.540261539559861 * x * y, dx)
        dy = tl.where(column == 9, 1.7701307697799304 * (x * x - y * y), dy)
        dx = tl.where(column == 10, 2.890611442640554 * y * z, dx)
        dy = tl.where(column == 10, 2.890611442640554 * x * z, dy)
        dz = tl.where(column == 10, 2.890611442640554 * x * y, dz)
        dy = tl.where(column == 11, 0.4570457994644658 * (5.0 * z * z - 1.0), dy)
        dz = tl.where(column == 11, 4.570457994644658 * y * z, dz)
        dz = tl.where(column == 12, 0.3731763325901154 * (15.0 * z * z - 3.0), dz)
        dx = tl.where(column == 13, 0.4570457994644658 * (5.0 * z * z - 1.0), dx)
        dz = tl.where(column == 13, 4.570457994644658 * x * z, dz)
        dx = tl.where(column == 14, 2.890611442640554 * x * z, dx)
        dy = tl.where(column == 14, -2.890611442640554 * y * z, dy)
        dz = tl.where(column == 14, 1.445305721320277 * (x * x - y * y), dz)
        dx = tl.where(column == 15, 1.7701307697799304 * (x * x - y * y), dx)
        dy = tl.where(column == 15, -3.540261539559861 * x * y, dy)
    return dx, dy, dz
