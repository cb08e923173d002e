"""Parser of formulas of mixed models: ``y ~ fixed effects + (1|group)``.

Fixed effects are read by formulaic (numbers as they are, True as 1; text and categories against the
first level): ``a + b``, ``a:b``, ``a * b``, ``C(a, Treatment("level"))``, ``C(a, Sum)``, ``log``,
``sqrt``, ``exp``, ``center``, ``scale``, ``poly``, ``0 +`` for no intercept. Names that are not
columns or these functions are refused before anything is evaluated. Random intercepts are
``(1|g)``; ``(1|g:h)`` has a level for each pair, ``(1|g/h)`` means ``(1|g) + (1|g:h)``. Column
names with blanks are quoted with backticks.
"""

from __future__ import annotations

import difflib
import re
from collections.abc import Sequence

from physion.errors import BadInputError

FUNCTIONS = {
    *("C", "Treatment", "Sum", "Helmert", "Diff", "Poly"),
    *("log", "log2", "log10", "exp", "center", "scale", "standardize", "poly", "sqrt"),
}
"""Functions that a formula may call."""

_TOKEN = re.compile(r"`[^`]*`|\"[^\"]*\"|'[^']*'|[^\W\d]\w*|[\d.]+|\S", re.UNICODE)
_RANDOM = re.compile(r"\(\s*(?P<slope>[^|()]*?)\s*\|\s*(?P<group>[^|()]*?)\s*\)")
_SIGNS = set("+-*:/^(),~=")


def split_formula(formula: str) -> tuple[str, str, list[tuple[str, tuple[str, ...]]]]:
    """Return response, fixed part, and the random intercepts as (name, columns of the grouping)."""
    left, tilde, right = formula.partition("~")
    if not tilde or "~" in right or not left.strip() or not right.strip():
        raise BadInputError(f"{formula!r} is not of the form: response ~ effects + (1|group)")
    fixed: list[str] = []
    random: list[tuple[str, tuple[str, ...]]] = []
    for piece in _summands(right, formula):
        if "|" not in piece:
            fixed.append(piece)
            continue
        match = _RANDOM.fullmatch(piece)
        if match is None or match["slope"] != "1":
            raise BadInputError(f"{piece!r}: only random intercepts, written (1|group), are fitted")
        random.extend(_nested(match["group"], piece))
    if not random:
        raise BadInputError(f"{formula!r} has no random intercept; add one, such as (1|group)")
    names = [name for name, _ in random]
    if len(set(names)) < len(names):
        raise BadInputError(f"{formula!r} has a random intercept twice")
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


def _nested(group: str, piece: str) -> list[tuple[str, tuple[str, ...]]]:
    if "/" in group:
        names = [_plain(part.strip()) for part in group.split("/")]
        result = [tuple(names[: k + 1]) for k in range(len(names))]
    else:
        result = [tuple(_plain(part.strip()) for part in group.split(":"))]
    if not all(all(names) for names in result):
        raise BadInputError(f"{piece!r} lacks the name of a group")
    return [(":".join(names), names) for names in result]


def _plain(name: str) -> str:
    return name[1:-1] if len(name) > 1 and name[0] == name[-1] == "`" else name


def columns_of(
    response: str, fixed: str, random: Sequence[tuple[str, tuple[str, ...]]], known: list[str]
) -> list[str]:
    """Return all columns that are needed; refuse unknown names and characters."""
    result = [response]
    tokens = _TOKEN.findall(fixed)
    for token, after in zip(tokens, [*tokens[1:], ""], strict=True):
        if token[0] in "\"'" or token in _SIGNS or re.fullmatch(r"\d+(\.\d+)?|\.\d+", token):
            continue
        if token in FUNCTIONS and (token not in known or after == "("):
            continue
        if not (token[0] == "`" or token[0].isalpha() or token[0] == "_"):
            raise BadInputError(f"{token!r} in {fixed!r} is not understood in a formula")
        if after == "=":
            continue
        result.append(_plain(token))
    result.extend(name for _, columns in random for name in columns)
    for name in result:
        if name not in known:
            close = difflib.get_close_matches(name, known, n=3, cutoff=0.4) or known[:8]
            raise BadInputError(f"the table has no column {name!r}; it has: {', '.join(close)}")
    return list(dict.fromkeys(result))
