"""Blocks of a session that runs through several scenarios: their orders, and draws of trials.

The order of the blocks follows from the seed of the session's trial order, so that it need not be
stored: with K orders, a session with the seed s has order ``s mod K``.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache
from itertools import permutations

from physion.core.seeds import stable_hash
from physion.experiment.study.stimuli import Stimulus
from physion.experiment.study.study import ALL_SCENARIOS, Study

MOST_PERMUTED = 4
"""Up to this many blocks all orders are used; more have a Latin square."""
_MOST_SEED = 2**63 - 1
"""Largest integer that the databases store."""


@cache
def block_orders(count: int) -> tuple[tuple[int, ...], ...]:
    """Return the orders of ``count`` blocks that the sessions of a study use equally often.

    Up to `MOST_PERMUTED` blocks all permutations. With more, a Latin square that is balanced for
    neighbours: each block is at each position equally often, and each follows each other one
    equally often. For even n, the first row is 0, 1, n-1, 2, n-2, ..., and row i adds i modulo n;
    for odd n, the reversed rows are added.

    References
    ----------
    E. J. Williams (1949), Experimental designs balanced for the estimation of residual effects of
    treatments, Australian Journal of Scientific Research A 2, 149-168.
    """
    if count <= MOST_PERMUTED:
        return tuple(permutations(range(count)))
    steps = range(1, count)
    first = [0, *((step + 1) // 2 if step % 2 else count - step // 2 for step in steps)]
    rows = [tuple((index + row) % count for index in first) for row in range(count)]
    return tuple(rows + [row[::-1] for row in rows] if count % 2 else rows)


def seed_with_order(study: Study, seed: int, number: int) -> int:
    """Return the seed closest to ``seed`` from which `block_scenarios` derives order ``number``.

    ``number`` counts from 0, and is taken modulo the number of orders.
    """
    count = len(block_orders(len(study.scenarios)))
    near = seed - seed % count + number % count
    return near if near <= _MOST_SEED else near - count


def order_number(study: Study, order_seed: int) -> int:
    """Return the index of the order of the blocks of a session in `block_orders`."""
    return order_seed % len(block_orders(len(study.scenarios)))


def block_scenarios(study: Study, scenario: str, order_seed: int) -> tuple[str, ...]:
    """Return the scenarios of a session in the order of its blocks."""
    if scenario != ALL_SCENARIOS:
        return (scenario,)
    order = block_orders(len(study.scenarios))[order_number(study, order_seed)]
    return tuple(study.scenarios[index] for index in order)


def stimuli_by_session(study: Study) -> dict[tuple[str, str], Stimulus]:
    """Return the stimuli by the scenario of the sessions that show them and their name."""
    several = study.blocks.all_scenarios
    return {(ALL_SCENARIOS if several else s.scenario, s.stimulus): s for s in study.stimuli}


def draw_test(study: Study, stimuli: Sequence[Stimulus], order_seed: int) -> list[Stimulus]:
    """Draw the test stimuli of a block: ``blocks.trials`` of them, half with contact.

    If one outcome has too few stimuli, the other one fills up; if the number is odd, the seed
    decides which outcome has one more. The order of the result has no meaning.
    """
    wanted = study.blocks.trials or len(stimuli)
    ranked = sorted(stimuli, key=lambda each: stable_hash("drawn", order_seed, each.stimulus))
    contact = [each for each in ranked if each.label]
    without = [each for each in ranked if not each.label]
    odd = wanted % 2 and stable_hash("odd", order_seed, stimuli[0].scenario) & 1
    half = wanted // 2 + (1 if odd else 0)
    first = max(min(half, len(contact)), wanted - len(without))
    return contact[:first] + without[: wanted - first]
