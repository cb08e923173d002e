"""Random numbers that depend on what is made, never on when or where it is made."""

from __future__ import annotations

import hashlib
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import numpy as np


def stable_hash(*parts: str | int) -> int:
    """A 128-bit number of the parts that is the same in every process and Python version."""
    text = "\x1f".join(f"{type(part).__name__}:{part}" for part in parts)
    return int.from_bytes(hashlib.blake2b(text.encode(), digest_size=16).digest(), "little")


def trial_seed(
    dataset: str | int, scenario: str, split: str, index: int, attempt: int = 0
) -> np.random.SeedSequence:
    """The seed of one trial, a function of what names it and nothing else.

    ``attempt`` counts the draws that were refused before: each has a seed of its own.
    """
    parts = (dataset, scenario, split, index)
    return named_seed(*parts, attempt) if attempt else named_seed(*parts)


def named_seed(*parts: str | int) -> np.random.SeedSequence:
    """Return the seed that these parts name, for `child_generator`."""
    import numpy as np  # here, since `stable_hash` alone serves programs that should start quickly

    return np.random.SeedSequence(stable_hash(*parts))


def child_generator(seed: np.random.SeedSequence, name: str) -> np.random.Generator:
    """The named random stream of a trial (``placement``, ``looks``, ``distractors``, ...).

    Streams are independent of each other, so that drawing one number more for a distractor does
    not move the agent.
    """
    import numpy as np

    entropy = seed.entropy
    assert isinstance(entropy, int), "seeds are made by named_seed"
    return np.random.default_rng(np.random.SeedSequence([entropy, stable_hash(name)]))


def generator(*parts: str | int) -> np.random.Generator:
    """Return the random stream that these parts name."""
    import numpy as np

    return np.random.default_rng(stable_hash(*parts))
