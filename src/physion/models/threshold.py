"""Threshold on a distance that separates contacts from misses best."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray


def best_threshold(gaps: NDArray[np.float64], labels: NDArray[np.bool_]) -> float:
    """Return the threshold (m) under which ``gap <= threshold`` equals most ``labels`` (n,).

    The candidates are 0 and the middles between neighbouring gaps. Among those that are right
    equally often, the one closest to 0 is returned; without labels it is 0.
    """
    values = np.unique(gaps[np.isfinite(gaps)])
    candidates = np.concatenate([[0.0], (values[1:] + values[:-1]) / 2])
    if len(labels) == 0:
        return 0.0
    hits = (gaps[None, :] <= candidates[:, None]) == labels[None, :]
    right = hits.sum(axis=1)
    best = candidates[right == right.max()]
    return float(best[np.argmin(np.abs(best))])
