"""The exponential and logistic functions in float32, without branches or calls, so that loops can be vectorised."""

from collections.abc import Callable
from typing import Any, cast

import numba
import numpy as np
from llvmlite import ir
from numba.core import types
from numba.extending import intrinsic


@intrinsic
def _float_of_bits(typing_context: Any, bits: Any) -> Any:

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        return builder.bitcast(args[0], ir.FloatType())

    return types.float32(types.int32), generate


float_of_bits: Callable[[Any], Any] = cast(Any, _float_of_bits)


@numba.njit(inline="always")
def exponential(x: Any) -> Any:
    """Return exp(x) to a relative error of 2e-7, with x clipped to [-87, 88]; NaN for NaN.

    x = n ln 2 + r with an integer n and |r| <= ln(2) / 2, where ln 2 is the sum of two floats, the first with few
    digits; exp(r) by a polynomial. Source: Moshier, Cephes Math Library, expf.c.
    """
    x = min(max(x, np.float32(-87)), np.float32(88))
    n = np.floor(x * np.float32(1.44269504088896341) + np.float32(0.5))
    r = x - n * np.float32(0.693359375) + n * np.float32(2.12194440e-4)
    y = np.float32(1.9875691500e-4)
    y = y * r + np.float32(1.3981999507e-3)
    y = y * r + np.float32(8.3334519073e-3)
    y = y * r + np.float32(4.1665795894e-2)
    y = y * r + np.float32(1.6666665459e-1)
    y = y * r + np.float32(5.0000001201e-1)
    y = y * r * r + r + np.float32(1)
    return y * float_of_bits(np.int32((np.int32(n) + np.int32(127)) << np.int32(23)))


@numba.njit(inline="always")
def sigmoid(x: Any) -> Any:
    """Return 1 / (1 + exp(-x)), at full precision in both tails."""
    tail = exponential(-abs(x))
    return (np.float32(1) if x >= 0 else tail) / (np.float32(1) + tail)


@numba.njit(inline="always")
def sigmoid_slope(x: Any) -> Any:
    """Return the derivative of `sigmoid`: value * (1 - value) would lose every digit near 1."""
    tail = exponential(-abs(x))
    return tail / ((np.float32(1) + tail) * (np.float32(1) + tail))


@numba.njit(inline="always")
def power_of_two(x: Any) -> Any:
    """Return 2^x to a relative error of 3e-7, with x clipped to [-126, 127]; NaN for NaN.

    2^x = 2^n 2^f with an integer n and |f| <= 1/2; 2^f by a polynomial, the best of its degree.
    """
    x = min(max(x, np.float32(-126)), np.float32(127))
    n = np.floor(x + np.float32(0.5))
    f = x - n
    y = np.float32(1.322539872e-3)
    y = y * f + np.float32(9.675668553e-3)
    y = y * f + np.float32(5.550863966e-2)
    y = y * f + np.float32(2.402213067e-1)
    y = y * f + np.float32(6.931469440e-1)
    y = y * f + np.float32(1)
    return y * float_of_bits(np.int32((np.int32(n) + np.int32(127)) << np.int32(23)))
