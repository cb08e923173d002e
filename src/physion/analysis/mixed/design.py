"""From the formula of a mixed model and a table to its arrays.

Formula: ``y ~ fixed effects + (1|group) + (1 + x|group)``.

Fixed effects are read by formulaic (numbers as they are, True as 1; text and categories against the
first level): ``a + b``, ``a:b``, ``a * b``, ``C(a, Treatment("level"))``, ``C(a, Sum)``, ``log``,
``sqrt``, ``exp``, ``center``, ``scale``, ``poly``, ``0 +`` for no intercept. Names that are not
columns or these functions are refused before anything is evaluated. Random intercepts are
``(1|g)``; ``(1|g:h)`` has a level for each pair, ``(1|g/h)`` means ``(1|g) + (1|g:h)``. Random
slopes are ``(1 + x|g)``, correlated with the intercept, or ``(1 + x||g)``, where every column of
the left side is uncorrelated with the others (also the columns of one category); the left side is
read as fixed effects are, and ``(x|g)`` has an intercept too. Column names with blanks are quoted
with backticks.

The arrays refuse what cannot be fitted (constant columns, separation). Levels of crossed groupings
are sorted so that their equations split into small dense blocks (`Groupings`).
"""

from __future__ import annotations

import copy
import difflib
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import numpy.typing as npt
import pandas as pd
from formulaic import Formula  # type: ignore[import-untyped]
from formulaic.errors import FormulaicError  # type: ignore[import-untyped]
from scipy.linalg import qr
from scipy.optimize import linprog
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.special import expit

from physion.core.errors import BadInputError

FUNCTIONS = {
    *("C", "Treatment", "Sum", "Helmert", "Diff", "Poly"),
    *("log", "log2", "log10", "exp", "center", "scale", "standardize", "poly", "sqrt"),
}
"""Functions that a formula may call."""

_TOKEN = re.compile(r"`[^`]*`|\"[^\"]*\"|'[^']*'|[^\W\d]\w*|[\d.]+|\S", re.UNICODE)
_RANDOM = re.compile(r"\(\s*(?P<effects>[^|]*?)\s*(?P<bar>\|\|?)\s*(?P<group>[^|()]*?)\s*\)")
_SIGNS = set("+-*:/^(),~=")


@dataclass(frozen=True)
class RandomTerm:
    """Random effects of one grouping.

    ``name``: of the grouping, ``columns`` whose values together are its levels; ``effects``: what
    varies between levels, as text (``1`` is the intercept); ``correlated``: with each other.
    """

    name: str
    columns: tuple[str, ...]
    effects: str = "1"
    correlated: bool = True


def split_formula(formula: str) -> tuple[str, str, list[RandomTerm]]:
    """Return response, fixed part and random terms."""
    left, tilde, right = formula.partition("~")
    if not tilde or "~" in right or not left.strip() or not right.strip():
        raise BadInputError(f"{formula!r} is not of the form: response ~ effects + (1|group)")
    fixed: list[str] = []
    random: list[RandomTerm] = []
    for piece in _summands(right, formula):
        if "|" not in piece:
            fixed.append(piece)
            continue
        match = _RANDOM.fullmatch(piece)
        if match is None or not match["effects"]:
            raise BadInputError(
                f"{piece!r}: random effects are written (1|group) or (1 + x|group), "
                "with parentheses"
            )
        correlated = match["bar"] == "|"
        random += [
            RandomTerm(":".join(columns), columns, match["effects"], correlated)
            for columns in _nested(match["group"], piece)
        ]
    if not random:
        raise BadInputError(f"{formula!r} has no random intercept; add one, such as (1|group)")
    return _plain(left.strip()), " + ".join(fixed) or "1", random


def _summands(text: str, formula: str) -> list[str]:
    """Split at plus signs outside parentheses."""
    pieces, depth = [""], 0
    for token in re.findall(r"`[^`]*`|\"[^\"]*\"|'[^']*'|.", text):
        depth += (token == "(") - (token == ")")
        if depth < 0:
            break
        if token == "+" and depth == 0:
            pieces.append("")
        else:
            pieces[-1] += token
    if depth != 0 or not all(piece.strip() for piece in pieces):
        raise BadInputError(f"{formula!r} cannot be read: parentheses or plus signs do not match")
    return [piece.strip() for piece in pieces]


def _nested(group: str, piece: str) -> list[tuple[str, ...]]:
    if "/" in group:
        names = [_plain(part.strip()) for part in group.split("/")]
        result = [tuple(names[: k + 1]) for k in range(len(names))]
    else:
        result = [tuple(_plain(part.strip()) for part in group.split(":"))]
    if not all(all(names) for names in result):
        raise BadInputError(f"{piece!r} lacks the name of a group")
    return result


def _plain(name: str) -> str:
    return name[1:-1] if len(name) > 1 and name[0] == name[-1] == "`" else name


def columns_of(
    response: str, fixed: str, random: Sequence[RandomTerm], known: list[str]
) -> list[str]:
    """Return all columns that are needed; refuse unknown names and characters."""
    result = [response]
    for effects in [fixed, *(term.effects for term in random)]:
        result += _columns_in(effects, known)
    result.extend(name for term in random for name in term.columns)
    for name in result:
        if name not in known:
            close = difflib.get_close_matches(name, known, n=3, cutoff=0.4) or known[:8]
            raise BadInputError(f"the table has no column {name!r}; it has: {', '.join(close)}")
    return list(dict.fromkeys(result))


def _columns_in(effects: str, known: list[str]) -> list[str]:
    """Return the names in ``effects`` that are neither numbers, text nor functions."""
    result = []
    tokens = _TOKEN.findall(effects)
    for token, after in zip(tokens, [*tokens[1:], ""], strict=True):
        if token[0] in "\"'" or token in _SIGNS or re.fullmatch(r"\d+(\.\d+)?|\.\d+", token):
            continue
        if token in FUNCTIONS and (token not in known or after == "("):
            continue
        if not (token[0] == "`" or token[0].isalpha() or token[0] == "_"):
            raise BadInputError(f"{token!r} in {effects!r} is not understood in a formula")
        if after == "=":
            continue
        result.append(_plain(token))
    return result


# Arrays of a mixed model from a formula and a table; what cannot be fitted is refused.

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
        """Whether the levels differ in their intercept only."""
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
        raise BadInputError(f"the group {name!r} has only one level: it cannot vary; leave it out")
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
    """Refuse slopes that no level determines, because its rows have one value only."""
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


# Levels of crossed groupings, sorted so that their equations split into small dense blocks.
#
# Z is the matrix of indicators of levels, W the diagonal of weights of rows. Within one grouping
# Z'WZ is diagonal. So the grouping with most levels ("wide") is eliminated first, and what remains
# is a dense matrix over the levels of the others ("narrow"), which splits if no row links its
# levels: with participants and stimuli within scenarios, into one of 100 x 100 per scenario.
# Genuinely crossed designs give one larger block and the same result. `factor` solves the
# equations.

Codes = npt.NDArray[np.int64]

MOST_CELLS = 100_000_000
"""Cells of the dense cross tables above which a design is refused (0.8 GB each)."""

FULL_BLOCK = 64
"""Narrow levels up to which unlinked parts share a block: many tiny ones would be slow."""


@dataclass(frozen=True)
class Counts:
    """Z'WZ: sums of weights by wide level, by wide x narrow level, by narrow x narrow level.

    The last two are lists over blocks, of shapes (d, e) and (e, e).
    """

    wide: Array
    cross: list[Array]
    narrow: list[Array]


class Groupings:
    """Positions of rows in the equations: levels sorted into blocks, and cells of the cross tables.

    ``codes``: one array (n,) a grouping with values 0..levels-1, all present. Positions in the
    vectors of random effects ("slots", q in all) are by block, wide levels first;
    ``slots[k][code]`` maps a level to its slot and ``rows[k]`` each row. Random slopes are
    groupings of the same codes whose entries of Z are not 1: see `with_values`.
    """

    def __init__(self, codes: Sequence[Codes]) -> None:
        self.n = len(codes[0])
        self.levels = [int(code.max()) + 1 for code in codes]
        self.q = sum(self.levels)
        self.wide = int(np.argmax(self.levels))
        self._narrow = [k for k in range(len(codes)) if k != self.wide]
        self.q_wide = self.levels[self.wide]
        self.slots = self._sort_into_blocks(codes)
        self.rows = [slot[code] for slot, code in zip(self.slots, codes, strict=True)]
        self.owner = np.empty(self.q, dtype=np.int64)
        for k, slot in enumerate(self.slots):
            self.owner[slot] = k
        self._values: Sequence[Array] | None = None
        self._index_cells()

    def with_values(self, values: Sequence[Array]) -> Groupings:
        """Return the same groupings with ``values[k]`` (n,) as the entries of Z in place of 1."""
        result = copy.copy(self)
        result._values = values
        return result

    def entries(self, k: int, scale: Array) -> Array:
        """Return the entries (n,) of Z Lambda for grouping ``k``; ``scale`` by slot (q,)."""
        entries = scale[self.rows[k]]
        return entries if self._values is None else entries * self._values[k]

    def _weighted(self, weights: Array | None, *of: int) -> Array | None:
        """Return ``weights`` times the entries of Z of the groupings ``of``."""
        if self._values is None:
            return weights
        product = weights
        for k in of:
            product = self._values[k] if product is None else product * self._values[k]
        return product

    def _sort_into_blocks(self, codes: Sequence[Codes]) -> list[Codes]:
        """Return the slots of each grouping's levels; set the bounds of the blocks."""
        start = np.cumsum([0, *self.levels])
        links = [(start[self.wide] + codes[self.wide], start[k] + codes[k]) for k in self._narrow]
        label = np.zeros(self.q, dtype=np.int64)
        if links:
            one, other = (np.concatenate(part) for part in zip(*links, strict=True))
            graph = coo_array((np.ones(len(one)), (one, other)), (self.q, self.q))
            label = connected_components(graph.tocsr(), directed=False)[1].astype(np.int64)
        parts = [label[start[k] : start[k + 1]] for k in range(len(codes))]
        narrow = np.concatenate([parts[k] for k in self._narrow]) if links else np.zeros(0, int)
        # Parts share a block until it holds FULL_BLOCK narrow levels.
        before = np.cumsum(np.bincount(narrow, minlength=label.max() + 1)) - 1
        block = np.unique(np.maximum(before, 0) // FULL_BLOCK, return_inverse=True)[1]
        wide_block, narrow_block = block[parts[self.wide]], block[narrow]
        bounds = np.arange(block.max() + 2)
        self._wide_bounds = np.searchsorted(np.sort(wide_block), bounds)
        self._narrow_bounds = np.searchsorted(np.sort(narrow_block), bounds)
        slots: list[Codes] = [np.zeros(0, dtype=np.int64)] * len(codes)
        slots[self.wide] = _rank(wide_block)
        ranks, at = self.q_wide + _rank(narrow_block), 0
        for k in self._narrow:
            slots[k] = ranks[at : at + self.levels[k]]
            at += self.levels[k]
        return slots

    def _index_cells(self) -> None:
        """Compute the cell in the flat cross tables for each row and narrow grouping."""
        wide, narrow = np.diff(self._wide_bounds), np.diff(self._narrow_bounds)
        self._shapes = list(zip(wide.tolist(), narrow.tolist(), strict=True))
        self._cross_starts = np.cumsum([0, *(wide * narrow)])
        self._narrow_starts = np.cumsum([0, *(narrow * narrow)])
        if max(self._cross_starts[-1], self._narrow_starts[-1]) > MOST_CELLS:
            raise BadInputError(
                f"groups of {' and '.join(map(str, self.levels))} levels are too many to cross; "
                "fit one scenario at a time, or leave a group out"
            )
        row_wide = self.rows[self.wide]
        block = np.searchsorted(self._wide_bounds, row_wide, side="right") - 1
        local_wide = row_wide - self._wide_bounds[block]
        local = {k: self.rows[k] - self.q_wide - self._narrow_bounds[block] for k in self._narrow}
        width = narrow[block]
        self.cells = {
            k: self._cross_starts[block] + local_wide * width + local[k] for k in self._narrow
        }
        self.pairs = {
            (k, m): self._narrow_starts[block] + local[k] * width + local[m]
            for i, k in enumerate(self._narrow)
            for m in self._narrow[i:]
        }

    def _split(self, flat: Array, starts: Codes, square: bool) -> list[Array]:
        return [
            flat[a:b].reshape(e if square else d, e)
            for a, b, (d, e) in zip(starts[:-1], starts[1:], self._shapes, strict=True)
        ]

    def counts(self, weights: Array | None = None) -> Counts:
        """Return Z'WZ for weights of shape (n,), or weights of one."""
        squared = self._weighted(weights, self.wide, self.wide)
        wide = np.bincount(self.rows[self.wide], squared, self.q_wide).astype(np.float64)
        cross = np.zeros(self._cross_starts[-1])
        for k, cells in self.cells.items():
            cross += np.bincount(cells, self._weighted(weights, self.wide, k), len(cross))
        flat = np.zeros(self._narrow_starts[-1])
        for (k, m), pairs in self.pairs.items():
            products = self._weighted(weights, k, m)
            one = np.bincount(pairs, products, len(flat)).astype(np.float64)
            flat += one
            if k != m:
                blocks = self._split(one, self._narrow_starts, square=True)
                flat += np.concatenate([block.T.ravel() for block in blocks])
        return Counts(
            wide,
            self._split(cross, self._cross_starts, square=False),
            self._split(flat, self._narrow_starts, square=True),
        )

    def sums(self, values: Array) -> Array:
        """Return Z' times ``values`` (n,) or (n, p): sums by slot, shape (q,) or (q, p)."""
        if values.ndim == 2:
            return np.stack([self.sums(column) for column in values.T], axis=1)
        total = np.zeros(self.q)
        for k, rows in enumerate(self.rows):
            total += np.bincount(rows, self._weighted(values, k), self.q)
        return total

    def spread(self, effects: Array) -> Array:
        """Return Z times ``effects`` (q,): values by row (n,)."""
        total = self.entries(0, effects)
        for k in range(1, len(self.rows)):
            total = total + self.entries(k, effects)
        return total

    def by_grouping(self, values: Array) -> Array:
        """Return the sums of ``values`` (q,) over the levels of each grouping."""
        return np.asarray(np.bincount(self.owner, values, len(self.levels)), dtype=np.float64)

    def multiply(self, counts: Counts, effects: Array) -> Array:
        """Return Z'WZ times ``effects`` (q,) or (q, p)."""
        product = np.empty_like(effects)
        for (wide, narrow), cross, square in self.blocks(counts):
            x, y = effects[wide], effects[narrow]
            product[wide] = (counts.wide[wide] * x.T).T + cross @ y
            product[narrow] = cross.T @ x + square @ y
        return product

    def blocks(self, counts: Counts) -> list[tuple[tuple[slice, slice], Array, Array]]:
        """Return for each block its slots (wide, narrow) and its two tables."""
        wide = [slice(a, b) for a, b in _pairs(self._wide_bounds)]
        narrow = [slice(self.q_wide + a, self.q_wide + b) for a, b in _pairs(self._narrow_bounds)]
        slots_of_blocks = list(zip(wide, narrow, strict=True))
        return list(zip(slots_of_blocks, counts.cross, counts.narrow, strict=True))


def _rank(block: Codes) -> Codes:
    """Return the position of each level when levels are sorted by block."""
    position = np.empty(len(block), dtype=np.int64)
    position[np.argsort(block, kind="stable")] = np.arange(len(block))
    return position


def _pairs(bounds: Codes) -> list[tuple[int, int]]:
    return [(int(a), int(b)) for a, b in pairwise(bounds)]


# Separation: when some coefficients of a logistic regression would be infinite.
#
# If a combination of the fixed effects is never negative for True and never positive for False,
# more of it is always better and no estimate exists. Random intercepts do not change that. The
# ordinary logistic regression tells: it converges exactly when there is no such combination.


def refuse_separation(design: Design) -> None:
    """Raise `BadInputError` with the names of the effects if the fixed effects separate the
    answers.
    """
    if _converges(design.x, design.y):
        return
    direction = _separating(design.x, design.y)
    if direction is None:
        return
    share = np.abs(direction) / np.abs(direction).max()
    names = [name for name, one in zip(design.names, share, strict=True) if one > 1e-6]
    raise BadInputError(
        f"perfect separation: {' and '.join(names)} tell(s) all answers of {design.response!r} "
        "apart in part of the data, so that a coefficient would be infinite; leave the effect out "
        "or join its levels"
    )


def _converges(x: Array, y: Array) -> bool:
    """Return whether Newton's method for the ordinary logistic regression converges."""
    basis = np.linalg.qr(x)[0] * np.sqrt(len(y))
    beta = np.zeros(basis.shape[1])
    for _ in range(25):
        mean = expit(basis @ beta)
        information = basis.T @ (basis * (mean * (1 - mean))[:, None])
        score = basis.T @ (y - mean)
        if np.linalg.cond(information) > 1e12:
            return False
        step = np.linalg.solve(information, score)
        if not np.isfinite(step).all() or np.abs(basis @ (beta + step)).max() > 300:
            return False
        beta = beta + step
        if float(score @ step) < 1e-10 * len(y):
            mean = expit(basis @ beta)
            # If a coefficient diverges, steps stay near 1 although the likelihood hardly changes.
            return bool(np.abs(basis @ step).max() < 1e-3)
    return False


def _separating(x: Array, y: Array) -> Array | None:
    """Return coefficients that separate, or None, by a linear programme over the distinct rows."""
    size = np.abs(x).max(axis=0)
    signed = np.unique((2 * y - 1)[:, None] * (x / size), axis=0)
    p = x.shape[1]
    # As much separation as fits into a box; zero separation means none.
    found = linprog(
        -signed.sum(axis=0),
        A_ub=-signed,
        b_ub=np.zeros(len(signed)),
        bounds=[(-1, 1)] * p,
        method="highs",
    )
    if found.status != 0 or -found.fun < 1e-7:
        return None
    return np.asarray(found.x, dtype=np.float64)


# Random intercepts and slopes as functions of the parameters of their covariance.
#
# Row i of grouping g has the effect z_i' b, with b normal for each level and cov(b) = L L', L
# lower triangular. With b = L u and u standard normal, every column c of L is a grouping of its
# own, whose entries in the matrix of random effects are a_ic = sum_r z_ir L_rc. So the equations
# of intercepts (`factor`) hold unchanged (D. Bates et al., Fitting linear mixed-effects models
# using lme4, Journal of Statistical Software 67, 2015, section 2).
#
# The parameters are the entries of L, column by column, for columns z that are made orthonormal
# within a group of correlated effects: neither the origin nor the unit of a slope matters to the
# search. The sign of a column of L does not matter, so that the likelihood is even in the last
# diagonal entry of each group, which stands only in its column.


class RandomEffects:
    """Random effects of a design: k effects of a group are k groupings of the same codes.

    - ``entry_of``: for each parameter the groupings (r, c) of its row and column of L;
    - ``diagonal``: the parameter on the diagonal of L for each grouping;
    - ``even``: whether the likelihood is even in each parameter;
    - ``levels``: of the group of each parameter.
    """

    def __init__(self, groups: Sequence[Group]) -> None:
        self._groups = groups
        codes = [group.codes for group in groups for _ in group.effects]
        self.groupings = Groupings(codes)
        self._intercepts = all(group.intercept_alone for group in groups)
        self._basis: list[Array] = []
        self._back: list[Array] = []
        entry_of: list[tuple[int, int]] = []
        even: list[bool] = []
        levels: list[int] = []
        for group in groups:
            first, k = len(self._basis), len(group.effects)
            basis, back = _orthonormal(group.columns)
            self._basis += list(np.ascontiguousarray(basis.T))
            self._back.append(back)
            entry_of += [(first + r, first + c) for c in range(k) for r in range(c, k)]
            even += [c == r == k - 1 for c in range(k) for r in range(c, k)]
            levels += [group.levels] * (k * (k + 1) // 2)
        self.entry_of = entry_of
        self.diagonal = np.array([entry_of.index((c, c)) for c in range(len(codes))])
        self.even = np.array(even)
        self.levels = np.array(levels)

    def from_diagonal(self, spread: Array) -> Array:
        """Return parameters of uncorrelated effects with standard deviations (groupings,)."""
        at = np.zeros(len(self.entry_of))
        at[self.diagonal] = spread
        return at

    def at(self, parameters: Array) -> tuple[Groupings, Array]:
        """Return groupings and a scale by slot (q,) whose product is Z Lambda."""
        if self._intercepts:
            return self.groupings, parameters[self.groupings.owner]
        values = [np.zeros(self.groupings.n) for _ in self._basis]
        for (r, c), one in zip(self.entry_of, parameters, strict=True):
            values[c] += one * self._basis[r]
        return self.groupings.with_values(values), np.ones(self.groupings.q)

    def gradient(self, by_entry: Sequence[Array]) -> Array:
        """Return derivatives by the parameters from those by the entries a_ic, (n,) for each c."""
        return np.array([self._basis[r] @ by_entry[c] for r, c in self.entry_of])

    def basis(self, parameter: int) -> tuple[Array, int]:
        """Return the change of the entries a_ic with ``parameter``, (n,), and the grouping c."""
        r, c = self.entry_of[parameter]
        return self._basis[r], c

    def roots(self, parameters: Array) -> list[Array]:
        """Return for each group the matrix B (k, k) with cov(b) = B B', for its own columns."""
        first, result = 0, []
        for group, back in zip(self._groups, self._back, strict=True):
            k = len(group.effects)
            root = np.zeros((k, k))
            for (r, c), one in zip(self.entry_of, parameters, strict=True):
                if first <= c < first + k:
                    root[r - first, c - first] = one
            result.append(np.asarray(np.linalg.solve(back, root), dtype=np.float64))
            first += k
        return result

    def effects(self, parameters: Array, u: Array) -> list[Array]:
        """Return for each group the effects (levels, k) of its levels at ``u`` (q,)."""
        first, result = 0, []
        for root in self.roots(parameters):
            slots = self.groupings.slots[first : first + len(root)]
            result.append(np.column_stack([u[slot] for slot in slots]) @ root.T)
            first += len(root)
        return result

    def singular(self, parameters: Array) -> list[bool]:
        """Return for each group whether its covariance is estimated as singular."""
        zero = parameters[self.diagonal] == 0
        ends = np.cumsum([len(group.effects) for group in self._groups])[:-1]
        return [bool(part.any()) for part in np.split(zero, ends)]


def _orthonormal(columns: Array) -> tuple[Array, Array]:
    """Return columns of mean square 1 at right angles, and ``back``: columns = basis @ back."""
    if columns.shape[1] == 1:
        size = np.sqrt(np.mean(columns**2, keepdims=True))
        return columns / size, size.reshape(1, 1)
    basis, back = np.linalg.qr(columns)
    size = np.sqrt(len(columns))
    return basis * size, back / size
