"""Drift diffusion model of right and wrong answers and their times, fitted by PyDDM.

Evidence begins midway between two boundaries that lie ``boundary`` apart (upper: right, lower:
wrong), moves by ``drift`` a second with noise of standard deviation 1 per root second, and is
answered when it reaches one; ``nondecision_s`` is the rest of the response time (R. Ratcliff, A
theory of memory retrieval, Psychological Review 85, 1978). Two per cent of the answers are taken as
given at any time, so that single slow or early ones hardly matter.

PyDDM (M. Shinn, N. H. Lam, J. D. Murray, eLife 9, 2020) computes the likelihood; the search starts
at the closed-form estimates of E.-J. Wagenmakers, H. L. J. van der Maas and R. P. P. P. Grasman,
An EZ-diffusion model for response time and accuracy, Psychonomic Bulletin & Review 14, 2007.
"""

from __future__ import annotations

import contextlib
import importlib.util
import io
import logging
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
import pandas as pd

from physion.core.errors import BadInputError, MissingExtraError

Array = npt.NDArray[np.float64]

FEWEST = 40
"""Fewest answers of a session that are fitted."""

LONGEST_S = 10.0
"""Answers after this many seconds are left out: nobody decides for so long."""

STEP_S = 0.01
"""Step of time in which the likelihood is computed, in seconds."""

_LEVELS = (logging.DEBUG, logging.INFO, logging.WARNING, logging.ERROR, logging.CRITICAL)

BOUNDS: Mapping[str, tuple[float, float]] = {
    "drift": (-8.0, 8.0),
    "half_boundary": (0.1, 5.0),
    "nondecision_s": (0.0, 2.0),
}
"""Range of each parameter in the search; ``boundary`` is twice ``half_boundary``."""


@dataclass(frozen=True)
class DiffusionFit:
    """Estimates from the answers of one session.

    ``drift`` in units of noise per second, ``boundary`` in units of noise, ``nondecision_s`` in
    seconds; NaN with a ``reason`` if there is no estimate. ``answers`` were fitted, ``left_out``
    were not: no time, or more than `LONGEST_S`.
    """

    answers: int
    left_out: int
    accuracy: float
    drift: float
    boundary: float
    nondecision_s: float
    log_likelihood: float
    reason: str


def fit_diffusion(correct: npt.ArrayLike, rt_s: npt.ArrayLike) -> DiffusionFit:
    """Fit drift, boundary and nondecision time by maximum likelihood.

    ``correct`` (n,) is 1 or 0, ``rt_s`` (n,) in seconds, NaN if unknown. Raises `BadInputError` for
    negative times, and `MissingExtraError` without PyDDM.
    """
    right, times = np.asarray(correct, dtype=np.float64), np.asarray(rt_s, dtype=np.float64)
    if (times < 0).any():
        raise BadInputError("a response time is negative")
    known = times <= LONGEST_S
    right, times = right[known], times[known]
    counts = {"answers": len(times), "left_out": int((~known).sum())}
    accuracy = float(np.mean(right)) if len(right) else float("nan")
    empty = DiffusionFit(**counts, accuracy=accuracy, drift=np.nan, boundary=np.nan,
                         nondecision_s=np.nan, log_likelihood=np.nan, reason="")  # fmt: skip
    if len(times) < FEWEST:
        return DiffusionFit(**{**asdict(empty), "reason": f"fewer than {FEWEST} answers"})
    if np.ptp(times) == 0:
        return DiffusionFit(**{**asdict(empty), "reason": "all response times are equal"})
    found, log_likelihood = _search(right, times)
    at_bound = [
        name
        for name, (low, high) in BOUNDS.items()
        if min(found[name] - low, high - found[name]) < 1e-3 * (high - low)
    ]
    reason = f"the search ended at its bound of {' and '.join(at_bound)}" if at_bound else ""
    return DiffusionFit(
        **counts,
        accuracy=accuracy,
        drift=found["drift"],
        boundary=2 * found["half_boundary"],
        nondecision_s=found["nondecision_s"],
        log_likelihood=log_likelihood,
        reason=reason,
    )


def _library() -> tuple[Any, Any]:
    """Return the module and its loss; it renames the levels of all logs, which is undone."""
    if importlib.util.find_spec("pyddm") is None:
        raise MissingExtraError("the drift diffusion model", "diffusion")
    levels = {value: logging.getLevelName(value) for value in _LEVELS}
    try:
        import pyddm
        from pyddm.models import LossRobustLikelihood
    finally:
        for value, name in levels.items():
            logging.addLevelName(value, name)
    return pyddm, LossRobustLikelihood


def _search(right: Array, times: Array) -> tuple[dict[str, float], float]:
    """Return the estimates by name and the log-likelihood."""
    pyddm, loss = _library()
    start = _closed_form(right, times)
    parameters = {
        name: pyddm.Fittable(minval=low, maxval=high, default=start[name])
        for name, (low, high) in BOUNDS.items()
    }
    model = pyddm.gddm(
        drift="drift", bound="half_boundary", nondecision="nondecision_s", parameters=parameters,
        mixture_coef=0.02, T_dur=float(np.ceil(times.max()) + 1), dt=STEP_S,
    )  # fmt: skip
    sample = pyddm.Sample.from_pandas_dataframe(
        pd.DataFrame({"rt": times, "right": right.astype(np.int64)}),
        rt_column_name="rt",
        choice_column_name="right",
    )
    # The library prints its progress even if asked not to.
    with contextlib.redirect_stdout(io.StringIO()):
        model.fit(sample, loss, fitting_method="simplex", verbose=False)
    # The library renames parameters of constant drift, bound and nondecision time.
    values = model.parameters()
    found = {
        "drift": float(values["drift"]["drift"]),
        "half_boundary": float(values["bound"]["B"]),
        "nondecision_s": float(values["overlay"]["nondectime"]),
    }
    return found, -float(model.get_fit_result().value())


def _closed_form(right: Array, times: Array) -> dict[str, float]:
    """Return the EZ estimates within the bounds of the search.

    With the fraction right P (half an answer moved off 0, 0.5 and 1), L = log(P / (1 - P)), and
    mean M and variance V of the times of right answers::

        drift = sign(P - 1/2) (L (L P^2 - L P + P - 1/2) / V)^(1/4)
        boundary = L / drift
        decision time = boundary / (2 drift) tanh(boundary drift / 2),  nondecision = M - that
    """
    n = len(right)
    fraction = float(np.clip(np.mean(right), 0.5 / n, 1 - 0.5 / n))
    if abs(fraction - 0.5) < 0.5 / n:
        fraction = 0.5 + 0.5 / n
    own = times[right == (1 if fraction > 0.5 else 0)]
    logit = np.log(fraction / (1 - fraction))
    spread = max(float(np.var(own)), 1e-4)
    size = logit * (logit * fraction**2 - logit * fraction + fraction - 0.5) / spread
    drift = float(np.sign(fraction - 0.5)) * np.sqrt(np.sqrt(size))
    boundary = logit / drift
    decision = boundary / (2 * drift) * np.tanh(boundary * drift / 2)
    raw = {"drift": drift, "half_boundary": boundary / 2, "nondecision_s": own.mean() - decision}
    # The nondecision time cannot exceed the fastest answer by much.
    raw["nondecision_s"] = min(raw["nondecision_s"], 0.95 * float(times.min()))
    inside = {name: (low, high, 0.01 * (high - low)) for name, (low, high) in BOUNDS.items()}
    return {
        name: float(np.clip(raw[name], low + margin, high - margin))
        for name, (low, high, margin) in inside.items()
    }


def diffusion_by_session(test: pd.DataFrame) -> pd.DataFrame:
    """Return one row a session: ``scenario``, ``session``, ``participant`` and a `DiffusionFit`.

    ``test``: the test rows of `participants.Responses`, in which times are milliseconds.
    """
    records: list[dict[str, Any]] = []
    keys = ["scenario", "session", "participant"]
    for values, rows in test.groupby(keys, sort=False):
        fit = fit_diffusion(rows["correct"], rows["rt_ms"].to_numpy(dtype=np.float64) / 1000)
        records.append({**dict(zip(keys, values, strict=True)), **asdict(fit)})
    return pd.DataFrame(records)
