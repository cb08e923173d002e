"""Results of a fitted mixed model: tables of fixed and random effects, tests, and warnings."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt
import pandas as pd
from scipy import stats

from physion.analysis.mixed.design import Design
from physion.errors import UnknownNameError

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

    - ``table``: one row a fixed effect: ``term``, ``b``, ``se``, ``t`` (linear) or ``z``
      (logistic), ``df`` (Satterthwaite; infinite for z), ``p`` (two-sided), ``low``, ``high``;
    - ``random``: one row a grouping: ``group``, ``levels``, ``sd``; linear models end with the row
      ``residual`` (its levels are the rows of data);
    - ``log_likelihood``: restricted for linear models, so that it compares only models of the same
      fixed effects;
    - ``rows``: used; ``left_out``: left out for a missing value; ``missing``: by column;
    - ``singular``: a variance was estimated as zero; ``converged``: the optimum is one;
    - ``warnings``: in words, what a reader should know;
    - ``effects``: for each grouping the modes (means, if linear) of its random intercepts;
    - ``covariance``: of the fixed effects, in the order of the table.
    """

    formula: str
    kind: str
    table: pd.DataFrame
    random: pd.DataFrame
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

    @property
    def parameters(self) -> int:
        """Number of parameters: fixed effects and variances, including the residual one."""
        return len(self.table) + len(self.random)

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
        tables = [one.to_string(index=False, float_format=_short) for one in self._tables()]
        return "\n".join([*head, "", tables[0], "", tables[1], *self.warnings])

    def _tables(self) -> tuple[pd.DataFrame, pd.DataFrame]:
        return self.table, self.random


def _short(value: float) -> str:
    return f"{value:.4g}"


def _combine(each: Sequence[float]) -> float:
    """Return the second degree of freedom of F from those of its independent parts (as
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
    spreads: Array,
    log_likelihood: float,
    effects: Sequence[Array],
    converged: bool,
    notes: Sequence[str],
    level: float,
    residual: float | None = None,
    df: DegreesOfFreedom | None = None,
) -> MixedFit:
    """Collect tables and warnings of a fit; ``spreads`` are the standard deviations of the
    groupings.
    """
    variance = np.diag(covariance)
    # If the search failed, the curvature can be negative: no standard error then.
    se = np.sqrt(np.where(variance > 0, variance, np.nan))
    each = np.full(len(b), np.inf) if df is None else np.array([df(one) for one in np.eye(len(b))])
    statistic = b / se
    reach = stats.t.ppf(0.5 + level / 2, each) * se
    table = pd.DataFrame(
        {
            "term": design.names,
            "b": b,
            "se": se,
            "z" if df is None else "t": statistic,
            "df": each,
            "p": 2 * stats.t.sf(np.abs(statistic), each),
            "low": b - reach,
            "high": b + reach,
        }
    )
    names = [group.name for group in design.groups]
    levels = [group.levels for group in design.groups]
    sds = [abs(float(one)) for one in spreads]
    if residual is not None:
        names, levels, sds = [*names, "residual"], [*levels, len(design.y)], [*sds, residual]
    zero = [name for name, sd in zip(names, sds, strict=True) if sd == 0]
    return MixedFit(
        formula=design.formula,
        kind=kind,
        table=table,
        random=pd.DataFrame({"group": names, "levels": levels, "sd": sds}),
        log_likelihood=log_likelihood,
        rows=len(design.y),
        left_out=design.left_out,
        missing=dict(design.missing),
        converged=converged,
        singular=bool(zero),
        warnings=(*_warnings(design, zero, converged), *notes),
        covariance=covariance,
        effects={
            group.name: pd.Series(values, index=list(group.labels), name=group.name)
            for group, values in zip(design.groups, effects, strict=True)
        },
        terms=dict(design.terms),
        level=level,
        _df=df,
    )


def _warnings(design: Design, zero: Sequence[str], converged: bool) -> list[str]:
    found = []
    if design.left_out:
        each = ", ".join(f"{name} ({count})" for name, count in design.missing.items())
        total = design.left_out + len(design.y)
        found.append(f"{design.left_out} of {total} rows are left out for missing values: {each}")
    if zero:
        found.append(
            f"boundary (singular) fit: the variance of {' and '.join(zero)} is estimated as zero; "
            "the standard errors are those of the model without it"
        )
    if not converged:
        found.append("the search did not converge: do not use these numbers")
    return found
