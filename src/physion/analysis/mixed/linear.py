"""Linear mixed models with crossed random effects (restricted maximum likelihood).

As lme4::lmer with lmerTest: variances maximise the restricted likelihood, profiled over the
residual variance; t tests have Satterthwaite's degrees of freedom. Not statsmodels' MixedLM: it has
no degrees of freedom, and for crossed groups of this size does not finish in 300 s (``python
benchmarks/analysis/mixed.py --others``).
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import numpy.typing as npt
import pandas as pd

from physion.analysis.mixed.design import build_design
from physion.analysis.mixed.linear_model import LinearModel
from physion.analysis.mixed.linear_slopes import SlopesModel
from physion.analysis.mixed.optimum import Optimum, difference_gradient, find_optimum
from physion.analysis.mixed.result import MixedFit, collect
from physion.core.errors import BadInputError

Array = npt.NDArray[np.float64]


def fit_linear(formula: str, data: pd.DataFrame, level: float = 0.95) -> MixedFit:
    """Fit a linear mixed model such as ``log_rt ~ scenario + x + (1 + x|participant) +
    (1|stimulus)``.

    The response is numeric, or True/False for the linear probability models of the paper
    (``model_correct ~ ...``). The table has t tests with Satterthwaite's degrees of freedom.
    ``level`` is that of the intervals.

    Rows with a missing value are left out, counted in ``missing`` and named in ``warnings``. Raises
    `BadInputError` for unknown columns, a constant response, a group of one level or with a level
    for each row, slopes of what does not vary within a level, and fixed effects that depend on each
    other or explain everything.
    """
    design = build_design(formula, data)
    for group in design.groups:
        if group.levels * len(group.effects) >= len(design.y):
            raise BadInputError(
                f"{group.name!r} has as many levels as there are rows: its variance cannot be told "
                "from the residual one"
                if len(group.effects) == 1
                else f"{group.name!r} has as many random effects as there are rows"
            )
    intercepts = all(group.intercept_alone for group in design.groups)
    model = LinearModel(design) if intercepts else SlopesModel(design)
    random = model.random
    scale = np.diag(0.5 / np.sqrt(random.levels))
    start = random.from_diagonal(np.full(len(random.diagonal), 0.5))
    optimum = find_optimum(model.profiled, start, scale, random.even)
    at = np.where(random.even, np.abs(optimum.at), optimum.at)
    solution = model.solve(at)
    sigma = float(np.sqrt(solution.sigma2))
    return collect(
        design,
        kind="linear, restricted maximum likelihood",
        b=model.coefficients(solution),
        covariance=solution.sigma2 * model.backward(solution.unit_covariance),
        roots=[root * sigma for root in random.roots(at)],
        singular=random.singular(at),
        log_likelihood=-optimum.value,
        effects=random.effects(at, solution.u),
        converged=optimum.converged,
        notes=[],
        level=level,
        residual=sigma,
        df=_satterthwaite(model, at, optimum),
    )


def _satterthwaite(model: LinearModel, at: Array, optimum: Optimum) -> Callable[[Array], float]:
    """Return a function from a contrast of the fixed effects to its degrees of freedom.

    2 v^2 / var(v) for the contrast's variance v. The variance of v comes from its slopes by the
    variance parameters (``at``, and the logarithm of the residual variance) and their covariance,
    the inverse of the observed information. Variances estimated as zero count as known.
    """
    solution = model.solve(at)
    sigma2, free = solution.sigma2, np.flatnonzero(~optimum.zero)
    covariance = sigma2 * model.backward(solution.unit_covariance)
    information = np.zeros((1 + len(free),) * 2)
    information[0, 0] = (model.n - model.p) / 2

    def gradient(values: Array) -> tuple[float, Array]:
        moved = at.copy()
        moved[free] = values
        return 0.0, model.gradient(moved, sigma2)[free]

    size = 0.5 * np.maximum(np.abs(at[free]), 0.01)
    information[1:, 1:] = difference_gradient(gradient, at[free], size)
    information[0, 1:] = information[1:, 0] = model.fall_of_rest(solution)[free] / sigma2
    changes = model.covariance_changes(solution)
    slopes = [covariance, *(sigma2 * model.backward(changes[k]) for k in free)]
    spread = np.linalg.pinv(information, hermitian=True)

    def degrees(contrast: Array) -> float:
        variance = float(contrast @ covariance @ contrast)
        slope = np.array([contrast @ one @ contrast for one in slopes])
        return 2 * variance**2 / float(slope @ spread @ slope)

    return degrees
