"""Arrays of a mixed model from a formula and a table; what cannot be fitted is refused."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import pandas as pd
from formulaic import Formula  # type: ignore[import-untyped]
from formulaic.errors import FormulaicError  # type: ignore[import-untyped]
from scipy.linalg import qr

from physion.analysis.mixed.formula import RandomTerm, columns_of, split_formula
from physion.core.errors import BadInputError

Array = npt.NDArray[np.float64]

ALIASED = 1e-9
"""Fraction of each column of fixed effects that the other columns must leave unexplained."""

INTERCEPT = "Intercept"
"""Name of the intercept among the effects of a grouping."""


@dataclass(frozen=True)
class Group:
    """Grouping with random effects: ``codes`` (n,) index its ``labels``.

    ``effects`` are the names of the k effects of a level, correlated with each other, and
    ``columns`` (n, k) the values that they multiply: ones for an intercept.
    """

    name: str
    codes: npt.NDArray[np.int64]
    labels: tuple[str, ...]
    effects: tuple[str, ...]
    columns: Array

    @property
    def levels(self) -> int:
        """Number of levels."""
        return len(self.labels)

    @property
    def intercept_alone(self) -> bool:
        """Whether the levels differ in their intercept alone."""
        return self.effects == (INTERCEPT,)


@dataclass(frozen=True)
class Design:
    """Arrays of a model: ``y`` (n,), ``x`` (n, p) of full rank, and the groupings.

    ``terms`` maps each term of the formula to its columns of ``x``; ``missing`` counts the rows
    left out for lack of each column (a row can lack several), ``left_out`` all rows left out.
    """

    formula: str
    response: str
    y: Array
    x: Array
    names: tuple[str, ...]
    terms: Mapping[str, tuple[int, ...]]
    groups: tuple[Group, ...]
    missing: Mapping[str, int]
    left_out: int


def build_design(formula: str, data: pd.DataFrame) -> Design:
    """Build the arrays of ``formula`` from the complete rows of ``data``.

    Raises `BadInputError` for what cannot be fitted: unknown columns, no random effect, no rows,
    a constant or non-numeric response, infinite values, groups of one level, identical groups,
    slopes of what does not vary within a level, and linearly dependent effects.
    """
    response, fixed, random = split_formula(formula)
    used = columns_of(response, fixed, random, list(map(str, data.columns)))
    if data.columns.duplicated().any():
        raise BadInputError("the table has two columns of one name; rename one")
    lacking = data[used].isna()
    complete = ~lacking.any(axis=1)
    rows = data.loc[complete, used]
    if rows.empty:
        raise BadInputError(f"no row of the table has all of {', '.join(used)}")
    y = _response(rows[response], response)
    x, names, terms = _fixed_effects(fixed, rows)
    groups = tuple(group for term in random for group in _groups(term, rows))
    _refuse_twice(groups, formula)
    _refuse_same(groups)
    _refuse_explained(groups, x)
    counts = lacking.sum()
    return Design(
        formula=formula,
        response=response,
        y=y,
        x=x,
        names=names,
        terms=terms,
        groups=groups,
        missing={str(name): int(count) for name, count in counts.items() if count},
        left_out=int((~complete).sum()),
    )


def _response(column: pd.Series, name: str) -> Array:
    if not (pd.api.types.is_numeric_dtype(column) or pd.api.types.is_bool_dtype(column)):
        try:
            column = column.astype(float)
        except (TypeError, ValueError) as error:
            raise BadInputError(f"the response {name!r} is not numeric: {error}") from error
    y = np.asarray(column, dtype=np.float64)
    if not np.isfinite(y).all():
        raise BadInputError(f"the response {name!r} has infinite values")
    if np.ptp(y) <= 1e-12 * max(1.0, float(np.abs(y).max())):
        raise BadInputError(
            f"the response {name!r} is constant ({y[0]:g}): there is nothing to fit"
        )
    return y


def _fixed_effects(
    fixed: str, rows: pd.DataFrame
) -> tuple[Array, tuple[str, ...], dict[str, tuple[int, ...]]]:
    """Return the matrix of fixed effects, its column names, and the columns of each term."""
    x, names, terms = _model_matrix(fixed, rows, "fixed")
    if not names:
        raise BadInputError(f"{fixed!r} has no fixed effect; keep at least the intercept")
    _refuse_dependent(x, names, "fixed effects")
    return x, names, terms


def _model_matrix(
    effects: str, rows: pd.DataFrame, kind: str
) -> tuple[Array, tuple[str, ...], dict[str, tuple[int, ...]]]:
    """Return the columns of ``effects``, their names, and the columns of each term.

    ``kind`` (fixed or random) is for messages.
    """
    tidy = rows.copy()
    for name in tidy.columns:
        if isinstance(tidy[name].dtype, pd.CategoricalDtype):
            tidy[name] = tidy[name].cat.remove_unused_categories()
        elif pd.api.types.is_bool_dtype(tidy[name]):
            tidy[name] = tidy[name].astype(bool)
        elif not pd.api.types.is_numeric_dtype(tidy[name]):
            tidy[name] = tidy[name].astype(object)
    try:
        matrix = Formula(effects).get_model_matrix(
            tidy, context={"sqrt": np.sqrt}, na_action="ignore", output="pandas"
        )
    except (FormulaicError, TypeError, ValueError, KeyError, SyntaxError, NameError) as error:
        reason = (str(error).splitlines() or [type(error).__name__])[-1]
        raise BadInputError(f"the {kind} effects {effects!r} cannot be built: {reason}") from error
    x = np.broadcast_to(np.asarray(matrix, dtype=np.float64), (len(tidy), matrix.shape[1])).copy()
    names = tuple(map(str, matrix.columns))
    bad = [name for name, column in zip(names, x.T, strict=True) if not np.isfinite(column).all()]
    if bad:
        raise BadInputError(f"{bad[0]!r} has values that are not finite (a logarithm of 0?)")
    indices = matrix.model_spec.term_indices
    terms = {str(term): tuple(map(int, columns)) for term, columns in indices.items()}
    terms = {(INTERCEPT if name == "1" else name): columns for name, columns in terms.items()}
    return x, names, terms


def _refuse_dependent(x: Array, names: Sequence[str], what: str) -> None:
    size = np.sqrt((x**2).sum(axis=0))
    if len(x) <= x.shape[1]:
        raise BadInputError(f"{len(x)} rows are too few for {x.shape[1]} {what}")
    zero = [name for name, one in zip(names, size, strict=True) if one == 0]
    if zero:
        raise BadInputError(f"{zero[0]!r} is zero in every row (a combination that never occurs?)")
    _, triangle, order = qr(x / size, mode="economic", pivoting=True)
    lost = order[np.abs(np.diag(triangle)) < ALIASED * len(size)]
    if len(lost):
        which = ", ".join(names[k] for k in sorted(lost))
        raise BadInputError(
            f"{what} depend on each other: {which} follow(s) from the rest; leave some out"
        )


def _groups(term: RandomTerm, rows: pd.DataFrame) -> list[Group]:
    """Return the grouping of ``term``, once for each effect if they are uncorrelated."""
    name = term.name
    parts = [rows[column].astype(str) for column in term.columns]
    labels = parts[0]
    for part in parts[1:]:
        labels = labels + ":" + part
    codes, levels = pd.factorize(labels, sort=True)
    if len(levels) < 2:
        raise BadInputError(f"the group {name!r} has one level alone: it cannot vary; leave it out")
    codes, labels = codes.astype(np.int64), tuple(map(str, levels))
    columns = np.ones((len(rows), 1))
    effects: tuple[str, ...] = (INTERCEPT,)
    if term.effects != "1":
        columns, effects, _ = _model_matrix(term.effects, rows, "random")
        _refuse_unknown_slopes(columns, effects, codes, name)
    if term.correlated:
        return [Group(name, codes, labels, effects, columns)]
    return [
        Group(name, codes, labels, (effect,), columns[:, [k]]) for k, effect in enumerate(effects)
    ]


def _refuse_unknown_slopes(
    columns: Array, effects: Sequence[str], codes: npt.NDArray[np.int64], name: str
) -> None:
    """Refuse slopes that no level determines, because its rows have one value alone."""
    if not effects:
        raise BadInputError(f"no effect varies by {name!r}; write (1|{name})")
    _refuse_dependent(columns, effects, f"random effects of {name!r}")
    first = np.zeros(codes.max() + 1, dtype=np.int64)
    first[codes] = np.arange(len(codes))
    differs = columns != columns[first[codes]]
    for effect, varies in zip(effects, differs.any(axis=0), strict=True):
        if not varies and effect != INTERCEPT:
            raise BadInputError(
                f"{effect!r} does not vary within the levels of {name!r}: its random slope is not "
                "determined; leave the slope out"
            )


def _refuse_twice(groups: Sequence[Group], formula: str) -> None:
    seen = set()
    for group in groups:
        for effect in group.effects:
            if (group.name, effect) in seen:
                what = "intercept" if effect == INTERCEPT else f"slope of {effect!r}"
                raise BadInputError(f"{formula!r} has a random {what} twice for {group.name!r}")
            seen.add((group.name, effect))


def _refuse_same(groups: Sequence[Group]) -> None:
    for k, one in enumerate(groups):
        for other in groups[k + 1 :]:
            if one.name == other.name:
                continue
            pairs = len(np.unique(one.codes * other.levels + other.codes))
            if pairs == one.levels == other.levels:
                raise BadInputError(f"the groups {one.name!r} and {other.name!r} are the same")


def _refuse_explained(groups: Sequence[Group], x: Array) -> None:
    """Refuse a group whose levels are fixed effects already: its variance is not identified."""
    orthonormal = np.linalg.qr(x)[0]
    for group in groups:
        if not group.intercept_alone or group.levels > x.shape[1]:
            continue
        sums = np.stack([np.bincount(group.codes, column) for column in orthonormal.T])
        explained = (sums**2).sum(axis=0) / np.bincount(group.codes)
        if (explained > 1 - 1e-9).all():
            raise BadInputError(
                f"the fixed effects tell the levels of {group.name!r} apart already; "
                "keep either the fixed effect or the random intercept"
            )
