"""Attention checks: trials mixed into the test whose right answer is obvious or stated.

Obvious ones are the stimuli of ``stimuli.csv`` with the phase ``attention``. Instructed ones show
the observed part of a practice movie, after which the pages say which button to press. The seed of
the session's trial order decides both the positions and what is to be pressed; test stimuli keep
their order.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import replace

from physion.core.seeds import stable_hash
from physion.experiment.study.stimuli import ATTENTION, Stimulus
from physion.experiment.study.study import Study

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
