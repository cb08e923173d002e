"""Separation: when some coefficients of a logistic regression would be infinite.

If a combination of the fixed effects is never negative for True and never positive for False, more
of it is always better and no estimate exists. Random intercepts do not change that. The ordinary
logistic regression tells: it converges exactly when there is no such combination.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from scipy.optimize import linprog
from scipy.special import expit

from physion.analysis.mixed.design import Design
from physion.core.errors import BadInputError

Array = npt.NDArray[np.float64]


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
