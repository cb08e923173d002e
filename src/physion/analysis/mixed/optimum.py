"""The minimum of a smooth function with a gradient, its curvature there, and proof that it is one.

Standard deviations are searched over the whole line: the functions are even in them, so that a
variance of zero, where others need a bound, is an ordinary minimum. So they are in the last
diagonal entry of the triangle of correlated effects, which is zero for a correlation of 1.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.optimize import minimize

Array = npt.NDArray[np.float64]
Flags = npt.NDArray[np.bool_]
Objective = Callable[[Array], tuple[float, Array]]

STEP = 1e-3
"""Step of the differences of gradients, in units of a parameter's scale."""

CLOSE = 1e-6
"""Expected further decrease of the function below which the search has converged."""

SMALL = 0.05
"""Size of even parameters below which zero is tried as well."""


@dataclass(frozen=True)
class Optimum:
    """Result of the search; ``left`` is the expected decrease by a further Newton step, ``zero``
    (k,) whether an even parameter is zero.
    """

    at: Array
    value: float
    hessian: Array
    left: float
    zero: Flags

    @property
    def converged(self) -> bool:
        """Whether the curvature is positive definite and no further decrease is expected."""
        return bool(np.isfinite(self.left) and abs(self.left) < CLOSE)


def find_optimum(objective: Objective, start: Array, scale: Array, even: Flags) -> Optimum:
    """Minimise ``objective`` from ``start`` (k,); it is even in the parameters ``even`` (k,).

    ``scale`` is a matrix (k, k) whose columns are steps of about one standard error: the search is
    in their coordinates. Quasi-Newton first, then Newton steps on differences of the gradient,
    whose matrix is the Hessian that standard errors come from.
    """

    def scaled(z: Array) -> tuple[float, Array]:
        value, gradient = objective(start + scale @ z)
        return value, scale.T @ gradient

    options = {"gtol": 1e-4, "maxiter": 200}
    found = minimize(scaled, np.zeros(len(start)), jac=True, method="BFGS", options=options)
    at = start + scale @ found.x
    at[even] = np.abs(at[even])
    size = np.sqrt((scale**2).sum(axis=1))
    best = objective(at)
    for _ in range(4):
        at, best, zero = _try_zero(objective, at, best, even)
        hessian = difference_gradient(objective, at, size)
        step, left = _newton(hessian, best[1])
        step[zero] = 0.0
        trial = objective(at - step) if np.isfinite(left) else (np.inf, best[1])
        if trial[0] > best[0]:
            break
        at, best, before = at - step, trial, left
        left = _newton(hessian, best[1])[1]
        if before < CLOSE:
            break
    return Optimum(at, best[0], hessian, left, zero)


def _newton(hessian: Array, gradient: Array) -> tuple[Array, float]:
    """Return the Newton step and half of gradient times step; infinite if not positive definite."""
    if np.linalg.eigvalsh(hessian)[0] <= 0:
        return np.zeros_like(gradient), np.inf
    step = np.asarray(np.linalg.solve(hessian, gradient), dtype=np.float64)
    return step, float(gradient @ step) / 2


def _try_zero(
    objective: Objective, at: Array, best: tuple[float, Array], even: Flags
) -> tuple[Array, tuple[float, Array], Flags]:
    """Set small even parameters to zero if that does not increase the function."""
    zero = np.zeros(len(at), dtype=bool)
    for k in np.flatnonzero(even):
        if abs(at[k]) < SMALL:
            trial = at.copy()
            trial[k] = 0.0
            value, gradient = objective(trial)
            if value <= best[0] + 1e-9 * max(1.0, abs(best[0])) ** 0.5:
                at, best, zero[k] = trial, (value, gradient), True
    return at, best, zero


def difference_gradient(objective: Objective, at: Array, size: Array) -> Array:
    """Return the Hessian (k, k) by central differences of the gradient with steps of STEP *
    ``size``.
    """
    columns = []
    for k, step in enumerate(STEP * size):
        shift = np.zeros_like(at)
        shift[k] = step
        columns.append((objective(at + shift)[1] - objective(at - shift)[1]) / (2 * step))
    hessian = np.array(columns, dtype=np.float64)
    return np.asarray((hessian + hessian.T) / 2)
