"""Logistic regression with crossed random effects (maximum likelihood, Laplace approximation).

Of the maintained fitters none is both fast and correct at the size of the study (800 participants,
120 000 answers). ``python benchmarks/analysis/mixed.py --r --others`` compares them; its last
results are in benchmarks/results/mixed.json. mixedlm and interlace-lme agree with this module and
take one minute and three; GPBoost is fast, but stops early and gives standard errors of the fixed
effects up to 65 % too small; lme-python's coefficients differ by 0.2 of a standard error, as those
of lme4 with nAGQ = 0 would; statsmodels has Bayesian approximations only, which do not finish in
300 s; bambi samples; pymer4 needs R.

The marginal likelihood of the fixed effects and standard deviations is, as in glmmTMB and
lme4::glmer(nAGQ = 1), that of the normal distribution around the mode of the random effects. Its
gradient is exact and includes the change of the mode and of the curvature. Standard errors come
from the whole Hessian, so that they contain the uncertainty of the variances.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt
import pandas as pd
from scipy.special import expit

from physion.analysis.mixed.design import Design, build_design
from physion.analysis.mixed.factor import Factor
from physion.analysis.mixed.groupings import Groupings
from physion.analysis.mixed.optimum import find_optimum
from physion.analysis.mixed.random_effects import RandomEffects
from physion.analysis.mixed.result import MixedFit, collect
from physion.analysis.mixed.separation import refuse_separation
from physion.core.errors import BadInputError

Array = npt.NDArray[np.float64]

AT_MODE = 1e-17
"""Decrease of the objective by a Newton step below which the mode of the random effects is found.
The curvature there is part of the likelihood and is differenced, so the mode must be exact."""

FAR = 30.0
"""Largest standard deviation of random effects (logits) that the search considers."""


def fit_logistic(formula: str, data: pd.DataFrame, level: float = 0.95) -> MixedFit:
    """Fit a logistic mixed model such as ``correct ~ scenario + x + (1 + x|participant) +
    (1|stimulus)``.

    The response is a column of True/False or 0/1; `mixed.formula` lists what formulas may contain.
    The table has Wald tests: statistic z, df infinite. ``level`` is that of the intervals.

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

    Parameters: coefficients of the orthonormal fixed effects (p,), then those of `RandomEffects`:
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
