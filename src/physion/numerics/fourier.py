"""Inverse Fourier transform of real images, with the same bytes on every processor.

Libraries take the roots of unity from the C library and choose the order of sums by processor.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from physion.numerics.elementary import cos, sin
from physion.numerics.kernel import kernel

C128 = NDArray[np.complex128]


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
