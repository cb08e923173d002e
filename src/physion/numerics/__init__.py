"""Arithmetic that gives the same bytes on every processor.

Everything from a seed to the stored bytes of a trial uses this package instead of BLAS, LAPACK,
the C library's mathematical functions and numpy's SIMD versions of them, which choose their
algorithms by processor.
"""
