"""Parser of formulas of mixed models: ``y ~ fixed effects + (1|group) + (1 + x|group)``.

Fixed effects are read by formulaic (numbers as they are, True as 1; text and categories against the
first level): ``a + b``, ``a:b``, ``a * b``, ``C(a, Treatment("level"))``, ``C(a, Sum)``, ``log``,
``sqrt``, ``exp``, ``center``, ``scale``, ``poly``, ``0 +`` for no intercept. Names that are not
columns or these functions are refused before anything is evaluated. Random intercepts are
``(1|g)``; ``(1|g:h)`` has a level for each pair, ``(1|g/h)`` means ``(1|g) + (1|g:h)``. Random
slopes are ``(1 + x|g)``, correlated with the intercept, or ``(1 + x||g)``, where every column of
the left side is uncorrelated with the others (also the columns of one category); the left side is
read as fixed effects are, and ``(x|g)`` has an intercept too. Column names with blanks are quoted
with backticks.
"""

from __future__ import annotations

import difflib
import re
from collections.abc import Sequence
from dataclasses import dataclass

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
