"""A simple model of a person who takes part: how often right, how fast, with which leaning.

A person is right with probability logistic(``ability`` + ``easiness`` of the stimulus), leans
towards yes by ``lean`` on the same scale, and takes a log-normal time that is longer for hard
stimuli. It is told the outcome of each stimulus in order to be right that often: it stands for
people's answers, it does not look at movies. All draws follow from the seed, the person's number
and the stimulus, so that whoever comes back gives the answer that was on its way.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from physion.experiment.study.stimuli import Stimulus
from physion.seeds import generator

ABILITY = (1.2, 0.35)
"""Mean and standard deviation over people, in log odds of a correct answer."""
EASINESS_SD = 1.3
"""Over stimuli, in log odds; the same stimuli are hard for everybody, in every simulation."""
LEAN_SD = 0.2
LOG_RT = 6.6
"""Mean logarithm of the response time in milliseconds where one is sure."""
LOG_RT_HARD = 0.4
"""What is added times the probability of being wrong."""
LOG_RT_SD = (0.2, 0.35)
"""Over people, and over the trials of one."""
GENDERS = ("female", "male", "")
EDUCATIONS = ("secondary", "bachelor", "")


@dataclass(frozen=True)
class Prediction:
    """An answer: ``rt_ms`` from the moment the buttons are enabled."""

    response: Literal["yes", "no"]
    rt_ms: float


@dataclass(frozen=True)
class SimulatedPerson:
    """Person ``number`` of the simulation ``seed``."""

    seed: int
    number: int

    def _draws(self, *what: str | int) -> np.random.Generator:
        return generator("simulated", self.seed, self.number, *what)

    def chance(self, stimulus: Stimulus) -> float:
        """Probability of a correct answer, before any leaning."""
        ability = self._draws("ability").normal(*ABILITY)
        hard = generator("easiness", stimulus.stimulus)
        return float(_logistic(ability + hard.normal(0, EASINESS_SD)))

    def predict(self, stimulus: Stimulus) -> Prediction:
        """The answer to a stimulus, the same each time that it is asked for."""
        right = self.chance(stimulus)
        log_odds = np.log(right / (1 - right)) * (1 if stimulus.label else -1)
        draws = self._draws("answer", stimulus.phase, stimulus.stimulus)
        lean = self._draws("lean").normal(0, LEAN_SD)
        yes = draws.random() < _logistic(log_odds + lean)
        slow = self._draws("slow").normal(0, LOG_RT_SD[0])
        log_rt = LOG_RT + LOG_RT_HARD * (1 - right) + slow + draws.normal(0, LOG_RT_SD[1])
        return Prediction("yes" if yes else "no", round(float(np.exp(log_rt)), 1))

    def leaves_before(self, trials: int, dropouts: float) -> int | None:
        """The test trial before which the person closes the page for good; None: stays."""
        draws = self._draws("leaves")
        leaves = draws.random() < dropouts
        return int(draws.integers(trials)) if leaves and trials else None

    def demographics(self) -> dict[str, bool | int | float | str | None]:
        """What the page of demographics asks for."""
        draws = self._draws("demographics")
        return {
            "age": int(draws.integers(18, 70)),
            "gender": GENDERS[draws.integers(len(GENDERS))],
            "education": EDUCATIONS[draws.integers(len(EDUCATIONS))],
        }

    def feedback(self) -> dict[str, bool | int | float | str | None]:
        """What the last page asks for; the text says who wrote it."""
        difficulty = int(self._draws("difficulty").integers(1, 6))
        return {"difficulty": difficulty, "technical_problems": False, "text": "simulated"}


def _logistic(log_odds: float) -> float:
    return float(1 / (1 + np.exp(-log_odds)))
