"""Mixed models with crossed random intercepts: `fit_linear` and `fit_logistic`.

The package mixedlm fits them, as lme4 does in R. This module checks the input and adds what mixedlm
lacks: standard errors of logistic models from the curvature of the likelihood, as lme4 and
glmmTMB have them (mixedlm takes the variances as known, for errors up to 2 % too small), and
Satterthwaite's degrees of freedom of contrasts and joint tests, as in lmerTest.

Formula: ``y ~ a + b * c + (1|group) + (1|first/second)``. Fixed effects are columns: numbers as
they are, True as 1, text and categories against the first level. A column whose name has blanks is
quoted with backticks.
"""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from itertools import product
from typing import Any

import numpy as np
import numpy.typing as npt
import pandas as pd
from scipy import stats
from scipy.linalg import null_space

from physion.analysis.intervals import LEVEL
from physion.core.errors import BadInputError, UnknownNameError

Array = npt.NDArray[np.float64]

INTERCEPT = "Intercept"

ZERO = 1e-4
"""Standard deviation, relative to the residual one, below which it is estimated as zero."""

FAR = 8.0
"""Standard deviation of random intercepts, in logits, of levels that answer almost all alike."""

UNKNOWN = 300.0
"""Standard error of an effect over the range of its column, in logits, that separation causes."""


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
    - ``random``: one row per grouping: ``group``, ``levels``, ``sd``; linear models end with the
      row ``residual`` (its levels are the rows of data);
    - ``log_likelihood``: restricted for linear models, so that it compares only models of the same
      fixed effects;
    - ``rows``: used; ``left_out``: left out for a missing value;
    - ``singular``: a variance was estimated as zero; ``converged``: the search ended at an optimum;
    - ``warnings``: in words, what a reader should know;
    - ``covariance``: of the fixed effects, in the order of the table; ``terms``: rows of the table
      by term of the formula.
    """

    formula: str
    table: pd.DataFrame
    random: pd.DataFrame
    log_likelihood: float
    rows: int
    left_out: int
    converged: bool
    singular: bool
    warnings: tuple[str, ...]
    covariance: Array
    terms: Mapping[str, tuple[int, ...]]
    _linear: Any = field(default=None, repr=False)

    def contrast(self, weights: npt.ArrayLike) -> pd.Series:
        """Test a linear combination of the fixed effects, with the columns of ``table``.

        ``weights``: of each fixed effect, in the order of the table.
        """
        one = np.atleast_2d(np.asarray(weights, dtype=np.float64))
        b = self.table["b"].to_numpy(dtype=np.float64)
        return _estimates(one, b, self.covariance, self._linear).iloc[0]

    def joint_test(self, term: str) -> JointTest:
        """Test that every coefficient of ``term`` is zero (Wald), others as in the model.

        For a model without interactions it is the test of `anova` in lmerTest (degrees of freedom
        combined as there); with interactions it depends on the coding of categories.
        """
        if term not in self.terms:
            raise UnknownNameError("term", term, self.terms)
        places = list(self.terms[term])
        values, vectors = np.linalg.eigh(self.covariance[np.ix_(places, places)])
        b = self.table["b"].to_numpy(dtype=np.float64)[places]
        statistic = float(((vectors.T @ b) ** 2 / values).mean())
        df2 = float("inf")
        p = float(stats.chi2.sf(statistic * len(places), len(places)))
        if self._linear is not None:
            contrasts = np.zeros((len(places), len(self.table)))
            contrasts[:, places] = vectors.T
            df2 = _combine(_satterthwaite(self._linear, contrasts))
            p = float(stats.f.sf(statistic, len(places), df2))
        return JointTest(term, statistic, len(places), df2, p)


def fit_linear(formula: str, data: pd.DataFrame) -> MixedFit:
    """Fit a linear mixed model by restricted maximum likelihood.

    The response is numeric, or True/False for the linear probability models of the paper
    (``model_correct ~ ...``). The table has t tests with Satterthwaite's degrees of freedom.

    Rows with a missing value are left out, counted in ``left_out`` and named in ``warnings``.
    Raises `BadInputError` for unknown columns, a constant response, a group of one level or with a
    level for each row, and fixed effects that depend on each other or explain everything.
    """
    return _fit(formula, data, logistic=False)


def fit_logistic(formula: str, data: pd.DataFrame) -> MixedFit:
    """Fit a logistic mixed model by maximum likelihood (Laplace approximation).

    The response is True/False or 0/1; the table has z tests. Missing values as in `fit_linear`.
    Raises `BadInputError` for unknown columns, a response that is not of two classes, a group of
    one level, fixed effects that depend on each other, and for separation (a coefficient that would
    be infinite).
    """
    return _fit(formula, data, logistic=True)


def _fit(formula: str, data: pd.DataFrame, logistic: bool) -> MixedFit:
    import mixedlm
    from mixedlm.models.checks import ModelCheckError

    parsed, rows = _read(formula, data)
    y = rows[parsed.response]
    if logistic and not y.isin((0, 1)).all():
        raise BadInputError(f"{parsed.response!r} is not of two classes; give True/False or 0/1")
    checks: dict[str, Any] = dict.fromkeys(("rankX", "nlev_gtr_1", "nobs_vs_rankZ"), "stop")
    checks |= dict.fromkeys(("nlev_gtreq_5", "nobs_vs_nlev", "scaleX"), "ignore")
    checks |= dict.fromkeys(("conv", "singular"), False)
    checks = {f"check_{name}": action for name, action in checks.items()}
    model: Any
    try:
        # What mixedlm warns of is judged below: rank, convergence, finite covariances.
        with warnings.catch_warnings(action="ignore"):
            if logistic:
                control = mixedlm.GlmerControl(**checks, pirls_maxiter=500)
                model = mixedlm.glmer(parsed, rows, mixedlm.families.Binomial(), control=control)
            else:
                model = mixedlm.lmer(parsed, rows, control=mixedlm.LmerControl(**checks))
    except (ModelCheckError, RuntimeError, ValueError) as error:
        hint = ": a column is constant or follows from others, leave it out"
        hint = hint if "rank deficient" in str(error) else ""
        raise BadInputError(f"{formula!r} cannot be fitted: {error}{hint}") from error
    if not logistic and model.sigma < 1e-8 * y.std():
        raise BadInputError(f"the effects explain {parsed.response!r} exactly: nothing to test")
    terms = _terms(parsed, model.matrices.category_levels)
    names = [name for columns in terms.values() for name in columns]
    with warnings.catch_warnings(action="ignore"):
        covariance = _curvature_covariance(model, names) if logistic else model.vcov()
    if not (np.isfinite(covariance).all() and (np.diag(covariance) > 0).all()):
        raise BadInputError(UNDETERMINED)
    starts = np.cumsum([0, *map(len, terms.values())])
    places = zip(terms, starts[:-1], starts[1:], strict=True)
    table = _estimates(np.eye(len(names)), model.beta, covariance, None if logistic else model)
    table.insert(0, "term", names)
    random = pd.DataFrame(
        {
            "group": [":".join(term.grouping_factors) for term in parsed.random],
            "levels": [one.n_levels for one in model.matrices.random_structures],
            "sd": np.where(model.theta < ZERO, 0.0, model.theta * model.sigma),
        }
    )
    found = _warnings(random, model, len(data) - len(rows), logistic)
    if not logistic:
        random.loc[len(random)] = ["residual", len(rows), model.sigma]
    return MixedFit(
        formula=formula,
        table=table,
        random=random,
        log_likelihood=float(model.logLik()),
        rows=len(rows),
        left_out=len(data) - len(rows),
        converged=bool(model.converged),
        singular=bool((model.theta < ZERO).any()),
        warnings=found,
        covariance=covariance,
        terms={name: tuple(range(first, end)) for name, first, end in places},
        _linear=None if logistic else model,
    )


UNDETERMINED = "the data do not determine the effects: leave one out, or rescale large numbers"


def _read(formula: str, data: pd.DataFrame) -> tuple[Any, pd.DataFrame]:
    """Return the parsed formula, and the complete rows of its columns; refuse what is not one."""
    import mixedlm

    try:
        parsed = mixedlm.parse_formula(formula)
    except ValueError as error:
        raise BadInputError(f"the formula {formula!r} cannot be read: {error}") from error
    groups = [name for term in parsed.random for name in term.grouping_factors]
    used = sorted({parsed.response, *parsed.fixed_variables, *groups})
    for name in used:
        if name not in data:
            raise UnknownNameError("column", name, map(str, data.columns))
    if not groups or any(term.expr or not term.has_intercept for term in parsed.random):
        raise BadInputError(f"{formula!r} needs random intercepts, (1|group), and takes only these")
    if not parsed.fixed.has_intercept:
        raise BadInputError(f"{formula!r} has no intercept: leave out the 0")
    _refuse_terms(formula, parsed)
    rows = data[used].dropna().reset_index(drop=True)
    if rows.empty:
        raise BadInputError(f"no row of the table has all of {', '.join(used)}")
    for name in used:
        numeric = pd.api.types.is_numeric_dtype(rows[name]) and name not in groups
        if numeric or name == parsed.response:
            try:
                rows[name] = rows[name].astype(np.float64)
            except (TypeError, ValueError) as error:
                raise BadInputError(f"the response {name!r} is not numeric: {error}") from error
            if not np.isfinite(rows[name]).all():
                raise BadInputError(f"{name!r} has infinite values")
        elif isinstance(rows[name].dtype, pd.CategoricalDtype):
            rows[name] = rows[name].cat.remove_unused_categories()
        else:
            rows[name] = pd.Categorical(rows[name].astype(str))
    if rows[parsed.response].nunique() < 2:
        raise BadInputError(f"the response {parsed.response!r} is constant: nothing to fit")
    codes = [rows.groupby(list(term.grouping_factors), observed=True).ngroup() for term in
             parsed.random]  # fmt: skip
    same = len({tuple(pd.factorize(one)[0]) for one in codes}) < len(codes)
    if same or set(groups) & set(parsed.fixed_variables):
        raise BadInputError(f"two effects of {formula!r} are the same; leave one of them out")
    return parsed, rows


def _refuse_terms(formula: str, parsed: Any) -> None:
    """Refuse functions of columns, and interactions without their main effects: lme4 would fit
    another model.
    """
    known: set[frozenset[str]] = set()
    for term in parsed.fixed.terms:
        if type(term).__name__ not in ("VariableTerm", "InteractionTerm", "InterceptTerm"):
            raise BadInputError(
                f"{formula!r} cannot be read: functions of columns are not taken, add a column"
            )
        known.add(frozenset(getattr(term, "variables", None) or [getattr(term, "name", "")]))
    for parts in known:
        if any(parts - {name} not in known for name in parts if len(parts) > 1):
            raise BadInputError(
                f"{formula!r} has an interaction without its parts: write "
                f"{' * '.join(sorted(parts))}"
            )


def _terms(parsed: Any, levels: Mapping[str, list[Any]]) -> dict[str, list[str]]:
    """Return the names of the columns of each term; ``levels``: of the categories."""

    def columns(variable: str) -> list[str]:
        if variable not in levels:
            return [variable]
        return [f"{variable}[T.{level}]" for level in levels[variable][1:]]

    found = {INTERCEPT: [INTERCEPT]}
    for term in parsed.fixed.terms:
        names = getattr(term, "variables", None) or [getattr(term, "name", "")]
        if all(names):
            found[":".join(names)] = [":".join(one) for one in product(*map(columns, names))]
    return found


def _curvature_covariance(model: Any, names: list[str]) -> Array:
    """Return the covariance of the fixed effects from the curvature of the log-likelihood by all
    parameters; variances estimated as zero count as known.
    """
    from statsmodels.tools.numdiff import approx_hess3

    own = model.vcov()
    spread = np.sqrt(np.diag(own)) * np.ptp(model.matrices.X, axis=0)
    if not np.isfinite(own).all() or (np.linalg.eigvalsh(own) <= 0).any():
        raise BadInputError(UNDETERMINED)
    if spread.max() > UNKNOWN:
        raise BadInputError(
            f"the effect of {names[int(np.argmax(spread))]} is not determined (perfect separation: "
            "it predicts all answers of a part of the data?); leave it out or join its levels"
        )
    if not model.converged:
        raise BadInputError(f"the search did not converge: {UNDETERMINED}")
    free, scale, value = model.theta > ZERO, np.linalg.cholesky(own), model.as_function("deviance")
    k, theta = int(free.sum()), np.where(free, model.theta, 0.0)

    def deviance(at: Array) -> float:
        theta[free] = at[:k]
        return float(value(np.concatenate([theta, model.beta + scale @ at[k:]])))

    at = np.concatenate([model.theta[free], np.zeros(len(names))])
    steps = 0.01 * np.concatenate([np.maximum(at[:k], 0.1), np.full(len(names), 3.0)])
    curvature = approx_hess3(at, deviance, epsilon=steps) / 2
    if not np.isfinite(curvature).all() or (np.linalg.eigvalsh(curvature) <= 0).any():
        raise BadInputError("the likelihood has no maximum: do all levels of a group answer alike?")
    block = np.linalg.inv(curvature)[k:, k:]
    return np.asarray(scale @ block @ scale.T, dtype=np.float64)


def _satterthwaite(model: Any, contrasts: Array) -> Array:
    """Return the degrees of freedom of contrasts (k, p) of a linear model's fixed effects.

    The same model in other coordinates, the first k of which are the contrasts, has them as the
    degrees of freedom of its coefficients.
    """
    from mixedlm.inference.ddf import satterthwaite_df

    turn = np.vstack([contrasts, null_space(contrasts).T])
    matrices = replace(model.matrices, X=model.matrices.X @ np.linalg.inv(turn))
    turned = replace(model, matrices=matrices, beta=turn @ model.beta)
    # At a boundary fit it solves with the variance that is zero, and warns.
    with warnings.catch_warnings(action="ignore"):
        found = satterthwaite_df(turned).df[: len(contrasts)]
    return np.asarray(found, dtype=np.float64)


def _combine(df: Array) -> float:
    """Return the second degree of freedom of F from its independent parts (as lmerTest)."""
    if np.ptp(df) < 1e-8:
        return float(df.mean())
    if (df <= 2).any():
        return 2.0
    expected = float((df / (df - 2)).sum())
    return 2 * expected / (expected - len(df))


def _estimates(contrasts: Array, b: Array, covariance: Array, linear: Any) -> pd.DataFrame:
    """Return value, standard error, test and interval of each linear combination of ``b``;
    ``linear``: the model, if it is linear.
    """
    se = np.sqrt(np.einsum("ij,jk,ik->i", contrasts, covariance, contrasts))
    df = np.full(len(se), np.inf) if linear is None else _satterthwaite(linear, contrasts)
    value = contrasts @ b
    reach = stats.t.ppf(0.5 + LEVEL / 2, df) * se
    return pd.DataFrame(
        {
            "b": value,
            "se": se,
            "z" if linear is None else "t": value / se,
            "df": df,
            "p": 2 * stats.t.sf(np.abs(value / se), df),
            "low": value - reach,
            "high": value + reach,
        }
    )


def _warnings(random: pd.DataFrame, model: Any, left_out: int, logistic: bool) -> tuple[str, ...]:
    rows, found = model.matrices.n_obs, []
    if left_out:
        found.append(f"{left_out} of {left_out + rows} rows are left out for missing values")
    zero = random["group"][model.theta < ZERO]
    if len(zero):
        found.append(
            f"boundary (singular) fit: the variance of {' and '.join(zero)} is estimated as zero; "
            "the standard errors belong to the model without it"
        )
    if not model.converged:
        found.append("the search did not converge: do not use these numbers")
    if logistic:
        found += [
            f"{one.group!r} has hardly more rows than levels, or its levels answer almost all "
            "alike: the Laplace approximation is not to be trusted"
            for one in random.itertuples()
            if one.sd > FAR or rows < 2 * one.levels
        ]
    return tuple(found)
