"""Linear mixed models with crossed random intercepts (restricted maximum likelihood).

As lme4::lmer with lmerTest: variances maximise the restricted likelihood, profiled over the
residual variance; t tests have Satterthwaite's degrees of freedom. Not statsmodels' MixedLM: it has
no degrees of freedom, and for crossed groups of this size does not finish in 300 s (``python
benchmarks/mixed.py --others``). Only sums by level and by pair of levels enter, so that the time
hardly depends on the number of rows.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import numpy.typing as npt
import pandas as pd

from physion.analysis.mixed.design import Design, build_design
from physion.analysis.mixed.factor import Factor
from physion.analysis.mixed.groupings import Groupings
from physion.analysis.mixed.optimum import Optimum, difference_gradient, find_optimum
from physion.analysis.mixed.result import MixedFit, collect
from physion.errors import BadInputError

Array = npt.NDArray[np.float64]


def fit_linear(formula: str, data: pd.DataFrame, level: float = 0.95) -> MixedFit:
    """Fit a linear mixed model such as ``log_rt ~ scenario + x + (1|participant) + (1|stimulus)``.

    The response is numeric, or True/False for the linear probability models of the paper
    (``model_correct ~ ...``). The table has t tests with Satterthwaite's degrees of freedom.
    ``level`` is that of the intervals.

    Rows with a missing value are left out, counted in ``missing`` and named in ``warnings``. Raises
    `BadInputError` for unknown columns, a constant response, a group of one level or with a level
    for each row, and fixed effects that depend on each other or explain everything.
    """
    design = build_design(formula, data)
    for group in design.groups:
        if group.levels >= len(design.y):
            raise BadInputError(
                f"{group.name!r} has as many levels as there are rows: its variance cannot be told "
                "from the residual one"
            )
    model = LinearModel(design)
    m = len(design.groups)
    scale = np.diag(0.5 / np.sqrt(np.array([group.levels for group in design.groups])))
    optimum = find_optimum(model.profiled, np.full(m, 0.5), scale, spreads=m)
    ratios = np.abs(optimum.at)
    solution = model.solve(ratios)
    return collect(
        design,
        kind="linear, restricted maximum likelihood",
        b=model.coefficients(solution),
        covariance=solution.sigma2 * model.backward(solution.unit_covariance),
        spreads=ratios * np.sqrt(solution.sigma2),
        log_likelihood=-optimum.value,
        effects=[(solution.scale * solution.u)[slot] for slot in model.groupings.slots],
        converged=optimum.converged,
        notes=[],
        level=level,
        residual=float(np.sqrt(solution.sigma2)),
        df=_satterthwaite(model, optimum),
    )


class Solution:
    """Estimates at given ratios of standard deviations to the residual one."""

    def __init__(self, model: LinearModel, ratios: Array) -> None:
        groupings = model.groupings
        self.scale = ratios[groupings.owner]
        self.factor = Factor(groupings, model.counts, self.scale)
        both = self.scale[:, None] * np.column_stack([model.zx, model.zy])
        solved = self.factor.solve(both)
        information = np.eye(model.p) - both[:, :-1].T @ solved[:, :-1]
        information = (information + information.T) / 2
        right = -both[:, :-1].T @ solved[:, -1]
        self.information = information
        self.unit_covariance = np.linalg.inv(information)
        self.b = self.unit_covariance @ right
        self.u = solved[:, -1] - solved[:, :-1] @ self.b
        # The least-squares part of the fixed effects is already subtracted from y: X'y is zero.
        self.rest = model.yy - float(both[:, -1] @ solved[:, -1]) - float(right @ self.b)
        self.sigma2 = self.rest / (model.n - model.p)
        # Z'V^-1 X and Z'V^-1 (y - Xb), in units of the residual variance.
        self.felt_x = model.zx - groupings.multiply(
            model.counts, self.scale[:, None] * solved[:, :-1]
        )
        moved = groupings.multiply(model.counts, self.scale * self.u)
        self.felt_y = model.zy - model.zx @ self.b - moved


class LinearModel:
    """Restricted likelihood of one design.

    Fixed effects are orthonormal (p columns), and their least-squares part is subtracted from y, so
    that neither large means nor units of columns cost precision.
    """

    def __init__(self, design: Design) -> None:
        self.n = len(design.y)
        orthonormal, self.triangle = np.linalg.qr(design.x)
        self.p = orthonormal.shape[1]
        self._least = orthonormal.T @ design.y
        y = design.y - orthonormal @ self._least
        self.yy = float(y @ y)
        if self.yy <= 1e-20 * float(design.y @ design.y):
            raise BadInputError(f"the fixed effects tell {design.response!r} exactly")
        self.groupings = Groupings([group.codes for group in design.groups])
        self.counts = self.groupings.counts()
        self.zx = self.groupings.sums(orthonormal)
        self.zy = self.groupings.sums(y)

    def solve(self, ratios: Array) -> Solution:
        """Solve for fixed and random effects at ``ratios`` (groupings,)."""
        return Solution(self, ratios)

    def coefficients(self, solution: Solution) -> Array:
        """Return the fixed effects of the original columns."""
        return np.asarray(np.linalg.solve(self.triangle, self._least + solution.b))

    def backward(self, matrix: npt.ArrayLike) -> Array:
        """Transform a covariance of the orthonormal columns to the original columns."""
        back = np.linalg.inv(self.triangle)
        return np.asarray(back @ matrix @ back.T)

    def profiled(self, ratios: Array) -> tuple[float, Array]:
        """Return the negative restricted log-likelihood at the best residual variance, and its
        gradient.
        """
        solution = self.solve(ratios)
        spare = self.n - self.p
        determinants = (
            solution.factor.log_determinant
            + np.linalg.slogdet(solution.information)[1]
            + 2 * np.log(np.abs(np.diag(self.triangle))).sum()
        )
        value = (determinants + spare * (1 + np.log(2 * np.pi * solution.sigma2))) / 2
        return float(value), self._slope(solution, ratios, solution.sigma2)

    def slope(self, ratios: Array, sigma2: float) -> Array:
        """Return the gradient by ``ratios`` at a given residual variance."""
        return self._slope(self.solve(ratios), ratios, sigma2)

    def _slope(self, solution: Solution, ratios: Array, sigma2: float) -> Array:
        inverse = solution.factor.inverse()
        through_x = self.groupings.by_grouping(
            np.einsum("qp,pr,qr->q", solution.felt_x, solution.unit_covariance, solution.felt_x)
        )
        through_y = self.groupings.by_grouping(solution.felt_y**2)
        return np.asarray(
            solution.factor.slopes(inverse) - ratios * (through_x + through_y / sigma2)
        )


def _satterthwaite(model: LinearModel, optimum: Optimum) -> Callable[[Array], float]:
    """Return a function from a contrast of the fixed effects to its degrees of freedom.

    2 v^2 / var(v) for the contrast's variance v. The variance of v comes from its slopes by the
    variance parameters (ratios, and the logarithm of the residual variance) and their covariance,
    the inverse of the observed information. Variances estimated as zero count as known.
    """
    ratios = np.abs(optimum.at)
    solution = model.solve(ratios)
    sigma2, free = solution.sigma2, np.flatnonzero(~optimum.zero)
    covariance = sigma2 * model.backward(solution.unit_covariance)
    slopes = [covariance]
    information = np.zeros((1 + len(free),) * 2)
    information[0, 0] = (model.n - model.p) / 2

    def gradient(at: Array) -> tuple[float, Array]:
        moved = ratios.copy()
        moved[free] = at
        return 0.0, model.slope(moved, sigma2)[free]

    size = 0.5 * np.maximum(ratios[free], 0.01)
    information[1:, 1:] = difference_gradient(gradient, ratios[free], size)
    through_y = model.groupings.by_grouping(solution.felt_y**2)
    for k in free:
        felt = solution.felt_x[model.groupings.owner == k]
        inner = solution.unit_covariance @ (felt.T @ felt) @ solution.unit_covariance
        slopes.append(2 * ratios[k] * sigma2 * model.backward(inner))
    information[0, 1:] = information[1:, 0] = (ratios * through_y)[free] / sigma2
    spread = np.linalg.pinv(information, hermitian=True)

    def degrees(contrast: Array) -> float:
        variance = float(contrast @ covariance @ contrast)
        slope = np.array([contrast @ one @ contrast for one in slopes])
        return 2 * variance**2 / float(slope @ spread @ slope)

    return degrees
