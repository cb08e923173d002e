"""Restricted likelihood of a linear mixed model with crossed random intercepts.

Only sums by level and by pair of levels enter, so that the time hardly depends on the number of
rows. `linear_slopes` has the model with random slopes.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from physion.analysis.mixed.design import Design
from physion.analysis.mixed.factor import Factor
from physion.analysis.mixed.random_effects import RandomEffects
from physion.core.errors import BadInputError

Array = npt.NDArray[np.float64]


@dataclass(frozen=True)
class Solution:
    """Estimates at given parameters of the random effects.

    With A = Z Lambda for these parameters, V = I + AA' and orthonormal fixed effects X (n, p):
    ``solved`` (q, p) is A'V^-1 X, ``information`` (p, p) X'V^-1 X and ``unit_covariance`` its
    inverse, ``b`` the fixed effects, ``u`` (q,) the means of the random ones, ``rest`` the
    generalised sum of squares and ``sigma2`` the residual variance.
    """

    parameters: Array
    factor: Factor
    solved: Array
    information: Array
    unit_covariance: Array
    b: Array
    u: Array
    rest: float
    sigma2: float


class LinearModel:
    """Restricted likelihood of one design.

    Parameters are those of `RandomEffects`, in units of the residual standard deviation. Fixed
    effects are orthonormal (p columns), and their least-squares part is subtracted from y, so that
    neither large means nor units of columns cost precision.
    """

    def __init__(self, design: Design) -> None:
        self.n = len(design.y)
        self.x, self.triangle = np.linalg.qr(design.x)
        self.p = self.x.shape[1]
        self._least = self.x.T @ design.y
        self.y = design.y - self.x @ self._least
        self.yy = float(self.y @ self.y)
        if self.yy <= 1e-20 * float(design.y @ design.y):
            raise BadInputError(f"the fixed effects tell {design.response!r} exactly")
        self.random = RandomEffects(design.groups)
        self.groupings = self.random.groupings
        self.counts = self.groupings.counts()
        self.zx = self.groupings.sums(self.x)
        self.zy = self.groupings.sums(self.y)

    def solve(self, parameters: Array) -> Solution:
        """Solve for fixed and random effects at ``parameters``."""
        scale = parameters[self.groupings.owner]
        factor = Factor(self.groupings, self.counts, scale)
        return self._solution(
            parameters, factor, scale[:, None] * np.column_stack([self.zx, self.zy])
        )

    def _solution(self, parameters: Array, factor: Factor, both: Array) -> Solution:
        """Return the solution; ``both`` (q, p + 1): A'X and A'y."""
        solved = factor.solve(both)
        information = np.eye(self.p) - both[:, :-1].T @ solved[:, :-1]
        information = (information + information.T) / 2
        right = -both[:, :-1].T @ solved[:, -1]
        unit_covariance = np.asarray(np.linalg.inv(information), dtype=np.float64)
        b = unit_covariance @ right
        # The least-squares part of the fixed effects is already subtracted from y: X'y is zero.
        rest = self.yy - float(both[:, -1] @ solved[:, -1]) - float(right @ b)
        return Solution(
            parameters=parameters,
            factor=factor,
            solved=solved[:, :-1],
            information=information,
            unit_covariance=unit_covariance,
            b=b,
            u=solved[:, -1] - solved[:, :-1] @ b,
            rest=rest,
            sigma2=rest / (self.n - self.p),
        )

    def coefficients(self, solution: Solution) -> Array:
        """Return the fixed effects of the original columns."""
        return np.asarray(np.linalg.solve(self.triangle, self._least + solution.b))

    def backward(self, matrix: npt.ArrayLike) -> Array:
        """Transform a covariance of the orthonormal columns to the original columns."""
        back = np.linalg.inv(self.triangle)
        return np.asarray(back @ matrix @ back.T)

    def profiled(self, parameters: Array) -> tuple[float, Array]:
        """Return the negative restricted log-likelihood at the best residual variance, and its
        gradient.
        """
        solution = self.solve(parameters)
        spare = self.n - self.p
        determinants = (
            solution.factor.log_determinant
            + np.linalg.slogdet(solution.information)[1]
            + 2 * np.log(np.abs(np.diag(self.triangle))).sum()
        )
        value = (determinants + spare * (1 + np.log(2 * np.pi * solution.sigma2))) / 2
        return float(value), self._gradient(solution, solution.sigma2)

    def gradient(self, parameters: Array, sigma2: float) -> Array:
        """Return the gradient by ``parameters`` at a given residual variance."""
        return self._gradient(self.solve(parameters), sigma2)

    def _gradient(self, solution: Solution, sigma2: float) -> Array:
        felt_x = self._felt_x(solution)
        through_x = self.groupings.by_grouping(
            np.einsum("qp,pr,qr->q", felt_x, solution.unit_covariance, felt_x)
        )
        determinant = solution.factor.slopes(solution.factor.inverse())
        fall = self.fall_of_rest(solution) / sigma2
        return np.asarray(determinant - solution.parameters * through_x - fall)

    def fall_of_rest(self, solution: Solution) -> Array:
        """Return minus half the derivative of ``rest`` by each parameter."""
        scale = solution.parameters[self.groupings.owner]
        moved = self.groupings.multiply(self.counts, scale * solution.u)
        felt_y = self.zy - self.zx @ solution.b - moved
        return np.asarray(solution.parameters * self.groupings.by_grouping(felt_y**2))

    def covariance_changes(self, solution: Solution) -> list[Array]:
        """Return the derivatives of ``unit_covariance`` by each parameter."""
        felt_x, unit = self._felt_x(solution), solution.unit_covariance
        parts = [felt_x[self.groupings.owner == k] for k in range(len(solution.parameters))]
        return [
            2 * one * unit @ (felt.T @ felt) @ unit
            for one, felt in zip(solution.parameters, parts, strict=True)
        ]

    def _felt_x(self, solution: Solution) -> Array:
        """Return Z'V^-1 X, shape (q, p)."""
        scale = solution.parameters[self.groupings.owner]
        return self.zx - self.groupings.multiply(self.counts, scale[:, None] * solution.solved)
