"""Gram matrices of standardised features, which are read in blocks of columns.

All that an L2 readout needs of n trials with d >> n features are the inner products of the trials.
Features may lie in files; a block of columns of all trials is in memory at a time.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from physion.errors import BadInputError
from physion.readout.features.stored_features import StoredFeatures

Array = NDArray[np.float64]
Rows = NDArray[np.int64]
Part = StoredFeatures | NDArray[Any]
Parts = Part | Sequence[Part]
"""Features (n, d) or (n, T, D) of n trials, or several that are joined in time."""

_READ_BYTES = 2**25
"""Bytes of features that are read at a time."""
_COLUMNS = 1024
"""Columns that are standardised at a time; they should fit into the cache of the processor."""
_GRAM_BYTES = 2**29
"""Bytes of Gram matrices that are summed up at a time; for more, features are read again."""


class JoinedFeatures:
    """Features (n, d) of n trials: parts flattened in time, one after the other.

    Parameters
    ----------
    parts
        Arrays or stored features with the same trials.
    name
        What the trials are, for messages.

    Raises
    ------
    BadInputError
        If the parts have other dimensions, or different numbers of trials.
    """

    def __init__(self, parts: Parts, name: str = "training") -> None:
        joined = [parts] if isinstance(parts, StoredFeatures | np.ndarray) else list(parts)
        shapes = [part.shape for part in joined]
        if not joined or any(len(s) not in (2, 3) or s[0] != shapes[0][0] for s in shapes):
            raise BadInputError(
                f"readout needs features (trials, features) or (trials, time, features) of equal "
                f"trials, not {', '.join(map(str, shapes)) or 'none'}"
            )
        self._parts = [
            part
            if isinstance(part, StoredFeatures)
            else part.reshape(len(part), math.prod(part.shape[1:]))
            for part in joined
        ]
        self._name = name

    @property
    def shape(self) -> tuple[int, int]:
        """Number of trials and of features."""
        return len(self._parts[0]), sum(_width(part) for part in self._parts)

    def columns(self, start: int, stop: int) -> NDArray[Any]:
        """Return columns ``start`` to ``stop``; raise `BadInputError` if one is not finite."""
        if 0 in self.shape:
            return np.zeros((self.shape[0], stop - start), np.float32)
        pieces = []
        for part in self._parts:
            width = _width(part)
            first, last = max(start, 0), min(stop, width)
            if first < last:
                pieces.append(
                    part.columns(first, last)
                    if isinstance(part, StoredFeatures)
                    else part[:, first:last]
                )
            start, stop = start - width, stop - width
        values = pieces[0] if len(pieces) == 1 else np.concatenate(pieces, axis=1)
        bad = np.flatnonzero(~np.isfinite(values).all(axis=1))
        if len(bad):
            raise BadInputError(
                f"readout: {self._name} trial {bad[0]} has a feature that is not finite"
            )
        return values

    def select(self, rows: Rows) -> JoinedFeatures:
        """Return the trials with the given row numbers."""
        chosen = [
            part.select(rows) if isinstance(part, StoredFeatures) else part[rows]
            for part in self._parts
        ]
        return JoinedFeatures(chosen, self._name)

    def array(self) -> NDArray[Any]:
        """Return all features, in memory."""
        return self.columns(0, self.shape[1])


@dataclass(frozen=True)
class Fit:
    """Rows of the trials on which a readout is ``fitted``, and of ``others`` it is applied to."""

    fitted: Rows
    others: Rows


def gram(features: Parts, fitted: Rows) -> Array:
    """Return inner products (n, k) of all trials with the ``fitted`` ones, standardised by these.

    Parameters
    ----------
    features
        Features of n trials.
    fitted
        Row numbers (k) of the trials that set mean and standard deviation of every feature.
        Features that are constant among them are ignored.
    """
    table = JoinedFeatures(features)
    others = np.setdiff1d(np.arange(table.shape[0]), fitted)
    ((within, across),) = grams([table], [Fit(fitted, others)])
    out = np.empty((table.shape[0], len(fitted)))
    out[fitted], out[others] = within, across
    return out


def grams(tables: Sequence[JoinedFeatures], fits: Sequence[Fit]) -> list[tuple[Array, Array]]:
    """Return the Gram matrices of several fits.

    Parameters
    ----------
    tables
        Features with the same columns. The rows of `Fit` count through all of them.
    fits
        Fits, each with its own standardisation by its fitted rows (k).

    Returns
    -------
    list
        For every fit the inner products (k, k) of the fitted rows, and (r, k) of the others with
        them.

    Notes
    -----
    Products are in float64. In float32 the errors, about 3e-9 of the largest eigenvalue, change
    probabilities by 1e-6 where features are noisy, but by 6e-4 at C = 1 where they are strongly
    correlated: then many eigenvalues are as small as the errors, and weak penalties depend on them.
    """
    count = sum(table.shape[0] for table in tables)
    at_once = max(1, _GRAM_BYTES // max(1, 8 * count * count))
    results = []
    for first in range(0, len(fits), at_once):
        results += _grams(tables, fits[first : first + at_once])
    return results


def _grams(tables: Sequence[JoinedFeatures], fits: Sequence[Fit]) -> list[tuple[Array, Array]]:
    sums = [
        (np.zeros((len(f.fitted), len(f.fitted))), np.zeros((len(f.others), len(f.fitted))))
        for f in fits
    ]
    for block in _blocks(tables):
        for fit, (within, across) in zip(fits, sums, strict=True):
            fitted, others = _standardise(block, fit)
            within += fitted @ fitted.T
            if len(others):
                across += others @ fitted.T
    return sums


def _standardise(block: Array, fit: Fit) -> tuple[Array, Array]:
    """Return the fitted and the other rows, standardised; constant columns become zero."""
    fitted, others = block[fit.fitted], block[fit.others]
    mean = fitted.mean(axis=0)
    fitted -= mean
    deviation = np.sqrt(np.einsum("ij,ij->j", fitted, fitted) / len(fitted))
    # Rounding leaves a constant column a deviation near, but not at, zero.
    varies = deviation > 1e-9 * np.maximum(np.abs(mean), 1e-30)
    scale = np.divide(1.0, deviation, out=np.zeros_like(deviation), where=varies)
    fitted *= scale
    others -= mean
    others *= scale
    return fitted, others


def _blocks(tables: Sequence[JoinedFeatures]) -> Iterator[Array]:
    """Yield the columns of all rows, some at a time, in float64."""
    count, width = sum(table.shape[0] for table in tables), tables[0].shape[1]
    step = max(1, _READ_BYTES // max(1, 4 * count) // _COLUMNS) * _COLUMNS
    for start in range(0, width, step):
        read = [table.columns(start, min(start + step, width)) for table in tables]
        for first in range(0, read[0].shape[1], _COLUMNS):
            yield np.concatenate(
                [values[:, first : first + _COLUMNS] for values in read], dtype=np.float64
            )


def _width(part: Part) -> int:
    return part.width if isinstance(part, StoredFeatures) else int(part.shape[1])
