"""One linear mixed model with crossed random intercepts, as lmerTest fits those of the paper."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import pandas as pd
from scipy import optimize, stats

Array = npt.NDArray[np.float64]


@dataclass(frozen=True)
class _Sums:
    """Cross products of fixed effects x, dummies of the groups z, and accuracies y."""

    n: int
    xx: Array
    xz: Array
    zz: Array
    xy: Array
    zy: Array
    yy: float
    group: npt.NDArray[np.intp]


def fit_term(
    table: pd.DataFrame, terms: Sequence[str], groups: Sequence[str], term: str | None
) -> dict[str, float]:
    """Slope of ``term`` (None: the intercept) in accuracy ~ terms + (1 | group) + ..., by REML.

    ``b``, ``se``, ``t``, ``df`` (Satterthwaite), ``p`` (two-sided), ``rows``.
    """
    sums = _sums(table, terms, groups)
    at = 0 if term is None else 1 + list(terms).index(term)
    variances = _maximise(sums, len(groups))
    b, covariance, _ = _solve(sums, variances)
    variance = float(covariance[at, at])
    df = _satterthwaite(sums, variances, at)
    t = float(b[at] / np.sqrt(variance))
    return {"b": float(b[at]), "se": float(np.sqrt(variance)), "t": t, "df": df,
            "p": float(2 * stats.t.sf(abs(t), df)), "rows": float(sums.n)}  # fmt: skip


def _sums(table: pd.DataFrame, terms: Sequence[str], groups: Sequence[str]) -> _Sums:
    y = table["accuracy"].to_numpy(dtype=np.float64)
    x = np.column_stack([np.ones(len(y)), table[list(terms)].to_numpy(dtype=np.float64)])
    dummies = [pd.get_dummies(table[name]).to_numpy(dtype=np.float64) for name in groups]
    z = np.hstack(dummies)
    of = np.repeat(np.arange(len(groups)), [part.shape[1] for part in dummies])
    return _Sums(len(y), x.T @ x, x.T @ z, z.T @ z, x.T @ y, z.T @ y, float(y @ y), of)


def _solve(sums: _Sums, variances: Array) -> tuple[Array, Array, float]:
    """b, its covariance, and the REML deviance at the variances (one a group, residual last)."""
    residual = variances[-1]
    scale = np.sqrt(variances[:-1] / residual)[sums.group]
    inner = np.eye(len(scale)) + scale[:, None] * sums.zz * scale
    middle = scale[:, None] * np.linalg.inv(inner) * scale
    xvx = (sums.xx - sums.xz @ middle @ sums.xz.T) / residual
    xvy = (sums.xy - sums.xz @ middle @ sums.zy) / residual
    yvy = (sums.yy - sums.zy @ middle @ sums.zy) / residual
    b = np.linalg.solve(xvx, xvy)
    log_v = sums.n * np.log(residual) + np.linalg.slogdet(inner)[1]
    deviance = log_v + np.linalg.slogdet(xvx)[1] + yvy - b @ xvy
    return b, np.linalg.inv(xvx), float(deviance)


def _maximise(sums: _Sums, groups: int) -> Array:
    spread = sums.yy / sums.n - (sums.xy[0] / sums.n) ** 2
    start = np.log(np.full(groups + 1, spread / (groups + 1)))

    def deviance(logs: Array) -> float:
        return _solve(sums, np.exp(logs))[2]

    # The simplex finds the basin even where a variance is next to nothing, the gradient its floor.
    rough = optimize.minimize(deviance, start, method="Nelder-Mead", options={"fatol": 1e-4}).x
    found = optimize.minimize(deviance, rough, method="BFGS", options={"gtol": 1e-7})
    return np.asarray(np.exp(found.x))


def _satterthwaite(sums: _Sums, variances: Array, at: int) -> float:
    """2 v^2 / (g' C g): v the variance of b, g its gradient, C the covariance of the variances."""
    known = variances > 1e-8 * variances.sum()

    def moved(values: Array) -> Array:
        full = variances.copy()
        full[known] = values
        return full

    free = variances[known]
    hessian = _hessian(lambda values: _solve(sums, moved(values))[2], free)
    gradient = _gradient(lambda values: float(_solve(sums, moved(values))[1][at, at]), free)
    variance = float(_solve(sums, variances)[1][at, at])
    return float(2 * variance**2 / (gradient @ (2 * np.linalg.inv(hessian)) @ gradient))


def _gradient(function: Callable[[Array], float], at: Array, step: float = 1e-4) -> Array:
    moves = np.diag(at * step)
    return np.array([(function(at + m) - function(at - m)) / (2 * m.sum()) for m in moves])


def _hessian(function: Callable[[Array], float], at: Array, step: float = 1e-3) -> Array:
    moves = np.diag(at * step)
    found = np.empty((len(at), len(at)))
    for i, a in enumerate(moves):
        for j, b in enumerate(moves):
            corners = function(at + a + b) - function(at + a - b)
            corners -= function(at - a + b) - function(at - a - b)
            found[i, j] = corners / (4 * a.sum() * b.sum())
    return found
