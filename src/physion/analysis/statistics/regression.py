"""Logistic regression of answers with standard errors by participant."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt
import pandas as pd
from scipy import special, stats

from physion.core.errors import BadInputError
from physion.core.tables import require_columns

Array = npt.NDArray[np.float64]


def check_probabilities(p: npt.ArrayLike, gaps: bool = False) -> None:
    """Raise `BadInputError` with the first value outside 0..1 (``gaps``: NaN is allowed)."""
    values = np.asarray(p, dtype=np.float64)
    good = (values >= 0) & (values <= 1) | (np.isnan(values) & gaps)
    if not good.all():
        index = tuple(int(i) for i in np.argwhere(~good)[0])
        raise BadInputError(f"probability {values[index]} at {index} does not lie in 0..1")


# Logistic regression of answers with standard errors clustered by participant.
#
# References
# ----------
# R. M. Bell and D. F. McCaffrey, *Bias reduction in standard errors for linear regression with
# multi-stage samples*, Survey Methodology 28, 2002, 169-181: the standard errors (CR2) and their
# degrees of freedom, which make intervals wide enough where few participants have a property.
# J. E. Pustejovsky and E. Tipton, *Small-sample methods for cluster-robust variance estimation and
# hypothesis testing in fixed effects models*, Journal of Business and Economic Statistics 36,
#   2018,
# 672-683: with weights.

COLUMNS = ("term", "b", "se", "t", "df", "p", "low", "high", "rows", "clusters", "reason")
ALONE = "a single participant determines it"


def clustered_logit(
    rows: pd.DataFrame,
    outcome: str,
    terms: Sequence[str],
    *,
    fixed: str | None = None,
    cluster: str = "participant",
    level: float = 0.95,
) -> pd.DataFrame:
    """Fit a logistic regression of a bool column on numeric ones; one row per term.

    Parameters
    ----------
    rows
        The table.
    outcome, terms
        Columns of the response and of the predictors.
    fixed
        Column whose every value gets an intercept of its own (the first is the base).
    cluster
        Column by which rows are dependent.
    level
        Level of the intervals.

    Returns
    -------
    ``term``, ``b`` (log odds), ``se``, ``t``, ``df``, ``p`` (two-sided), ``low``, ``high``
    (interval of b), ``rows``, ``clusters``, ``reason``. If a term is constant, or separates right
    from wrong perfectly, its numbers are NaN and the reason states it; if a single cluster
    determines it, there is no standard error.
    """
    require_columns(rows, [outcome, cluster, *terms, *([fixed] if fixed else [])], "the rows")
    y = rows[outcome].to_numpy(dtype=np.float64)
    names, design = _design(rows, terms, fixed)
    groups = rows[cluster].astype("category").cat.codes.to_numpy()
    clusters = len(np.unique(groups))
    reason = _why_not(rows, y, design, terms, clusters)
    b, se, df = (np.full(len(names), np.nan) for _ in range(3))
    if not reason:
        b, converged = _fit(y, design)
        if not converged or np.abs(b).max() > 15:
            reason, b = "a term separates the outcomes, or nearly so", np.full(len(names), np.nan)
        else:
            se, df = clustered_errors(y, design, groups, b)
    t = b / se
    half = special.stdtrit(df, 0.5 + level / 2) * se
    table = pd.DataFrame({"term": names, "b": b, "se": se, "t": t, "df": df})
    return table.assign(
        p=2 * stats.t.sf(np.abs(t), df),
        low=b - half,
        high=b + half,
        rows=len(rows),
        clusters=clusters,
        reason=[reason or (ALONE if np.isnan(one) else "") for one in se],
    )[list(COLUMNS)]


def clustered_errors(
    y: Array, design: Array, groups: npt.NDArray[np.int_], b: Array
) -> tuple[Array, Array]:
    """Return standard errors of logistic regression and their degrees of freedom.

    Parameters
    ----------
    y
        (n,): outcomes, 1 or 0.
    design
        (n, p): predictors.
    groups
        (n,): cluster of each row, 0 to G - 1.
    b
        (p,): the estimates.

    Returns
    -------
    se, df
        (p,); NaN for a coefficient that a single cluster determines.

    Notes
    -----
    With the fitted probabilities m, X = sqrt(m (1 - m)) times the design, e = (y - m) / sqrt(m (1 -
    m)) and M = (X'X)^-1, a cluster g changes the coefficients by M X_g' A_g e_g, where::

        A_g = (I - X_g M X_g')^(-1/2)

    makes the sum of squares of these changes an unbiased estimate of the variance if rows are
    independent. It is then a quadratic form in e with the matrix B, whose expectation is tr B and
    whose variance is 2 tr B^2; these are the moments of a chi-square with (tr B)^2 / tr B^2 degrees
    of freedom.
    """
    fitted = special.expit(design @ b)
    root_weight = np.sqrt(fitted * (1 - fitted))
    x, e = design * root_weight[:, None], (y - fitted) / root_weight
    half = np.linalg.cholesky(np.linalg.inv(x.T @ x))  # half half' = M
    part = x @ half
    size, p = int(groups.max()) + 1, part.shape[1]

    def total(values: Array) -> Array:
        return np.asarray(np.bincount(groups, values, minlength=size), dtype=np.float64)

    gram = np.empty((size, p, p))
    for i in range(p):
        for j in range(p):
            gram[:, i, j] = total(part[:, i] * part[:, j])
    residual = np.stack([total(part[:, i] * e) for i in range(p)], axis=1)
    leverage, vectors = np.linalg.eigh(gram)
    alone = leverage > 1 - 1e-9
    factor = 1 / np.sqrt(np.where(alone, 1.0, 1 - leverage))
    adjust = np.einsum("gij,gj,gkj->gik", vectors, factor, vectors)
    changes = np.einsum("ci,gij,gj->gc", half, adjust, residual)
    adjusted = np.einsum("gij,cj->gci", adjust, half)
    squares = np.einsum("gci,gij,gcj->gc", adjusted, gram, adjusted)
    across = np.einsum("gij,gcj->gci", gram, adjusted)
    df = np.empty(p)
    for c in range(p):
        form = np.diag(squares[:, c]) - across[:, c] @ across[:, c].T
        df[c] = np.trace(form) ** 2 / np.sum(form**2)
    in_direction = np.abs(np.einsum("gij,ci->gcj", vectors, half)) > 1e-9 * np.abs(half).max()
    lost = (in_direction & alone[:, None, :]).any(axis=(0, 2))
    return (
        np.where(lost, np.nan, np.sqrt(np.sum(changes**2, axis=0))),
        np.where(lost, np.nan, df),
    )


def _design(rows: pd.DataFrame, terms: Sequence[str], fixed: str | None) -> tuple[list[str], Array]:
    names, columns = ["(intercept)"], [np.ones(len(rows))]
    for term in terms:
        names.append(term)
        columns.append(rows[term].to_numpy(dtype=np.float64))
    if fixed:
        for value in sorted(rows[fixed].unique())[1:]:
            names.append(f"{fixed}: {value}")
            columns.append((rows[fixed] == value).to_numpy(dtype=np.float64))
    return names, np.column_stack(columns)


def _why_not(
    rows: pd.DataFrame,
    y: Array,
    design: Array,
    terms: Sequence[str],
    clusters: int,
) -> str:
    if not len(rows) or np.ptp(y) == 0:
        return "all answers are alike"
    if not np.isfinite(design).all():
        return "a term has missing values"
    constant = [term for term in terms if rows[term].nunique() < 2]
    if constant:
        return f"{', '.join(constant)} is the same in all rows"
    if clusters < 2:
        return "only one participant"
    if np.linalg.matrix_rank(design) < design.shape[1]:
        return "the terms cannot be distinguished"
    return ""


def _fit(y: Array, design: Array) -> tuple[Array, bool]:
    import warnings

    from statsmodels.genmod.families import Binomial  # half a second to import
    from statsmodels.genmod.generalized_linear_model import GLM

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of separation, which the caller finds by the estimates
        fit = GLM(y, design, family=Binomial()).fit()
    return np.asarray(fit.params), bool(fit.converged)
