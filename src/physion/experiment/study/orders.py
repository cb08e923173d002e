"""Trial orders, fixation durations and button order, computed from seeds and never stored.

They must not change while a study runs, not even when packages are upgraded: a page reloaded after
an upgrade would otherwise show another order. They are therefore computed from a hash only, not
from numpy's generators, whose streams may change between versions. Sorting by hash values makes all
orders equally likely.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import replace
from functools import cache, lru_cache
from itertools import permutations
from typing import Literal

from physion.core.seeds import stable_hash
from physion.experiment.protocol import Block, SessionTrials
from physion.experiment.study.identity import Secrets, sign
from physion.experiment.study.settings import ALL_SCENARIOS
from physion.experiment.study.stimuli import ATTENTION, PHASES, Stimulus
from physion.experiment.study.study import Study, StudyKey

# Attention checks: trials mixed into the test whose right answer is obvious or stated.
#
# Obvious ones are the stimuli of ``stimuli.csv`` with the phase ``attention``. Instructed ones
# show the observed part of a practice movie, after which the pages say which button to press. The
# seed of the session's trial order decides both the positions and what is to be pressed; test
# stimuli keep their order.

_INSTRUCTED = re.compile(r"instructed_[0-9]+_(yes|no)")


def instructed_response(name: str) -> str | None:
    """Return the response that an instructed check asks for, by its name; None for others."""
    match = _INSTRUCTED.fullmatch(name)
    return match[1] if match else None


def count_checks(study: Study, scenario: str) -> int:
    """Return the number of attention checks among the test trials of a scenario."""
    return study.attention.instructed + len(study.phase(scenario, ATTENTION))


def with_checks(
    study: Study, scenario: str, test: Sequence[Stimulus], order_seed: int, first: int
) -> list[Stimulus]:
    """Return the test trials of a scenario with its attention checks among them.

    With n test trials and k checks, in an order drawn by the seed, check i comes after one of the
    test trials ``i n // k`` to ``(i + 1) n // k - 1``, each equally likely: checks are spread over
    the test, and the first trial is none.

    Parameters
    ----------
    study
        The study.
    scenario
        The scenario of these trials.
    test
        Its test trials in the order of the session.
    order_seed
        Seed of the session's trial order.
    first
        Number of instructed checks in earlier blocks of the session, for their names.
    """
    practice = study.phase(scenario, "familiarization")
    checks = list(study.phase(scenario, ATTENTION))
    for number in range(first + 1, first + study.attention.instructed + 1):
        drawn = stable_hash("instructed", order_seed, number)
        base = practice[drawn % len(practice)]
        response = "yes" if drawn >> 64 & 1 else "no"
        checks.append(
            replace(
                base, stimulus=f"instructed_{number}_{response}", phase=ATTENTION,
                label=response == "yes", full="", full_frames=0,
            )
        )  # fmt: skip
    checks.sort(key=lambda each: stable_hash("check", order_seed, each.stimulus))
    trials, count = list(test), len(checks)
    for index in reversed(range(count)):
        low, high = index * len(test) // count, (index + 1) * len(test) // count
        offset = stable_hash("position", order_seed, checks[index].stimulus) % max(1, high - low)
        trials.insert(low + offset + 1, checks[index])
    return trials


# Blocks of a session that runs through several scenarios: their orders, and draws of trials.
#
# The order of the blocks follows from the seed of the session's trial order, so that it need not
# be stored: with K orders, a session with the seed s has order ``s mod K``.

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


Order = dict[str, tuple[Stimulus, ...]]


def individual_order_seed(
    study: Study, scenario: str, participant: str, block_order: int = 0
) -> int:
    """Return the seed (63 bits) of the individual trial order of a participant in a scenario.

    ``block_order``: the index of the order of the blocks, if a session has several scenarios.
    """
    seed = stable_hash("own order", study.seed, scenario, participant) >> 65
    return seed_with_order(study, seed, block_order) if scenario == ALL_SCENARIOS else seed


def prepared_order_seed(study: Study, secrets: Secrets, scenario: str, number: int) -> int:
    """Return the seed (63 bits) of a prepared order; ``number`` counts from 1.

    If a session has several scenarios, the prepared orders take the orders of blocks in turn.
    The seed depends on the study's secret key. There are few prepared orders, so without a key the
    fixation durations would identify the order, and with a public list of stimuli the outcomes.
    """
    signature = sign(secrets, "prepared order", scenario, str(number))
    seed = stable_hash("prepared order", study.seed, scenario, number, signature) >> 65
    return seed_with_order(study, seed, number - 1) if scenario == ALL_SCENARIOS else seed


def trial_order(study: Study, scenario: str, order_seed: int) -> Order:
    """Return the stimuli of both phases in order: familiarization by place, test by seed.

    Attention checks are among the test trials, as stimuli of the phase ``attention``.

    If the session has several scenarios, each phase has the trials of all blocks, block by block.
    """
    return dict(_order(StudyKey(study), scenario, order_seed))


def session_trials(study: Study, scenario: str, order_seed: int) -> SessionTrials:
    """Return the numbers of trials of a session, and its blocks."""
    return _trials(StudyKey(study), scenario, block_scenarios(study, scenario, order_seed))


# Cached because every request needs the numbers of its session.
@lru_cache(maxsize=1024)
def _trials(key: StudyKey, scenario: str, blocks: tuple[str, ...]) -> SessionTrials:
    study = key.study
    several = scenario == ALL_SCENARIOS
    found: list[Block] = []
    practice = test = 0
    for name in blocks:
        before = practice, test
        if not found or study.blocks.familiarization == "each":
            practice += len(study.phase(name, "familiarization"))
        test += (several and study.blocks.trials) or len(study.phase(name, "test"))
        test += count_checks(study, name)
        found.append(Block(name, range(before[0], practice), range(before[1], test)))
    return SessionTrials(tuple(found))


# Cached because every request for a movie needs the order of its session.
@lru_cache(maxsize=4096)
def _order(key: StudyKey, scenario: str, order_seed: int) -> Order:
    study = key.study
    practice: list[Stimulus] = []
    test: list[Stimulus] = []
    for position, block in enumerate(session_trials(study, scenario, order_seed).blocks):
        if block.familiarization:
            practice += study.phase(block.scenario, "familiarization")
        drawn: Sequence[Stimulus] = study.phase(block.scenario, "test")
        if scenario == ALL_SCENARIOS:
            drawn = draw_test(study, drawn, order_seed)
        ranked = sorted(drawn, key=lambda each: stable_hash("trial", order_seed, each.stimulus))
        instructed = position * study.attention.instructed
        test += with_checks(study, block.scenario, ranked, order_seed, instructed)
    return {"familiarization": tuple(practice), "test": tuple(test)}


def fixations(study: Study, scenario: str, order_seed: int, phase: str) -> tuple[int, ...]:
    """Return the duration in ms (integer, uniform) of the fixation cross before each trial."""
    count = session_trials(study, scenario, order_seed)[phase]
    return tuple(fixation(study, order_seed, phase, trial) for trial in range(count))


def fixation(study: Study, order_seed: int, phase: str, trial: int) -> int:
    """Return the duration in ms of the fixation cross before one trial."""
    if phase == PHASES[0] and not study.timing.fixation_in_familiarization:
        return 0
    low, high = study.timing.fixation_ms
    return low + stable_hash("fixation", order_seed, phase, trial) % (high - low + 1)


def draw_buttons(study: Study, participant: str) -> Literal["yes-no", "no-yes"]:
    """Return the buttons from left to right; the same in all scenarios of a participant."""
    return "no-yes" if stable_hash("buttons", study.seed, participant) & 1 else "yes-no"
