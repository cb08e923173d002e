"""Orders of trials, lengths of fixation, order of buttons: functions of seeds, never stored.

They must not change while a study runs, whatever is installed: a reload after an upgrade would show
another order. So they rest on a hash alone, and not on numpy's generators, whose streams may change
between versions. Sorting by hash values gives each order the same chance.
"""

from __future__ import annotations

from functools import lru_cache
from typing import Literal

from physion.experiment.study.identity import Secrets, sign
from physion.experiment.study.stimuli import PHASES, Stimulus
from physion.experiment.study.study import Study
from physion.seeds import stable_hash

Order = dict[str, tuple[Stimulus, ...]]


def own_order_seed(study: Study, scenario: str, participant: str) -> int:
    """Seed (63 bits) of the order that one participant alone gets in a scenario."""
    return stable_hash("own order", study.seed, scenario, participant) >> 65


def prepared_order_seed(study: Study, secrets: Secrets, scenario: str, number: int) -> int:
    """Seed (63 bits) of a prepared order, from number 1.

    It depends on the study's key: there are so few that else the lengths of the crosses would tell
    which one it is, and with a public list of stimuli so the outcomes.
    """
    word = sign(secrets, "prepared order", scenario, str(number))
    return stable_hash("prepared order", study.seed, scenario, number, word) >> 65


def order_of(study: Study, scenario: str, order_seed: int) -> Order:
    """The stimuli of both phases: familiarization by place, the test by seed."""
    return dict(_order(_Same(study), scenario, order_seed))


class _Same:
    """A study as the key of a cache: the very same object, since studies have no hash."""

    __slots__ = ("study",)

    def __init__(self, study: Study) -> None:
        self.study = study

    def __hash__(self) -> int:
        return id(self.study)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, _Same) and self.study is other.study


# Every request for a movie asks for the order of its session.
@lru_cache(maxsize=4096)
def _order(key: _Same, scenario: str, order_seed: int) -> Order:
    study = key.study
    test = sorted(
        study.phase(scenario, "test"),
        key=lambda stimulus: stable_hash("trial", order_seed, stimulus.stimulus),
    )
    return {"familiarization": study.phase(scenario, "familiarization"), "test": tuple(test)}


def fixations(study: Study, scenario: str, order_seed: int, phase: str) -> tuple[int, ...]:
    """Milliseconds of the cross before each trial of a phase; whole ones, all equally likely."""
    count = len(study.phase(scenario, phase))
    if phase == PHASES[0] and not study.timing.fixation_in_familiarization:
        return (0,) * count
    low, high = study.timing.fixation_ms
    draws = (stable_hash("fixation", order_seed, phase, trial) for trial in range(count))
    return tuple(low + draw % (high - low + 1) for draw in draws)


def draw_buttons(study: Study, participant: str) -> Literal["yes-no", "no-yes"]:
    """The buttons from left to right, the same in all scenarios of a participant."""
    return "no-yes" if stable_hash("buttons", study.seed, participant) & 1 else "yes-no"
