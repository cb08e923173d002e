"""Sums and products of small arrays in a fixed order, in place of BLAS and LAPACK.

BLAS chooses its kernel, and with it the order of a sum, by processor and by the shape of the
arrays. Here every sum runs over one axis from the first to the last entry. The inverse Fourier
transform is here for the same reason.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from physion.numerics.elementary import cos, sin
from physion.numerics.kernel import kernel

F64 = NDArray[np.float64]
C128 = NDArray[np.complex128]

SHORT = 8
"""Length of an axis up to which a loop over it is faster than `numpy.add.accumulate`."""


def ordered_sum(values: ArrayLike, axis: int = -1) -> F64:
    """Return the sum along ``axis``, added one after the other; 0 along an axis without entries."""
    array = np.asarray(values, np.float64)
    count = array.shape[axis]
    if count == 0:
        return np.zeros(np.delete(array.shape, axis))
    if count > SHORT:
        return np.asarray(np.add.accumulate(array, axis=axis).take(-1, axis=axis))
    entries = np.moveaxis(array, axis, 0)  # the same order, and faster on a short axis
    total = entries[0]
    for k in range(1, count):
        total = total + entries[k]
    return np.array(total)


def ordered_mean(values: ArrayLike, axis: int = -1) -> F64:
    """Return the mean along ``axis`` of a sum in order; NaN along an axis without entries."""
    array = np.asarray(values, np.float64)
    with np.errstate(invalid="ignore"):
        return np.asarray(ordered_sum(array, axis) / np.float64(array.shape[axis]))


def dot(a: ArrayLike, b: ArrayLike) -> F64:
    """Return the sums of products along the last axis of arrays that broadcast, (..., n)."""
    return ordered_sum(np.multiply(a, b, dtype=np.float64))


def norm(vectors: ArrayLike) -> F64:
    """Return the lengths (...) of vectors (..., n)."""
    return np.asarray(np.sqrt(dot(vectors, vectors)))


def unit(vectors: ArrayLike) -> F64:
    """Return vectors (..., n) divided by their lengths; NaN for a vector of length 0."""
    array = np.asarray(vectors, np.float64)
    with np.errstate(invalid="ignore"):
        return np.asarray(array / norm(array)[..., None])


def multiply(a: ArrayLike, b: ArrayLike) -> F64:
    """Return matrix products (..., n, m) of (..., n, k) and (..., k, m)."""
    left, right = np.asarray(a, np.float64), np.asarray(b, np.float64)
    total = left[..., :, 0, None] * right[..., None, 0, :]
    for k in range(1, left.shape[-1]):
        total = total + left[..., :, k, None] * right[..., None, k, :]
    return np.asarray(total)


def apply(matrix: ArrayLike, vectors: ArrayLike) -> F64:
    """Return matrices (..., m, n) times vectors (..., n), leading axes broadcast: (..., m).

    For points (P, 3) and one matrix (3, 3) this is ``points @ matrix.T``.
    """
    rows, columns = np.asarray(matrix, np.float64), np.asarray(vectors, np.float64)
    total = rows[..., :, 0] * columns[..., 0, None]
    for k in range(1, columns.shape[-1]):
        total = total + rows[..., :, k] * columns[..., k, None]
    return np.asarray(total)


def outer(a: ArrayLike, b: ArrayLike) -> F64:
    """Return the products (..., n, m) of all entries of vectors (..., n) and (..., m)."""
    left, right = np.asarray(a, np.float64), np.asarray(b, np.float64)
    return np.asarray(left[..., :, None] * right[..., None, :])


def cross(a: ArrayLike, b: ArrayLike) -> F64:
    """Return the vector products (..., 3) of vectors (..., 3).

    The bits are those of ``np.cross``, which takes ten times as long for short arrays.
    """
    left, right = np.asarray(a, np.float64), np.asarray(b, np.float64)
    out = np.empty(np.broadcast_shapes(left.shape, right.shape))
    for i in range(3):
        j, k = (i + 1) % 3, (i + 2) % 3
        out[..., i] = left[..., j] * right[..., k] - left[..., k] * right[..., j]
    return out


def determinant(matrices: ArrayLike) -> F64:
    """Return the determinants (...) of matrices (..., 3, 3), a . (b x c) of their rows."""
    m = np.asarray(matrices, np.float64)
    return dot(m[..., 0, :], cross(m[..., 1, :], m[..., 2, :]))


@kernel
def inverse(m: Any) -> Any:
    """Return the inverse (3, 3) of a matrix (3, 3), its adjugate over its determinant.

    Infinite or NaN entries for a singular matrix.
    """
    adjugate = np.empty((3, 3))
    for i in range(3):
        for j in range(3):
            a, b = (j + 1) % 3, (j + 2) % 3
            c, d = (i + 1) % 3, (i + 2) % 3
            adjugate[i, j] = m[a, c] * m[b, d] - m[a, d] * m[b, c]
    size = m[0, 0] * adjugate[0, 0] + m[0, 1] * adjugate[1, 0] + m[0, 2] * adjugate[2, 0]
    for i in range(3):
        for j in range(3):
            adjugate[i, j] /= size
    return adjugate


# Inverse Fourier transform of real images, with the same bytes on every processor.
#
# Libraries take the roots of unity from the C library and choose the order of sums by processor.


def inverse_real_transform(spectrum: C128) -> NDArray[np.float64]:
    """Return the real image (N, N) whose half spectrum is ``spectrum`` (N, N / 2 + 1).

    The convention is that of `numpy.fft.irfft2`; N is a power of 2.

    Notes
    -----
    x[m, n] = 1/N^2 sum over (k, l) of X[k, l] exp(2 pi i (k m + l n) / N), where
    X[-k, -l] is the conjugate of X[k, l].
    """
    side = len(spectrum)
    assert side & (side - 1) == 0 and spectrum.shape == (side, side // 2 + 1)
    roots = np.arange(side // 2) * (2.0 * math.pi / side)
    roots_of_unity = cos(roots) + 1j * sin(roots)
    full = np.empty((side, side), np.complex128)
    full[:, : side // 2 + 1] = spectrum
    mirrored = np.arange(side // 2 + 1, side)
    opposite = (-np.arange(side)) % side
    full[:, mirrored] = np.conj(spectrum[opposite][:, side - mirrored])
    _transform_rows(full, roots_of_unity)
    full = np.ascontiguousarray(full.T)
    _transform_rows(full, roots_of_unity)
    return np.ascontiguousarray(full.real.T) / side**2


@kernel
def _transform_rows(rows: C128, roots: C128) -> None:
    """Replace every row (N,) by its unscaled inverse transform.

    Parameters
    ----------
    rows : (M, N)
        Changed in place; N is a power of 2.
    roots : (N / 2,)
        exp(2 pi i k / N) for k = 0, 1, ...

    Notes
    -----
    The algorithm is that of Cooley and Tukey (1965), radix 2. Complex products are written out,
    because compilers may evaluate them in more than one way.
    """
    side = rows.shape[1]
    for r in range(len(rows)):
        row = rows[r]
        # Bit reversal: swap every entry with the one whose index has its binary digits reversed.
        j = 0
        for i in range(1, side):
            bit = side >> 1
            while j & bit:
                j ^= bit
                bit >>= 1
            j |= bit
            if i < j:
                row[i], row[j] = row[j], row[i]
        half = 1
        while half < side:
            stride = side // (2 * half)
            for start in range(0, side, 2 * half):
                for k in range(half):
                    w, a, b = roots[k * stride], row[start + k], row[start + k + half]
                    real = w.real * b.real - w.imag * b.imag
                    imag = w.real * b.imag + w.imag * b.real
                    row[start + k] = complex(a.real + real, a.imag + imag)
                    row[start + k + half] = complex(a.real - real, a.imag - imag)
            half *= 2
