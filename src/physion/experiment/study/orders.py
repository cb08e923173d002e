"""Trial orders, fixation durations and button order, computed from seeds and never stored.

They must not change while a study runs, not even when packages are upgraded: a page reloaded after
an upgrade would otherwise show another order. They are therefore computed from a hash only, not
from numpy's generators, whose streams may change between versions. Sorting by hash values makes all
orders equally likely.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import lru_cache
from typing import Literal

from physion.core.seeds import stable_hash
from physion.experiment.study.identity import Secrets, sign
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


def with_checks(
    study: Study, scenario: str, test: Sequence[Stimulus], order_seed: int
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
    """
    practice = study.phase(scenario, "familiarization")
    checks = list(study.phase(scenario, ATTENTION))
    for number in range(1, study.attention.instructed + 1):
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


Order = dict[str, tuple[Stimulus, ...]]


def individual_order_seed(study: Study, scenario: str, participant: str) -> int:
    """Return the seed (63 bits) of the individual trial order of a participant in a scenario."""
    return stable_hash("own order", study.seed, scenario, participant) >> 65


def prepared_order_seed(study: Study, secrets: Secrets, scenario: str, number: int) -> int:
    """Return the seed (63 bits) of a prepared order; ``number`` counts from 1.

    The seed depends on the study's secret key. There are few prepared orders, so without a key the
    fixation durations would identify the order, and with a public list of stimuli the outcomes.
    """
    signature = sign(secrets, "prepared order", scenario, str(number))
    return stable_hash("prepared order", study.seed, scenario, number, signature) >> 65


def trial_order(study: Study, scenario: str, order_seed: int) -> Order:
    """Return the stimuli of both phases in order: familiarization by place, test by seed.

    Attention checks are among the test trials, as stimuli of the phase ``attention``.
    """
    return dict(_order(StudyKey(study), scenario, order_seed))


def session_trials(study: Study, scenario: str) -> Mapping[str, int]:
    """Return the number of trials of a session by phase."""
    return _trials(StudyKey(study), scenario)


# Cached because every request needs the numbers of its session.
@lru_cache(maxsize=1024)
def _trials(key: StudyKey, scenario: str) -> Mapping[str, int]:
    study = key.study
    counts = {phase: len(study.phase(scenario, phase)) for phase in (*PHASES, ATTENTION)}
    checks = study.attention.instructed + counts.pop(ATTENTION)
    return {**counts, "test": counts["test"] + checks}


# Cached because every request for a movie needs the order of its session.
@lru_cache(maxsize=4096)
def _order(key: StudyKey, scenario: str, order_seed: int) -> Order:
    study = key.study
    shown = study.phase(scenario, "test")
    ranked = sorted(shown, key=lambda each: stable_hash("trial", order_seed, each.stimulus))
    test = with_checks(study, scenario, ranked, order_seed)
    return {"familiarization": study.phase(scenario, "familiarization"), "test": tuple(test)}


def fixations(study: Study, scenario: str, order_seed: int, phase: str) -> tuple[int, ...]:
    """Return the duration in ms (integer, uniform) of the fixation cross before each trial."""
    count = session_trials(study, scenario)[phase]
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
