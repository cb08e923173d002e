"""Fits of mixed models with crossed random effects: `fit_linear` and `fit_logistic`.

In this order: the exact solution of the equations by blocks, a minimiser that proves its minimum,
the restricted likelihood of linear models, logistic models (Laplace approximation), random slopes,
and `fit_linear` with Satterthwaite's degrees of freedom.

With random effects b = Lambda u, u standard normal, Lambda the diagonal matrix of standard
deviations, every step needs H = I + Lambda Z'WZ Lambda. Its cost is (wide + narrow) * narrow^2
within each block of `Groupings`, which defines wide and narrow.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import pandas as pd
from scipy.linalg import cho_solve, cholesky
from scipy.optimize import minimize
from scipy.special import expit

from physion.analysis.mixed.design import (
    Counts,
    Design,
    Groupings,
    RandomEffects,
    build_design,
    refuse_separation,
)
from physion.analysis.mixed.result import MixedFit, collect
from physion.core.errors import BadInputError

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


# The minimum of a smooth function with a gradient, its curvature there, and proof that it is one.
#
# Standard deviations are searched over the whole line: the functions are even in them, so that a
# variance of zero, where others need a bound, is an ordinary minimum. So they are in the last
# diagonal entry of the triangle of correlated effects, which is zero for a correlation of 1.

Flags = npt.NDArray[np.bool_]
Objective = Callable[[Array], tuple[float, Array]]

STEP = 1e-3
"""Step of the differences of gradients, in units of a parameter's scale."""

CLOSE = 1e-6
"""Expected further decrease of the function below which the search has converged."""

SMALL = 0.05
"""Size of even parameters below which zero is tried as well."""


@dataclass(frozen=True)
class Optimum:
    """Result of the search; ``left`` is the expected decrease by a further Newton step, ``zero``
    (k,) whether an even parameter is zero.
    """

    at: Array
    value: float
    hessian: Array
    left: float
    zero: Flags

    @property
    def converged(self) -> bool:
        """Whether the curvature is positive definite and no further decrease is expected."""
        return bool(np.isfinite(self.left) and abs(self.left) < CLOSE)


def find_optimum(objective: Objective, start: Array, scale: Array, even: Flags) -> Optimum:
    """Minimise ``objective`` from ``start`` (k,); it is even in the parameters ``even`` (k,).

    ``scale`` is a matrix (k, k) whose columns are steps of about one standard error: the search is
    in their coordinates. Quasi-Newton first, then Newton steps on differences of the gradient,
    whose matrix is the Hessian that standard errors come from.
    """

    def scaled(z: Array) -> tuple[float, Array]:
        value, gradient = objective(start + scale @ z)
        return value, scale.T @ gradient

    options = {"gtol": 1e-4, "maxiter": 200}
    found = minimize(scaled, np.zeros(len(start)), jac=True, method="BFGS", options=options)
    at = start + scale @ found.x
    at[even] = np.abs(at[even])
    size = np.sqrt((scale**2).sum(axis=1))
    best = objective(at)
    for _ in range(4):
        at, best, zero = _try_zero(objective, at, best, even)
        hessian = difference_gradient(objective, at, size)
        step, left = _newton(hessian, best[1])
        step[zero] = 0.0
        trial = objective(at - step) if np.isfinite(left) else (np.inf, best[1])
        if trial[0] > best[0]:
            break
        at, best, before = at - step, trial, left
        left = _newton(hessian, best[1])[1]
        if before < CLOSE:
            break
    return Optimum(at, best[0], hessian, left, zero)


def _newton(hessian: Array, gradient: Array) -> tuple[Array, float]:
    """Return the Newton step and half of gradient times step; infinite if not positive definite."""
    if np.linalg.eigvalsh(hessian)[0] <= 0:
        return np.zeros_like(gradient), np.inf
    step = np.asarray(np.linalg.solve(hessian, gradient), dtype=np.float64)
    return step, float(gradient @ step) / 2


def _try_zero(
    objective: Objective, at: Array, best: tuple[float, Array], even: Flags
) -> tuple[Array, tuple[float, Array], Flags]:
    """Set small even parameters to zero if that does not increase the function."""
    zero = np.zeros(len(at), dtype=bool)
    for k in np.flatnonzero(even):
        if abs(at[k]) < SMALL:
            trial = at.copy()
            trial[k] = 0.0
            value, gradient = objective(trial)
            if value <= best[0] + 1e-9 * max(1.0, abs(best[0])) ** 0.5:
                at, best, zero[k] = trial, (value, gradient), True
    return at, best, zero


def difference_gradient(objective: Objective, at: Array, size: Array) -> Array:
    """Return the Hessian (k, k) by central differences of the gradient with steps of STEP *
    ``size``.
    """
    columns = []
    for k, step in enumerate(STEP * size):
        shift = np.zeros_like(at)
        shift[k] = step
        columns.append((objective(at + shift)[1] - objective(at - shift)[1]) / (2 * step))
    hessian = np.array(columns, dtype=np.float64)
    return np.asarray((hessian + hessian.T) / 2)


# Restricted likelihood of a linear mixed model with crossed random intercepts.
#
# Only sums by level and by pair of levels enter, so that the time hardly depends on the number of
# rows. `linear_slopes` has the model with random slopes.


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

    Parameters as in `RandomEffects`, in units of the residual standard deviation. Fixed
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


# Logistic regression with crossed random effects (maximum likelihood, Laplace approximation).
#
# Of the maintained fitters none is both fast and correct at the size of the study (800
# participants, 120 000 answers). ``python benchmarks/analysis/mixed.py --r --others`` compares
# them; its last results are in benchmarks/results/mixed.json. mixedlm and interlace-lme agree with
# this module and take one minute and three; GPBoost is fast, but stops early and gives standard
# errors of the fixed effects up to 65 % too small; lme-python's coefficients differ by 0.2 of a
# standard error, as lme4's with nAGQ = 0 would; statsmodels has Bayesian approximations
# only, which do not finish in 300 s; bambi samples; pymer4 needs R.
#
# The marginal likelihood of the fixed effects and standard deviations is, as in glmmTMB and
# lme4::glmer(nAGQ = 1), the integral of the normal distribution around the mode of the random
# effects. Its gradient is exact and includes the change of the mode and of the curvature. Standard
# errors come from the whole Hessian, so that they contain the uncertainty of the variances.

AT_MODE = 1e-17
"""Decrease of the objective by a Newton step below which the mode of the random effects is found.
The curvature there is part of the likelihood and is differenced, so the mode must be exact."""

FAR = 30.0
"""Largest standard deviation of random effects (logits) that the search considers."""


def fit_logistic(formula: str, data: pd.DataFrame, level: float = 0.95) -> MixedFit:
    """Fit a logistic mixed model such as ``correct ~ scenario + x + (1 + x|participant) +
    (1|stimulus)``.

    The response is a column of True/False or 0/1; `mixed.design` lists what formulas may contain.
    The table has Wald tests: statistic z, df infinite. ``level``: of the intervals.

    Rows with a missing value are left out, counted in ``missing`` and named in ``warnings``. Raises
    `BadInputError` for unknown columns, a response of one class, a group of one level, fixed
    effects that depend on each other, and for separation (a coefficient that would be infinite).
    """
    design = build_design(formula, data)
    if not np.isin(design.y, (0, 1)).all():
        raise BadInputError(f"{design.response!r} is not of two classes; give True/False or 0/1")
    refuse_separation(design)
    model = LogisticModel(design)
    even = np.concatenate([np.zeros(model.p, dtype=bool), model.random.even])
    optimum = find_optimum(model.objective, *model.start(), even)
    covariance = np.linalg.pinv(optimum.hessian, hermitian=True)[: model.p, : model.p]
    back = np.linalg.inv(model.triangle)
    at = optimum.at
    roots = model.random.roots(at[model.p :])
    return collect(
        design,
        kind="logistic, maximum likelihood (Laplace)",
        b=back @ at[: model.p],
        covariance=back @ covariance @ back.T,
        roots=roots,
        singular=model.random.singular(at[model.p :]),
        log_likelihood=-optimum.value,
        effects=model.effects(at),
        converged=optimum.converged,
        notes=_notes(design, roots),
        level=level,
    )


def _notes(design: Design, roots: Sequence[Array]) -> list[str]:
    """Return warnings of fits whose approximation is poor; ``roots`` from `RandomEffects.roots`."""
    wide = []
    for group, root in zip(design.groups, roots, strict=True):
        # The standard deviation of the effects over the rows, in logits.
        spread = float(np.sqrt(np.mean(((group.columns @ root) ** 2).sum(axis=1))))
        if spread > FAR / 6:
            wide.append(
                f"the standard deviation of {group.name!r} is {spread:.1f} logits: its levels "
                "answer almost all alike, and the Laplace approximation is not to be trusted"
            )
    few = [
        f"{group.name!r} has hardly more rows than levels: the Laplace approximation is poor"
        for group in design.groups
        if len(design.y) < 2 * group.levels * len(group.effects)
    ]
    return wide + few


class LogisticModel:
    """Negative Laplace log-likelihood of one design, with its gradient.

    Parameters: coefficients of the orthonormal fixed effects (p,), then of `RandomEffects`:
    standard deviations, if there are no slopes. Random effects are u of unit variance, by slot;
    each search starts at the last mode.
    """

    def __init__(self, design: Design) -> None:
        self.y = design.y
        orthonormal, triangle = np.linalg.qr(design.x)
        # Scaled like standardised columns, so that coefficients are near 1.
        self.x = np.ascontiguousarray(orthonormal * np.sqrt(len(self.y)))
        self.triangle = triangle / np.sqrt(len(self.y))
        self.p = self.x.shape[1]
        self.random = RandomEffects(design.groups)
        self.groupings = self.random.groupings
        self.u = np.zeros(self.groupings.q)

    def start(self) -> tuple[Array, Array]:
        """Return penalised quasi-likelihood estimates, and steps of one standard error as
        columns.
        """
        groupings, random = self.groupings, self.random
        beta, spread = np.zeros(self.p), np.ones(len(groupings.levels))
        for _ in range(12):
            before = spread
            matrix = random.at(random.from_diagonal(spread))
            for _ in range(3):
                beta, factor, information = self._joint_step(beta, matrix)
            diagonal = factor.inverse().diagonal
            used = np.asarray(groupings.levels) - groupings.by_grouping(diagonal)
            square = groupings.by_grouping(self.u**2)
            ratio = np.sqrt(square / np.maximum(used, 1e-8))
            # The scale of u changes with the deviation: b = scale * u stays.
            spread = np.clip(spread * ratio, 0.05, 5.0)
            self.u *= (before / spread)[groupings.owner]
            if np.abs(spread - before).max() < 0.02:
                break
        steps = np.zeros((self.p + len(random.levels),) * 2)
        steps[: self.p, : self.p] = np.linalg.cholesky(np.linalg.inv(information))
        tail = np.arange(self.p, len(steps))
        each = spread / np.sqrt(2 * np.maximum(used, 1.0))
        steps[tail, tail] = each[[r for r, _ in random.entry_of]]
        return np.concatenate([beta, random.from_diagonal(spread)]), steps

    def _joint_step(
        self, beta: Array, matrix: tuple[Groupings, Array]
    ) -> tuple[Array, Factor, Array]:
        """Take one Newton step for fixed and random effects together; changes ``u``.

        ``matrix``: groupings and scale from `RandomEffects.at`.
        """
        groupings, scale = matrix
        mean = expit(self.x @ beta + groupings.spread(scale * self.u))
        weight, residual = mean * (1 - mean), self.y - mean
        factor = Factor(groupings, groupings.counts(weight), scale)
        weighted = self.x * weight[:, None]
        mixed = scale[:, None] * groupings.sums(weighted)
        score = scale * groupings.sums(residual) - self.u
        solved = factor.solve(np.column_stack([mixed, score]))
        information = self.x.T @ weighted - mixed.T @ solved[:, :-1]
        step = np.linalg.solve(information, self.x.T @ residual - mixed.T @ solved[:, -1])
        self.u = self.u + solved[:, -1] - solved[:, :-1] @ step
        return beta + step, factor, information

    def _penalised(self, eta: Array, u: Array) -> float:
        return float(self.y @ eta - np.logaddexp(0, eta).sum() - u @ u / 2)

    def find_mode(self, beta: Array, matrix: tuple[Groupings, Array]) -> tuple[Array, Factor]:
        """Set ``u`` to its mode by Newton steps, halved if needed; return the logits there and
        H. ``matrix``: groupings and scale from `RandomEffects.at`.
        """
        groupings, scale = matrix
        fixed = self.x @ beta
        eta = fixed + groupings.spread(scale * self.u)
        height = self._penalised(eta, self.u)
        for _ in range(100):
            mean = expit(eta)
            factor = Factor(groupings, groupings.counts(mean * (1 - mean)), scale)
            score = scale * groupings.sums(self.y - mean) - self.u
            step = factor.solve(score)
            gain = float(score @ step)
            if gain < AT_MODE:
                break
            for _ in range(40):
                trial = self.u + step
                moved = fixed + groupings.spread(scale * trial)
                reached = self._penalised(moved, trial)
                if reached >= height - 1e-9 * abs(height):
                    break
                step = step / 2
            self.u, eta, height = trial, moved, reached
        return eta, factor

    def objective(self, at: Array) -> tuple[float, Array]:
        """Return the negative log-likelihood and its gradient at (coefficients, parameters of the
        random effects).
        """
        beta, parameters = at[: self.p], at[self.p :]
        if np.abs(parameters).max() > FAR:
            return np.inf, np.zeros_like(at)
        groupings, scale = matrix = self.random.at(parameters)
        eta, factor = self.find_mode(beta, matrix)
        mean = expit(eta)
        value = self._penalised(eta, self.u) - factor.log_determinant / 2
        leverages = factor.leverages(factor.inverse())
        residual, weight = self.y - mean, mean * (1 - mean)
        # How -log|H|/2 changes with the linear predictor of each row, the mode held.
        tilt = -0.5 * factor.at_rows(leverages) * weight * (1 - 2 * mean)
        # ... and through the mode, which moves with the parameters.
        pull = factor.solve(scale * groupings.sums(tilt))
        felt = residual + tilt - weight * groupings.spread(scale * pull)
        by_entry = [
            self.u[rows] * felt + pull[rows] * residual - weight * leverage
            for rows, leverage in zip(groupings.rows, leverages, strict=True)
        ]
        return -value, -np.concatenate([self.x.T @ felt, self.random.gradient(by_entry)])

    def effects(self, at: Array) -> list[Array]:
        """Return for each group the modes (levels, k) of its random effects, in logits."""
        self.find_mode(at[: self.p], self.random.at(at[self.p :]))
        return self.random.effects(at[self.p :], self.u)


# Restricted likelihood of a linear mixed model with random slopes.
#
# The entries of A = Z Lambda change with the parameters, so that the sums are taken over all rows
# again for each. With V = I + AA', H = I + A'A, fixed effects X, M = (X'V^-1 X)^-1 and f = V^-1 (y
# - Xb), the derivative of the negative restricted log-likelihood by an entry of A, in row i and
# column s, is
#
#     (A H^-1)_is - sum_pr (V^-1 X)_ip M_pr (A'V^-1 X)_sr - f_i u_s / sigma^2.


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


# Linear mixed models with crossed random effects (restricted maximum likelihood).
#
# As lme4::lmer with lmerTest: variances maximise the restricted likelihood, profiled over the
# residual variance; t tests have Satterthwaite's degrees of freedom. Not statsmodels' MixedLM: it
# has no degrees of freedom, and for crossed groups of this size does not finish in 300 s (``python
# benchmarks/analysis/mixed.py --others``).


def fit_linear(formula: str, data: pd.DataFrame, level: float = 0.95) -> MixedFit:
    """Fit a linear mixed model such as ``log_rt ~ scenario + x + (1 + x|participant) +
    (1|stimulus)``.

    The response is numeric, or True/False for the linear probability models of the paper
    (``model_correct ~ ...``). The table has t tests with Satterthwaite's degrees of freedom.
    ``level``: of the intervals.

    Rows with a missing value are left out, counted in ``missing`` and named in ``warnings``. Raises
    `BadInputError` for unknown columns, a constant response, a group of one level or with a level
    for each row, slopes of what does not vary within a level, and fixed effects that depend on each
    other or explain everything.
    """
    design = build_design(formula, data)
    for group in design.groups:
        if group.levels * len(group.effects) >= len(design.y):
            raise BadInputError(
                f"{group.name!r} has as many levels as there are rows: its variance "
                "cannot be estimated from the residual one"
                if len(group.effects) == 1
                else f"{group.name!r} has as many random effects as there are rows"
            )
    intercepts = all(group.intercept_alone for group in design.groups)
    model = LinearModel(design) if intercepts else SlopesModel(design)
    random = model.random
    scale = np.diag(0.5 / np.sqrt(random.levels))
    start = random.from_diagonal(np.full(len(random.diagonal), 0.5))
    optimum = find_optimum(model.profiled, start, scale, random.even)
    at = np.where(random.even, np.abs(optimum.at), optimum.at)
    solution = model.solve(at)
    sigma = float(np.sqrt(solution.sigma2))
    return collect(
        design,
        kind="linear, restricted maximum likelihood",
        b=model.coefficients(solution),
        covariance=solution.sigma2 * model.backward(solution.unit_covariance),
        roots=[root * sigma for root in random.roots(at)],
        singular=random.singular(at),
        log_likelihood=-optimum.value,
        effects=random.effects(at, solution.u),
        converged=optimum.converged,
        notes=[],
        level=level,
        residual=sigma,
        df=_satterthwaite(model, at, optimum),
    )


def _satterthwaite(model: LinearModel, at: Array, optimum: Optimum) -> Callable[[Array], float]:
    """Return a function from a contrast of the fixed effects to its degrees of freedom.

    2 v^2 / var(v) for the contrast's variance v. The variance of v comes from its slopes by the
    variance parameters (``at``, and the logarithm of the residual variance) and their covariance,
    the inverse of the observed information. Variances estimated as zero count as known.
    """
    solution = model.solve(at)
    sigma2, free = solution.sigma2, np.flatnonzero(~optimum.zero)
    covariance = sigma2 * model.backward(solution.unit_covariance)
    information = np.zeros((1 + len(free),) * 2)
    information[0, 0] = (model.n - model.p) / 2

    def gradient(values: Array) -> tuple[float, Array]:
        moved = at.copy()
        moved[free] = values
        return 0.0, model.gradient(moved, sigma2)[free]

    size = 0.5 * np.maximum(np.abs(at[free]), 0.01)
    information[1:, 1:] = difference_gradient(gradient, at[free], size)
    information[0, 1:] = information[1:, 0] = model.fall_of_rest(solution)[free] / sigma2
    changes = model.covariance_changes(solution)
    slopes = [covariance, *(sigma2 * model.backward(changes[k]) for k in free)]
    spread = np.linalg.pinv(information, hermitian=True)

    def degrees(contrast: Array) -> float:
        variance = float(contrast @ covariance @ contrast)
        slope = np.array([contrast @ one @ contrast for one in slopes])
        return 2 * variance**2 / float(slope @ spread @ slope)

    return degrees
