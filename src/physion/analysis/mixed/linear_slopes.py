"""Restricted likelihood of a linear mixed model with random slopes.

The entries of A = Z Lambda change with the parameters, so that the sums are taken over all rows
again for each. With V = I + AA', H = I + A'A, fixed effects X, M = (X'V^-1 X)^-1 and
f = V^-1 (y - Xb), the derivative of the negative restricted log-likelihood by an entry of A, in row
i and column s, is

    (A H^-1)_is - sum_pr (V^-1 X)_ip M_pr (A'V^-1 X)_sr - f_i u_s / sigma^2.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from physion.analysis.mixed.factor import Factor
from physion.analysis.mixed.linear_model import LinearModel, Solution

Array = npt.NDArray[np.float64]


class SlopesModel(LinearModel):
    """Restricted likelihood of one design, with random slopes or correlated effects."""

    def solve(self, parameters: Array) -> Solution:
        """Solve for fixed and random effects at ``parameters``."""
        groupings, scale = self.random.at(parameters)
        factor = Factor(groupings, groupings.counts(), scale)
        both = groupings.sums(np.column_stack([self.x, self.y]))
        return self._solution(parameters, factor, both)

    def _gradient(self, solution: Solution, sigma2: float) -> Array:
        leverages = solution.factor.leverages(solution.factor.inverse())
        through_x = self._felt_x(solution) @ solution.unit_covariance
        by_entry = [
            leverage - np.einsum("np,np->n", through_x, solution.solved[rows])
            for rows, leverage in zip(self.groupings.rows, leverages, strict=True)
        ]
        return self.random.gradient(by_entry) - self.fall_of_rest(solution) / sigma2

    def fall_of_rest(self, solution: Solution) -> Array:
        """Return minus half the derivative of ``rest`` by each parameter."""
        groupings, scale = self.random.at(solution.parameters)
        felt = self.y - self.x @ solution.b - groupings.spread(scale * solution.u)
        return self.random.gradient([felt * solution.u[rows] for rows in groupings.rows])

    def covariance_changes(self, solution: Solution) -> list[Array]:
        """Return the derivatives of ``unit_covariance`` by each parameter."""
        felt_x, unit = self._felt_x(solution), solution.unit_covariance
        changes = []
        for k in range(len(solution.parameters)):
            column, c = self.random.basis(k)
            one = (felt_x * column[:, None]).T @ solution.solved[self.groupings.rows[c]]
            changes.append(unit @ (one + one.T) @ unit)
        return changes

    def _felt_x(self, solution: Solution) -> Array:
        """Return V^-1 X, shape (n, p)."""
        groupings, scale = self.random.at(solution.parameters)
        moved = [groupings.spread(scale * column) for column in solution.solved.T]
        return self.x - np.column_stack(moved)
