"""Random intercepts and slopes as functions of the parameters of their covariance.

Row i of grouping g has the effect z_i' b, with b normal for each level and cov(b) = L L', L lower
triangular. With b = L u and u standard normal, every column c of L is a grouping of its own, whose
entries in the matrix of random effects are a_ic = sum_r z_ir L_rc. So the equations of intercepts
(`factor`) hold unchanged (D. Bates et al., Fitting linear mixed-effects models using lme4, Journal
of Statistical Software 67, 2015, section 2).

The parameters are the entries of L, column by column, for columns z that are made orthonormal
within a group of correlated effects: neither the origin nor the unit of a slope matters to the
search. The sign of a column of L does not matter, so that the likelihood is even in the last
diagonal entry of each group, which stands alone in its column.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from physion.analysis.mixed.design import Group
from physion.analysis.mixed.groupings import Groupings

Array = npt.NDArray[np.float64]


class RandomEffects:
    """Random effects of a design: k effects of a group are k groupings of the same codes.

    - ``entry_of``: for each parameter the groupings (r, c) of its row and column of L;
    - ``diagonal``: the parameter on the diagonal of L for each grouping;
    - ``even``: whether the likelihood is even in each parameter;
    - ``levels``: of the group of each parameter.
    """

    def __init__(self, groups: Sequence[Group]) -> None:
        self._groups = groups
        codes = [group.codes for group in groups for _ in group.effects]
        self.groupings = Groupings(codes)
        self._intercepts = all(group.intercept_alone for group in groups)
        self._basis: list[Array] = []
        self._back: list[Array] = []
        entry_of: list[tuple[int, int]] = []
        even: list[bool] = []
        levels: list[int] = []
        for group in groups:
            first, k = len(self._basis), len(group.effects)
            basis, back = _orthonormal(group.columns)
            self._basis += list(np.ascontiguousarray(basis.T))
            self._back.append(back)
            entry_of += [(first + r, first + c) for c in range(k) for r in range(c, k)]
            even += [c == r == k - 1 for c in range(k) for r in range(c, k)]
            levels += [group.levels] * (k * (k + 1) // 2)
        self.entry_of = entry_of
        self.diagonal = np.array([entry_of.index((c, c)) for c in range(len(codes))])
        self.even = np.array(even)
        self.levels = np.array(levels)

    def from_diagonal(self, spread: Array) -> Array:
        """Return parameters of uncorrelated effects with standard deviations (groupings,)."""
        at = np.zeros(len(self.entry_of))
        at[self.diagonal] = spread
        return at

    def at(self, parameters: Array) -> tuple[Groupings, Array]:
        """Return groupings and a scale by slot (q,) whose product is Z Lambda."""
        if self._intercepts:
            return self.groupings, parameters[self.groupings.owner]
        values = [np.zeros(self.groupings.n) for _ in self._basis]
        for (r, c), one in zip(self.entry_of, parameters, strict=True):
            values[c] += one * self._basis[r]
        return self.groupings.with_values(values), np.ones(self.groupings.q)

    def gradient(self, by_entry: Sequence[Array]) -> Array:
        """Return derivatives by the parameters from those by the entries a_ic, (n,) for each c."""
        return np.array([self._basis[r] @ by_entry[c] for r, c in self.entry_of])

    def basis(self, parameter: int) -> tuple[Array, int]:
        """Return the change of the entries a_ic with ``parameter``, (n,), and the grouping c."""
        r, c = self.entry_of[parameter]
        return self._basis[r], c

    def roots(self, parameters: Array) -> list[Array]:
        """Return for each group the matrix B (k, k) with cov(b) = B B', for its own columns."""
        first, result = 0, []
        for group, back in zip(self._groups, self._back, strict=True):
            k = len(group.effects)
            root = np.zeros((k, k))
            for (r, c), one in zip(self.entry_of, parameters, strict=True):
                if first <= c < first + k:
                    root[r - first, c - first] = one
            result.append(np.asarray(np.linalg.solve(back, root), dtype=np.float64))
            first += k
        return result

    def effects(self, parameters: Array, u: Array) -> list[Array]:
        """Return for each group the effects (levels, k) of its levels at ``u`` (q,)."""
        first, result = 0, []
        for root in self.roots(parameters):
            slots = self.groupings.slots[first : first + len(root)]
            result.append(np.column_stack([u[slot] for slot in slots]) @ root.T)
            first += len(root)
        return result

    def singular(self, parameters: Array) -> list[bool]:
        """Return for each group whether its covariance is estimated as singular."""
        zero = parameters[self.diagonal] == 0
        ends = np.cumsum([len(group.effects) for group in self._groups])[:-1]
        return [bool(part.any()) for part in np.split(zero, ends)]


def _orthonormal(columns: Array) -> tuple[Array, Array]:
    """Return columns of mean square 1 at right angles, and ``back``: columns = basis @ back."""
    if columns.shape[1] == 1:
        size = np.sqrt(np.mean(columns**2, keepdims=True))
        return columns / size, size.reshape(1, 1)
    basis, back = np.linalg.qr(columns)
    size = np.sqrt(len(columns))
    return basis * size, back / size
