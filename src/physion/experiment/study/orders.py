"""Trial orders, fixation durations and button order, computed from seeds and never stored.

They must not change while a study runs, not even when packages are upgraded: a page reloaded after
an upgrade would otherwise show another order. They are therefore computed from a hash only, not
from numpy's generators, whose streams may change between versions. Sorting by hash values makes all
orders equally likely.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache
from typing import Literal

from physion.core.seeds import stable_hash
from physion.experiment.protocol.stages import Block, SessionTrials
from physion.experiment.study.courses.attention import count_checks, with_checks
from physion.experiment.study.courses.blocks import block_scenarios, draw_test, seed_with_order
from physion.experiment.study.courses.variants import StudyKey
from physion.experiment.study.identity import Secrets, sign
from physion.experiment.study.stimuli import PHASES, Stimulus
from physion.experiment.study.study import ALL_SCENARIOS, Study

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
