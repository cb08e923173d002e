"""Logistic regression of answers with standard errors clustered by participant."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt
import pandas as pd
from scipy import stats

from physion.analysis.tables.csv_table import require_columns

COLUMNS = ("term", "b", "se", "z", "p", "low", "high", "rows", "clusters", "reason")


def clustered_logit(
    rows: pd.DataFrame,
    outcome: str,
    terms: Sequence[str],
    *,
    fixed: str | None = None,
    cluster: str = "participant",
    level: float = 0.95,
) -> pd.DataFrame:
    """Fit a logistic regression of a bool column on numeric ones; one row a term.

    Parameters
    ----------
    rows
        The table.
    outcome, terms
        Columns of the response and of the predictors.
    fixed
        Column whose every value gets an intercept of its own (the first is the base).
    cluster
        Column by which rows are dependent (sandwich estimate with the usual small-sample factor, as
        in statsmodels).
    level
        Level of the intervals.

    Returns
    -------
    ``term``, ``b`` (log odds), ``se``, ``z``, ``p`` (two-sided), ``low``, ``high`` (interval of b),
    ``rows``, ``clusters``, ``reason``. If a term is constant, or separates right from wrong
    perfectly, its numbers are NaN and the reason states it.
    """
    require_columns(rows, [outcome, cluster, *terms, *([fixed] if fixed else [])], "the rows")
    y = rows[outcome].to_numpy(dtype=np.float64)
    names, design = _design(rows, terms, fixed)
    groups = rows[cluster].astype("category").cat.codes.to_numpy()
    clusters = len(np.unique(groups))
    reason = _why_not(rows, y, design, terms, clusters)
    if not reason:
        b, covariance, converged = _fit(y, design, groups)
        if not converged or np.abs(b).max() > 15:
            reason = "a term separates the outcomes, or nearly so"
    if reason:
        b, covariance = np.full(len(names), np.nan), np.full((len(names),) * 2, np.nan)
    se = np.sqrt(np.diag(covariance))
    half = stats.norm.ppf(0.5 + level / 2) * se
    table = pd.DataFrame({"term": names, "b": b, "se": se, "z": b / se})
    table["p"] = 2 * stats.norm.sf(np.abs(table["z"]))
    return table.assign(
        low=b - half, high=b + half, rows=len(rows), clusters=clusters, reason=reason
    )[list(COLUMNS)]


def _design(
    rows: pd.DataFrame, terms: Sequence[str], fixed: str | None
) -> tuple[list[str], npt.NDArray[np.float64]]:
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
    y: npt.NDArray[np.float64],
    design: npt.NDArray[np.float64],
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
        return "one participant alone"
    if np.linalg.matrix_rank(design) < design.shape[1]:
        return "the terms cannot be told apart"
    return ""


def _fit(
    y: npt.NDArray[np.float64], design: npt.NDArray[np.float64], groups: npt.NDArray[np.int_]
) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.float64], bool]:
    import warnings

    from statsmodels.genmod.families import Binomial  # half a second to import
    from statsmodels.genmod.generalized_linear_model import GLM

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of separation, which the caller finds by the estimates
        fit = GLM(y, design, family=Binomial()).fit(cov_type="cluster", cov_kwds={"groups": groups})
    return np.asarray(fit.params), np.asarray(fit.cov_params()), bool(fit.converged)
