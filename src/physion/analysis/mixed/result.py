"""Results of a fitted mixed model: tables of fixed and random effects, tests, and warnings."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt
import pandas as pd
from scipy import stats

from physion.analysis.mixed.design import INTERCEPT, Design, Group
from physion.core.errors import UnknownNameError

Array = npt.NDArray[np.float64]
DegreesOfFreedom = Callable[[Array], float]


@dataclass(frozen=True)
class JointTest:
    """Test that all coefficients of a term are zero: F with two degrees of freedom.

    Chi-square / df1 with infinite ``df2`` for logistic models.
    """

    term: str
    statistic: float
    df1: int
    df2: float
    p: float


@dataclass(frozen=True)
class MixedFit:
    """A fitted mixed model.

    - ``table``: one row per fixed effect: ``term``, ``b``, ``se``, ``t`` (linear) or ``z``
      (logistic), ``df`` (Satterthwaite; infinite for z), ``p`` (two-sided), ``low``, ``high``;
    - ``random``: one row per random effect: ``group``, ``effect`` (``Intercept`` or the column of a
      slope), ``levels``, ``sd``; linear models end with the row ``residual`` (its levels are the
      rows of data);
    - ``correlations``: one row per pair of correlated effects: ``group``, ``first``, ``second``,
      ``r`` (NaN if one does not vary);
    - ``log_likelihood``: restricted for linear models, so that it compares only models of the same
      fixed effects;
    - ``rows``: used; ``left_out``: left out for a missing value; ``missing``: by column;
    - ``singular``: a variance was estimated as zero, or a correlation as 1 or -1; ``converged``:
      the optimum is one;
    - ``warnings``: in words, what a reader should know;
    - ``effects``: modes (means, if linear) of the random effects by level: intercepts under the
      name of their grouping, slopes under ``GROUP: EFFECT``;
    - ``covariance``: of the fixed effects, in the order of the table.
    """

    formula: str
    kind: str
    table: pd.DataFrame
    random: pd.DataFrame
    correlations: pd.DataFrame
    log_likelihood: float
    rows: int
    left_out: int
    missing: Mapping[str, int]
    converged: bool
    singular: bool
    warnings: tuple[str, ...]
    covariance: Array
    effects: Mapping[str, pd.Series]
    terms: Mapping[str, tuple[int, ...]]
    level: float
    _df: DegreesOfFreedom | None = field(default=None, repr=False)

    def contrast(self, weights: npt.ArrayLike) -> pd.Series:
        """Test a linear combination of the fixed effects, with the columns of ``table``.

        ``weights``: of each fixed effect, in the order of the table.
        """
        one = np.atleast_2d(np.asarray(weights, dtype=np.float64))
        b = self.table["b"].to_numpy(dtype=np.float64)
        return _estimates(one, b, self.covariance, self._df, self.level).iloc[0]

    @property
    def parameters(self) -> int:
        """Number of parameters: fixed effects, variances with the residual one, correlations."""
        return len(self.table) + len(self.random) + len(self.correlations)

    def joint_test(self, term: str) -> JointTest:
        """Test that every coefficient of ``term`` is zero (Wald), others as in the model.

        For a model without interactions it is the test of `anova` in lmerTest (degrees of freedom
        combined as there); with interactions it depends on the coding of categories.
        """
        if term not in self.terms:
            raise UnknownNameError("term", term, self.terms)
        places = list(self.terms[term])
        b = self.table["b"].to_numpy(dtype=np.float64)[places]
        block = self.covariance[np.ix_(places, places)]
        values, vectors = np.linalg.eigh(block)
        parts = (vectors.T @ b) ** 2 / values
        statistic = float(parts.mean())
        df2 = float("inf")
        if self._df is not None:
            contrasts = np.zeros((len(places), len(self.covariance)))
            contrasts[:, places] = vectors.T
            df2 = _combine([self._df(contrast) for contrast in contrasts])
        p = float(
            stats.chi2.sf(statistic * len(places), len(places))
            if np.isinf(df2)
            else stats.f.sf(statistic, len(places), df2)
        )
        return JointTest(term, statistic, len(places), df2, p)

    def summary(self) -> str:
        """Return a page of text: formula, number of rows, both tables, and the warnings."""
        head = [
            f"{self.kind}: {self.formula}",
            f"{self.rows} rows ({self.left_out} left out), log-likelihood "
            f"{self.log_likelihood:.3f}, {'converged' if self.converged else 'NOT CONVERGED'}",
        ]
        tables = [self.table, self.random]
        if len(self.correlations):
            tables.append(self.correlations)
        texts = ["\n" + one.to_string(index=False, float_format=_short) for one in tables]
        return "\n".join([*head, *texts, *self.warnings])


def _short(value: float) -> str:
    return f"{value:.4g}"


def effect_name(group: str, effect: str) -> str:
    """Return the name of a random effect: an intercept has its group's name."""
    return f"{group}: {effect}" if effect not in (INTERCEPT, "") else group


def _combine(each: Sequence[float]) -> float:
    """Return the second degree of freedom of F from its independent parts (as
    lmerTest).
    """
    df = np.asarray(each, dtype=np.float64)
    if len(df) == 1 or np.ptp(df) < 1e-8:
        return float(df.mean())
    if (df <= 2).any():
        return 2.0
    expected = float((df / (df - 2)).sum())
    return 2 * expected / (expected - len(df))


def collect(
    design: Design,
    *,
    kind: str,
    b: Array,
    covariance: Array,
    roots: Sequence[Array],
    singular: Sequence[bool],
    log_likelihood: float,
    effects: Sequence[Array],
    converged: bool,
    notes: Sequence[str],
    level: float,
    residual: float | None = None,
    df: DegreesOfFreedom | None = None,
) -> MixedFit:
    """Collect tables and warnings of a fit.

    For each group: ``roots``, a matrix B with the covariance B B' of its effects; ``singular``,
    whether that is singular; ``effects`` (levels, k).
    """
    table = _estimates(np.eye(len(b)), b, covariance, df, level)
    table.insert(0, "term", design.names)
    random, correlations = _random_tables(design, roots)
    if residual is not None:
        random.loc[len(random)] = ["residual", "", len(design.y), residual]
    return MixedFit(
        formula=design.formula,
        kind=kind,
        table=table,
        random=random,
        correlations=correlations,
        log_likelihood=log_likelihood,
        rows=len(design.y),
        left_out=design.left_out,
        missing=dict(design.missing),
        converged=converged,
        singular=any(singular),
        warnings=(*_warnings(design, singular, converged), *notes),
        covariance=covariance,
        effects={
            name: pd.Series(values, index=list(group.labels), name=name)
            for group, by_level in zip(design.groups, effects, strict=True)
            for name, values in zip(_names(group), by_level.T, strict=True)
        },
        terms=dict(design.terms),
        level=level,
        _df=df,
    )


def _estimates(
    contrasts: Array, b: Array, covariance: Array, df: DegreesOfFreedom | None, level: float
) -> pd.DataFrame:
    """Return value, standard error, test and interval of each linear combination of ``b``."""
    variance = np.einsum("ij,jk,ik->i", contrasts, covariance, contrasts)
    # If the search failed, the curvature can be negative: no standard error then.
    se = np.sqrt(np.where(variance > 0, variance, np.nan))
    each = np.array([np.inf if df is None else df(one) for one in contrasts])
    value = contrasts @ b
    reach = stats.t.ppf(0.5 + level / 2, each) * se
    return pd.DataFrame(
        {
            "b": value,
            "se": se,
            "z" if df is None else "t": value / se,
            "df": each,
            "p": 2 * stats.t.sf(np.abs(value / se), each),
            "low": value - reach,
            "high": value + reach,
        }
    )


def _names(group: Group) -> list[str]:
    return [effect_name(group.name, effect) for effect in group.effects]


def _random_tables(design: Design, roots: Sequence[Array]) -> tuple[pd.DataFrame, pd.DataFrame]:
    """Return standard deviations of all random effects, and correlations within each group."""
    spreads, pairs = [], []
    for group, root in zip(design.groups, roots, strict=True):
        sd = np.sqrt((root**2).sum(axis=1))
        spreads += [
            (group.name, effect, group.levels, float(one))
            for effect, one in zip(group.effects, sd, strict=True)
        ]
        with np.errstate(invalid="ignore"):
            correlation = root @ root.T / np.outer(sd, sd)
        pairs += [
            (group.name, group.effects[j], group.effects[k], float(correlation[j, k]))
            for j in range(len(sd))
            for k in range(j + 1, len(sd))
        ]
    return (
        pd.DataFrame(spreads, columns=["group", "effect", "levels", "sd"]),
        pd.DataFrame(pairs, columns=["group", "first", "second", "r"]),
    )


def _warnings(design: Design, singular: Sequence[bool], converged: bool) -> list[str]:
    found = []
    if design.left_out:
        each = ", ".join(f"{name} ({count})" for name, count in design.missing.items())
        total = design.left_out + len(design.y)
        found.append(f"{design.left_out} of {total} rows are left out for missing values: {each}")
    lost = [group for group, one in zip(design.groups, singular, strict=True) if one]
    zero = [_names(group)[0] for group in lost if len(group.effects) == 1]
    if zero:
        found.append(
            f"boundary (singular) fit: the variance of {' and '.join(zero)} is estimated as zero; "
            "the standard errors belong to the model without it"
        )
    found += [
        f"boundary (singular) fit: the effects {' and '.join(group.effects)} of {group.name} are "
        "estimated as perfectly correlated or as constant; the data do not determine all of them, "
        f"so write them uncorrelated, (... || {group.name}), or leave one out"
        for group in lost
        if len(group.effects) > 1
    ]
    if not converged:
        hint = any(len(group.effects) > 1 for group in design.groups)
        found.append(
            "the search did not converge: do not use these numbers"
            + ("; try uncorrelated random effects, (... || group)" if hint else "")
        )
    return found
