"""Exact solution of the equations of random intercepts by blocks, without a sparse solver.

With random effects b = Lambda u, u standard normal, Lambda the diagonal matrix of standard
deviations, every step needs H = I + Lambda Z'WZ Lambda. Its cost is (wide + narrow) * narrow^2
within each block of `Groupings`, which defines wide and narrow.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.linalg import cho_solve, cholesky

from physion.analysis.mixed.groupings import Counts, Groupings

Array = npt.NDArray[np.float64]


@dataclass(frozen=True)
class Inverse:
    """Parts of H^-1: its diagonal (q,), and by block wide x narrow and narrow x narrow."""

    diagonal: Array
    cross: list[Array]
    narrow: list[Array]


class Factor:
    """Factorisation of H = I + Lambda Z'WZ Lambda; ``scale`` is the diagonal of Lambda by slot
    (q,).
    """

    def __init__(self, groupings: Groupings, counts: Counts, scale: Array) -> None:
        self._groupings, self._counts, self._scale = groupings, counts, scale
        self._wide = 1 + scale[: groupings.q_wide] ** 2 * counts.wide
        self._places, self._ratio, self._lower = [], [], []
        self.log_determinant = float(np.log(self._wide).sum())
        for (wide, narrow), cross, square in groupings.blocks(counts):
            scaled = scale[wide, None] * cross * scale[narrow]
            ratio = scaled / self._wide[wide, None]
            schur = np.eye(len(square)) + scale[narrow, None] * square * scale[narrow]
            schur -= scaled.T @ ratio
            lower = cholesky(schur, lower=True, check_finite=False) if len(schur) else schur
            self.log_determinant += 2 * float(np.log(np.diag(lower)).sum())
            self._places.append((wide, narrow))
            self._ratio.append(ratio)
            self._lower.append(lower)

    def solve(self, right: Array) -> Array:
        """Return H^-1 times ``right``, of shape (q,) or (q, p)."""
        result = np.empty_like(right)
        for (wide, narrow), ratio, lower in self._parts():
            below = right[narrow] - ratio.T @ right[wide]
            solved = cho_solve((lower, True), below, check_finite=False) if len(lower) else below
            result[narrow] = solved
            result[wide] = (right[wide].T / self._wide[wide]).T - ratio @ solved
        return result

    def inverse(self) -> Inverse:
        """Return the parts of H^-1 for the cells that rows can fill."""
        diagonal, cross, square = np.empty(self._groupings.q), [], []
        for (wide, narrow), ratio, lower in self._parts():
            unit = np.eye(len(lower))
            inner = cho_solve((lower, True), unit, check_finite=False) if len(lower) else unit
            outer = ratio @ inner
            diagonal[narrow] = np.diag(inner)
            diagonal[wide] = 1 / self._wide[wide] + np.einsum("de,de->d", outer, ratio)
            cross.append(-outer)
            square.append(inner)
        return Inverse(diagonal, cross, square)

    def slopes(self, inverse: Inverse) -> Array:
        """Return half the derivative of log|H| by each grouping's standard deviation, (groupings,).

        It is the trace of that grouping's part of H^-1 Lambda Z'WZ, which is exact at zero.
        """
        scale, counts = self._scale, self._counts
        by_slot = np.empty(len(scale))
        by_slot[: self._groupings.q_wide] = (
            inverse.diagonal[: self._groupings.q_wide] * counts.wide
        ) * scale[: self._groupings.q_wide]
        blocks = self._groupings.blocks(counts)
        for k, ((wide, narrow), cross, square) in enumerate(blocks):
            linked = inverse.cross[k] * cross
            by_slot[wide] += linked @ scale[narrow]
            by_slot[narrow] = scale[wide] @ linked
            by_slot[narrow] += (inverse.narrow[k] * square) @ scale[narrow]
        return self._groupings.by_grouping(by_slot)

    def leverages(self, inverse: Inverse) -> list[Array]:
        """Return for each grouping the entries (n,) of Z Lambda H^-1 at each row and its level."""
        groupings = self._groupings
        entries = [groupings.entries(k, self._scale) for k in range(len(groupings.rows))]
        result = [
            entry * inverse.diagonal[rows]
            for entry, rows in zip(entries, groupings.rows, strict=True)
        ]
        cross = np.concatenate([block.ravel() for block in inverse.cross])
        square = np.concatenate([block.ravel() for block in inverse.narrow])
        linked = [(groupings.wide, k, cross[cells]) for k, cells in groupings.cells.items()]
        linked += [(k, m, square[pairs]) for (k, m), pairs in groupings.pairs.items() if k != m]
        for k, m, values in linked:
            result[k] += entries[m] * values
            result[m] += entries[k] * values
        return result

    def at_rows(self, leverages: list[Array]) -> Array:
        """Return z'Lambda H^-1 Lambda z for each row z of Z, shape (n,), from `leverages`."""
        total = np.zeros(self._groupings.n)
        for k, one in enumerate(leverages):
            total += self._groupings.entries(k, self._scale) * one
        return total

    def _parts(self) -> Iterator[tuple[tuple[slice, slice], Array, Array]]:
        return zip(self._places, self._ratio, self._lower, strict=True)
