"""Simple response model of a simulated participant: accuracy, response bias and response time.

An answer is correct with probability logistic(``ability`` + ``easiness`` of the stimulus), as in
the Rasch model; ``bias`` towards "yes" is added on the same scale. Response times are log-normal
and longer for hard stimuli. The model does not look at movies: it is given the outcome of each
stimulus. All draws follow from the seed, the person's number and the stimulus, so a participant who
comes back gives the same answer again.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from physion.core.seeds import generator
from physion.experiment.study.questions import Answer, Question
from physion.experiment.study.stimuli import Stimulus

ABILITY = (1.2, 0.35)
"""Mean and standard deviation over people, in log odds of a correct answer."""
EASINESS_SD = 1.3
"""Standard deviation over stimuli, in log odds; the same for all people and simulations."""
BIAS_SD = 0.2
"""Standard deviation over people of the bias towards yes, in log odds."""
LOG_RT = 6.6
"""Mean logarithm of the response time in milliseconds when a correct answer is certain."""
LOG_RT_HARD = 0.4
"""Added to the mean logarithm, times the probability of a wrong answer."""
TYPICAL_RT_MS = 800.0
"""Typical response time in milliseconds, for estimates of durations."""
LOG_RT_SD = (0.2, 0.35)
"""Standard deviations over people, and over the trials of one person."""
GENDERS = ("female", "male", "")
EDUCATIONS = ("secondary", "bachelor", "")


@dataclass(frozen=True)
class Prediction:
    """A simulated answer. ``rt_ms`` counts from the moment the buttons are enabled."""

    response: Literal["yes", "no"]
    rt_ms: float


@dataclass(frozen=True)
class SimulatedPerson:
    """Person ``number`` of the simulation with this ``seed``."""

    seed: int
    number: int

    def _rng(self, *names: str | int) -> np.random.Generator:
        """Return the generator of one named draw of this person."""
        return generator("simulated", self.seed, self.number, *names)

    def probability_correct(self, stimulus: Stimulus) -> float:
        """Return the probability of a correct answer, without response bias."""
        ability = self._rng("ability").normal(*ABILITY)
        easiness = generator("easiness", stimulus.stimulus).normal(0, EASINESS_SD)
        return float(_logistic(ability + easiness))

    def predict(self, stimulus: Stimulus) -> Prediction:
        """Return the answer to a stimulus; the same one on every call."""
        correct = self.probability_correct(stimulus)
        log_odds = np.log(correct / (1 - correct)) * (1 if stimulus.label else -1)
        rng = self._rng("answer", stimulus.phase, stimulus.stimulus)
        bias = self._rng("lean").normal(0, BIAS_SD)
        yes = rng.random() < _logistic(log_odds + bias)
        slowness = self._rng("slow").normal(0, LOG_RT_SD[0])
        log_rt = LOG_RT + LOG_RT_HARD * (1 - correct) + slowness + rng.normal(0, LOG_RT_SD[1])
        return Prediction("yes" if yes else "no", round(float(np.exp(log_rt)), 1))

    def dropout_trial(self, trials: int, dropouts: float) -> int | None:
        """Return the test trial before which the person leaves for good, or None if never."""
        rng = self._rng("leaves")
        leaves = rng.random() < dropouts
        return int(rng.integers(trials)) if leaves and trials else None

    def demographics(self) -> dict[str, bool | int | float | str | None]:
        """Return the fields of the demographics page."""
        rng = self._rng("demographics")
        return {
            "age": int(rng.integers(18, 70)),
            "gender": GENDERS[rng.integers(len(GENDERS))],
            "education": EDUCATIONS[rng.integers(len(EDUCATIONS))],
        }

    def own_answers(self, questions: Sequence[Question]) -> dict[str, Answer]:
        """Return answers to the lab's own questions, drawn at random; texts are marked."""
        answers: dict[str, Answer] = {}
        for question in questions:
            rng = self._rng("question", question.name)
            match question.kind:
                case "text":
                    answers[question.name] = "simulated"
                case "scale":
                    answers[question.name] = int(rng.integers(1, question.steps + 1))
                case "choice":
                    answers[question.name] = question.options[rng.integers(len(question.options))]
                case _:
                    chosen = [option for option in question.options if rng.random() < 0.5]
                    answers[question.name] = chosen or [question.options[0]]
        return answers

    def feedback(self) -> dict[str, bool | int | float | str | None]:
        """Return the fields of the feedback page, whose text is marked as simulated."""
        difficulty = int(self._rng("difficulty").integers(1, 6))
        return {"difficulty": difficulty, "technical_problems": False, "text": "simulated"}


def _logistic(log_odds: float) -> float:
    """Return the probability of log odds."""
    return float(1 / (1 + np.exp(-log_odds)))
