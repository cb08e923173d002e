"""Bootstrap intervals by drawing people, or whatever else is independent, with replacement.

For means and agreement of people, as preregistered. What depends on the noise of people's averages,
such as a model's r or RMSD, has the intervals of `jackknife`, since drawing people again adds their
noise a second time.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import numpy.typing as npt

from physion.core.errors import BadInputError
from physion.core.seeds import generator

Array = npt.NDArray[np.float64]


@dataclass(frozen=True)
class Bootstrap:
    """Settings of the bootstrap: draws, seed, and the fraction of draws that an interval covers."""

    resamples: int = 1000
    seed: int = 0
    level: float = 0.95

    def __post_init__(self) -> None:
        if self.resamples < 1 or not 0 < self.level < 1:
            raise BadInputError("a bootstrap needs resamples >= 1 and a level between 0 and 1")

    def weights(self, stratum: str, n: int) -> Array:
        """Return how often each of ``n`` stimuli or people is drawn: (resamples, n), rows sum to n.

        It depends on the seed, the name of the stratum and n alone.
        """
        return _weights(self.resamples, self.seed, stratum, n)

    def interval(self, draws: Array) -> tuple[float, float]:
        """Return the percentile interval of a statistic's ``draws`` (resamples,).

        Draws in which the statistic is undefined are left out; NaN, NaN if less than half remain.
        """
        defined = draws[np.isfinite(draws)]
        if 2 * len(defined) < len(draws):
            return float("nan"), float("nan")
        tail = 50 * (1 - self.level)
        low, high = np.percentile(defined, [tail, 100 - tail])
        return float(low), float(high)


@lru_cache(maxsize=64)
def _weights(resamples: int, seed: int, stratum: str, n: int) -> Array:
    rng = generator("bootstrap", seed, stratum, n)
    drawn = rng.integers(0, n, size=(resamples, n)) if n else np.zeros((resamples, 0), int)
    rows = np.arange(resamples)[:, None] * n
    counts = np.bincount((drawn + rows).ravel(), minlength=resamples * n)
    weights = counts.reshape(resamples, n).astype(np.float64)
    weights.flags.writeable = False
    return weights
