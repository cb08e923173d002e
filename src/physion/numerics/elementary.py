"""Elementary functions (sine, exponential, logarithm, ...), with the same bits on every processor.

IEEE 754 fixes the result of +, -, *, / and square root, but not of these functions: the C library
and numpy choose other algorithms, with other last bits, on other processors. Here each function is
a fixed sequence of those five operations: the argument is reduced to a short interval, and a Taylor
series of fixed length is summed there by Horner's rule (J.-M. Muller, "Elementary Functions", 3rd
edition, 2016). Sine, cosine, exponential and logarithm lie within 2 units in the last place of the
true value, the others within 6; see `power_of` for powers.

Kernels call the scalar functions (``sin_of``, ...); everyone else calls ``sin``, ..., which take
numbers or arrays of any shape and return float64.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, overload

import numpy as np
from numpy.typing import NDArray

from physion.numerics.kernel import kernel

PI = math.pi
HALF_PI_HIGH, HALF_PI_LOW = 1.5707963267948966, 6.123233995736766e-17
"""pi / 2 as the sum of two doubles."""
HALF_PI_1, HALF_PI_2 = float.fromhex("0x1.921fb544p+0"), float.fromhex("0x1.0b4611a6p-34")
HALF_PI_3 = float.fromhex("0x1.3198a2e037073p-69")
"""pi / 2 as the sum of three doubles; the first two have 33 bits, so that a multiple of them by
less than 2**20 is exact (reduction of Cody and Waite)."""
LARGEST_ANGLE = 1.6e6
"""Radians up to which sine, cosine and tangent are computed; beyond, they are NaN."""
LN2_HIGH, LN2_LOW = float.fromhex("0x1.62e42feep-1"), float.fromhex("0x1.a39ef35793c76p-33")
"""ln 2 as the sum of two doubles; a multiple of the first by less than 2**21 is exact."""
LOG2_E = 1.4426950408889634
LARGEST_EXPONENT, SMALLEST_EXPONENT = 709.782712893384, -745.1332191019412
"""Arguments beyond which the exponential overflows to infinity, or vanishes."""
POWERS_BELOW = 540
POWERS_OF_2 = np.array([2.0**k for k in range(-POWERS_BELOW, POWERS_BELOW + 1)])
"""Exact powers of 2; 2**k has the index k + `POWERS_BELOW`."""
ROOT_HALF = 0.7071067811865476
ARCTAN_EIGHTHS = np.array(
    [
        0.0,
        0.12435499454676144,
        0.24497866312686414,
        0.3587706702705722,
        0.4636476090008061,
        0.5585993153435624,
        0.6435011087932844,
        0.7188299996216245,
        0.7853981633974483,
    ]
)
"""Arc tangents of 0/8, 1/8, ..., 8/8."""


SINE = tuple((-1) ** k / math.factorial(2 * k + 1) for k in range(8, 0, -1))
"""Coefficients of x^17, x^15, ..., x^3 of the sine; the first term omitted is below 1e-19."""
COSINE = tuple((-1) ** k / math.factorial(2 * k) for k in range(9, 1, -1))
"""Coefficients of x^18, x^16, ..., x^4 of the cosine."""
EXPONENTIAL = tuple(1.0 / math.factorial(k) for k in range(14, 1, -1))
"""Coefficients of x^14, x^13, ..., x^2 of the exponential."""
LOGARITHM = tuple(1.0 / (2 * k + 1) for k in range(11, 0, -1))
"""Coefficients of s^22, s^20, ..., s^2 of log((1 + s) / (1 - s)) / (2 s)."""
COARSE_LOGARITHM = (-0.04514903, 0.14842661, -0.26717939, 0.44191704)
"""Coefficients of t^3, ..., 1 of (log2(1 + t) - t) / (t (1 - t)) for 0 <= t <= 1: chosen so
that the largest error of log2(1 + t) is smallest."""
ARCTANGENT = tuple((-1) ** k / (2 * k + 1) for k in range(7, 0, -1))
"""Coefficients of t^15, t^13, ..., t^3 of the arc tangent."""


@kernel
def _horner(coefficients: tuple[float, ...], z: float) -> float:
    """Return the value at ``z`` of a polynomial, given by its coefficients, highest power first."""
    total = 0.0
    for coefficient in coefficients:
        total = total * z + coefficient
    return total


@kernel
def _quarter_turns(angle: float) -> tuple[int, float, float]:
    """Split an angle into n quarter turns and the rest r + tail with |r| <= pi / 4.

    r = angle - n pi / 2, with pi / 2 as the sum of three doubles.
    """
    n = np.floor(angle * (2.0 / PI) + 0.5)
    first = (angle - n * HALF_PI_1) - n * HALF_PI_2
    correction = n * HALF_PI_3
    rest = first - correction
    return int(n), rest, (first - rest) - correction


@kernel
def _sine_of_rest(x: float, tail: float) -> float:
    """Return sin(x + tail) = x - x^3/3! + x^5/5! - ... + tail cos(x), for |x| <= pi / 4."""
    z = x * x
    return x + (x * z * _horner(SINE, z) + tail * (1.0 - 0.5 * z))


@kernel
def _cosine_of_rest(x: float, tail: float) -> float:
    """Return cos(x + tail) = 1 - x^2/2! + x^4/4! - ... - tail sin(x), for |x| <= pi / 4."""
    z = x * x
    half = 0.5 * z
    one = 1.0 - half
    # (1 - one) - half is the rounding error of 1 - half.
    return one + (((1.0 - one) - half) + (z * z * _horner(COSINE, z) - x * tail))


@kernel
def sin_of(angle: float) -> float:
    """Return the sine of an angle in radians; NaN beyond `LARGEST_ANGLE`."""
    if not abs(angle) <= LARGEST_ANGLE:
        return np.nan
    n, rest, tail = _quarter_turns(angle)
    value = _cosine_of_rest(rest, tail) if n & 1 else _sine_of_rest(rest, tail)
    return -value if n & 2 else value


@kernel
def cos_of(angle: float) -> float:
    """Return the cosine of an angle in radians; NaN beyond `LARGEST_ANGLE`."""
    if not abs(angle) <= LARGEST_ANGLE:
        return np.nan
    n, rest, tail = _quarter_turns(angle)
    value = _sine_of_rest(rest, tail) if n & 1 else _cosine_of_rest(rest, tail)
    return -value if (n + 1) & 2 else value


@kernel
def tan_of(angle: float) -> float:
    """Return the tangent of an angle in radians; NaN beyond `LARGEST_ANGLE`."""
    return sin_of(angle) / cos_of(angle)


@kernel
def arctan_of(x: float) -> float:
    """Return the arc tangent in radians, -pi/2 to pi/2.

    atan x = pi/2 - atan(1/x) for x > 1; atan x = atan c + atan((x - c) / (1 + x c)) with c the
    nearest eighth; then t - t^3/3 + t^5/5 - ... for |t| <= 1/16.
    """
    if np.isnan(x):
        return x
    size = abs(x)
    inverted = size > 1.0
    if inverted:
        size = 1.0 / size
    eighth = int(8.0 * size + 0.5)
    c = 0.125 * eighth
    t = (size - c) / (1.0 + size * c)
    z = t * t
    angle = ARCTAN_EIGHTHS[eighth] + (t + t * z * _horner(ARCTANGENT, z))
    if inverted:
        angle = HALF_PI_HIGH - (angle - HALF_PI_LOW)
    return float(-angle if x < 0.0 else angle)


@kernel
def arctan2_of(y: float, x: float) -> float:
    """Return the angle in radians, -pi to pi, of (x, y) to the x axis; 0 for the zero vector."""
    if np.isnan(x) or np.isnan(y):
        return np.nan
    if x == 0.0 and y == 0.0:
        return 0.0
    if abs(y) > abs(x):
        angle = HALF_PI_HIGH - (arctan_of(x / y) - HALF_PI_LOW)
        return angle - PI if y < 0.0 else angle
    angle = arctan_of(y / x)
    if x > 0.0:
        return angle
    return angle - PI if y < 0.0 else angle + PI


@kernel
def arcsin_of(x: float) -> float:
    """Return the arc sine in radians, -pi/2 to pi/2; NaN outside -1..1."""
    return arctan2_of(x, np.sqrt((1.0 - x) * (1.0 + x)))


@kernel
def arccos_of(x: float) -> float:
    """Return the arc cosine in radians, 0 to pi; NaN outside -1..1."""
    return arctan2_of(np.sqrt((1.0 - x) * (1.0 + x)), x)


@kernel
def exp_of(x: float) -> float:
    """Return the exponential function.

    exp x = 2^k exp r with k = round(x / ln 2) and |r| <= ln(2) / 2; then 1 + r + r^2/2! + ...
    """
    if np.isnan(x):
        return x
    if x > LARGEST_EXPONENT:
        return np.inf
    if x < SMALLEST_EXPONENT:
        return 0.0
    k = np.floor(x * LOG2_E + 0.5)
    high, low = x - k * LN2_HIGH, k * LN2_LOW
    r = high - low
    tail = (high - r) - low
    value = 1.0 + (r + (r * r * _horner(EXPONENTIAL, r) + tail))
    # In two steps, since 2^k itself may overflow where the result does not.
    half = int(k) // 2
    first = POWERS_OF_2[half + POWERS_BELOW]
    return float(value * first * POWERS_OF_2[int(k) - half + POWERS_BELOW])


@kernel
def log_of(x: float) -> float:
    """Return the natural logarithm; -infinity at 0, NaN below.

    log x = e ln 2 + log m with sqrt(1/2) <= m < sqrt(2); log m = 2 (s + s^3/3 + s^5/5 + ...) with
    s = (m - 1) / (m + 1).
    """
    if x == 0.0:
        return -np.inf
    if not x > 0.0:
        return np.nan
    if np.isinf(x):
        return x
    m, e = math.frexp(x)
    if m < ROOT_HALF:
        m, e = 2.0 * m, e - 1
    f = m - 1.0
    s = f / (2.0 + f)
    z = s * s
    # 2 s = f - s f, and f is exact.
    return e * LN2_HIGH + (f - (s * (f - 2.0 * z * _horner(LOGARITHM, z)) - e * LN2_LOW))


@kernel
def coarse_log2_of(x: float) -> float:
    """Return the logarithm to base 2 of a positive number, faster than `log_of`, within 2e-5.

    It is exact at powers of 2, and continuous.
    """
    m, e = math.frexp(x)
    t = 2.0 * m - 1.0
    return (e - 1) + (t + t * (1.0 - t) * _horner(COARSE_LOGARITHM, t))


@kernel
def tanh_of(x: float) -> float:
    """Return the hyperbolic tangent, (e^2x - 1) / (e^2x + 1)."""
    size = abs(x)
    if size > 20.0:
        value = 1.0
    elif size < 0.15:
        r = 2.0 * size
        grown = r + r * r * _horner(EXPONENTIAL, r)  # e^2x - 1 without cancellation
        value = grown / (grown + 2.0)
    else:
        value = 1.0 - 2.0 / (exp_of(2.0 * size) + 1.0)
    return -value if x < 0.0 else value


@kernel
def power_of(x: float, exponent: float) -> float:
    """``x`` >= 0 to any power, exp(exponent log x); its relative error grows with the logarithm of
    the result (1e-14 at e^100). NaN below 0."""
    if exponent == 0.0:
        return 1.0
    if x == 0.0:
        return 0.0 if exponent > 0.0 else np.inf
    return exp_of(exponent * log_of(x))


SIN, COS, TAN, ARCTAN, ARCSIN, ARCCOS, EXP, LOG, TANH = range(9)


@kernel
def _apply(function: int, values: NDArray[np.float64], results: NDArray[np.float64]) -> None:
    """Fill ``results`` (N,) with one of the functions above of ``values`` (N,)."""
    for i in range(len(values)):
        x = values[i]
        if function == SIN:
            results[i] = sin_of(x)
        elif function == COS:
            results[i] = cos_of(x)
        elif function == TAN:
            results[i] = tan_of(x)
        elif function == ARCTAN:
            results[i] = arctan_of(x)
        elif function == ARCSIN:
            results[i] = arcsin_of(x)
        elif function == ARCCOS:
            results[i] = arccos_of(x)
        elif function == EXP:
            results[i] = exp_of(x)
        elif function == LOG:
            results[i] = log_of(x)
        else:
            results[i] = tanh_of(x)


@kernel
def _apply_arctan2(
    ys: NDArray[np.float64], xs: NDArray[np.float64], results: NDArray[np.float64]
) -> None:
    """Fill ``results`` (N,) with the angles of the vectors (xs, ys)."""
    for i in range(len(ys)):
        results[i] = arctan2_of(ys[i], xs[i])


class Elementary:
    """One function of this module for numbers and for arrays of any shape.

    A number gives a float, an array an array of float64. ``scalar`` is the compiled function of
    one number, ``code`` its number in `_apply`.
    """

    def __init__(self, scalar: Callable[[float], float], code: int) -> None:
        self.__doc__ = scalar.__doc__
        self._scalar, self._code = scalar, code

    @overload
    def __call__(self, values: float) -> float: ...
    @overload
    def __call__(self, values: NDArray[Any]) -> NDArray[np.float64]: ...
    def __call__(self, values: float | NDArray[Any]) -> float | NDArray[np.float64]:
        """Return the function of every one of ``values``."""
        array = np.asarray(values, np.float64)
        if array.ndim == 0:
            return float(self._scalar(float(array)))
        results = np.empty(array.size)
        _apply(self._code, np.ascontiguousarray(array).reshape(-1), results)
        return results.reshape(array.shape)


sin, cos, tan = Elementary(sin_of, SIN), Elementary(cos_of, COS), Elementary(tan_of, TAN)
arctan, arcsin = Elementary(arctan_of, ARCTAN), Elementary(arcsin_of, ARCSIN)
arccos, tanh = Elementary(arccos_of, ARCCOS), Elementary(tanh_of, TANH)
exp, log = Elementary(exp_of, EXP), Elementary(log_of, LOG)


@overload
def arctan2(y: float, x: float) -> float: ...
@overload
def arctan2(y: NDArray[Any], x: NDArray[Any]) -> NDArray[np.float64]: ...
def arctan2(y: float | NDArray[Any], x: float | NDArray[Any]) -> float | NDArray[np.float64]:
    """Return `arctan2_of` numbers, or of arrays that broadcast."""
    if np.ndim(y) == 0 and np.ndim(x) == 0:
        return float(arctan2_of(float(y), float(x)))
    ys, xs = np.broadcast_arrays(np.asarray(y, np.float64), np.asarray(x, np.float64))
    results = np.empty(ys.size)
    _apply_arctan2(ys.ravel(), xs.ravel(), results)
    return results.reshape(ys.shape)


def power(values: NDArray[Any], exponent: float) -> NDArray[np.float64]:
    """Return `power_of` every one of ``values`` with one exponent, which is not 0."""
    assert exponent != 0.0, "the power of everything is 1"
    with np.errstate(over="ignore"):
        result = exp(exponent * log(np.asarray(values, np.float64)))
    return np.asarray(result)


# Normally distributed random numbers, with the same bytes on every processor.
#
# `numpy.random.Generator.normal` takes its tails from the C library's logarithm and exponential.
# Here uniform numbers, which depend on integers alone, are transformed as in Box and Muller
# (1958): sqrt(-2 ln u) cos(2 pi v) and sqrt(-2 ln u) sin(2 pi v).


def standard_normal(rng: np.random.Generator, shape: int | tuple[int, ...]) -> NDArray[np.float64]:
    """Draw an array of independent normal numbers with mean 0 and standard deviation 1."""
    size = (shape,) if isinstance(shape, int) else shape
    count = math.prod(size)
    pairs = rng.random((2, (count + 1) // 2))
    radius = np.sqrt(-2.0 * log(1.0 - pairs[0]))  # 1 - u is never 0
    angle = 2.0 * math.pi * pairs[1]
    return np.stack([radius * cos(angle), radius * sin(angle)]).reshape(-1)[:count].reshape(size)
