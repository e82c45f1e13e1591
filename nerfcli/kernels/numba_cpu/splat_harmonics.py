"""Spherical harmonics of splat files up to degree 3 in a direction, and the gradient by the direction.

Values are in one array, `step` numbers apart from each other, from `at` on: of one direction, or of a vector of them.
Source: Sloan 2013, Efficient spherical harmonic evaluation, JCGT 2(2), appendix A2; signs as `splat_harmonics`.
"""

import math
from typing import Any

import numba
import numpy as np

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
