"""Seeds and random generators, derived from names only, so that results do not depend on the order
or the machine of a computation."""

from __future__ import annotations

import hashlib
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import numpy as np


def stable_hash(*parts: str | int) -> int:
    """Return a 128-bit hash of ``parts``, the same in every process and Python version."""
    text = "\x1f".join(f"{type(part).__name__}:{part}" for part in parts)
    return int.from_bytes(hashlib.blake2b(text.encode(), digest_size=16).digest(), "little")


def trial_seed(
    dataset: str | int, scenario: str, split: str, index: int, attempt: int = 0
) -> np.random.SeedSequence:
    """Return the seed of one trial, a function of the trial's name only.

    - ``dataset``, ``scenario``, ``split``, ``index``: name of the trial.
    - ``attempt``: number of scenes sampled for this trial and rejected before; each has a different
      seed.
    """
    parts = (dataset, scenario, split, index)
    return named_seed(*parts, attempt) if attempt else named_seed(*parts)


def named_seed(*parts: str | int) -> np.random.SeedSequence:
    """Return the seed that is derived from ``parts``, for use with `child_generator`."""
    import numpy as np  # imported late: `stable_hash` is used by programs that must start fast

    return np.random.SeedSequence(stable_hash(*parts))


def child_generator(seed: np.random.SeedSequence, name: str) -> np.random.Generator:
    """Return the random stream called ``name`` (``placement``, ``looks``, ...) of a trial.

    Streams of different names are independent: drawing one more number in one of them, for
    example for a distractor, does not change what the others draw.
    """
    import numpy as np

    entropy = seed.entropy
    assert isinstance(entropy, int), "seeds are made by named_seed"
    return np.random.default_rng(np.random.SeedSequence([entropy, stable_hash(name)]))


def generator(*parts: str | int) -> np.random.Generator:
    """Return the random stream whose seed is derived from ``parts``."""
    import numpy as np

    return np.random.default_rng(stable_hash(*parts))
