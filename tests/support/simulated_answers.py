"""Made-up answers of people, with known effects: to plan a sample and to check the fitters.

The design is the one of the study: every participant sees every stimulus of a scenario. Either a
participant belongs to one scenario (`nested`, as published) or sees all of them (`crossed`).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import pandas as pd

from physion.core.errors import BadInputError
from physion.core.names import SCENARIOS
from physion.core.seeds import child_generator, named_seed

Array = npt.NDArray[np.float64]


@dataclass(frozen=True)
class AnswerDesign:
    """How many people and stimuli, and how much they vary.

    ``participants`` and ``stimuli`` are per scenario; with ``crossed`` the participants see all
    scenarios. Standard deviations of participants, stimuli: in logits for the answers; log times
    vary by a third of that, plus a residual of 0.4. ``skipped`` is the share of trials left out at
    random. Slopes (logits, by one unit): elements, distractors, occluders.
    """

    scenarios: int = 8
    participants: int = 100
    stimuli: int = 150
    crossed: bool = False
    participant_sd: float = 0.35
    stimulus_sd: float = 1.5
    skipped: float = 0.0
    slopes: tuple[float, float, float] = (-0.06, -0.15, -0.2)

    def __post_init__(self) -> None:
        if not 1 <= self.scenarios <= len(SCENARIOS):
            raise BadInputError(f"scenarios is {self.scenarios}; choose 1 to {len(SCENARIOS)}")
        if min(self.participants, self.stimuli) < 1 or not 0 <= self.skipped < 1:
            raise BadInputError("a design needs participants, stimuli >= 1 and 0 <= skipped < 1")
        if min(self.participant_sd, self.stimulus_sd) < 0:
            raise BadInputError("standard deviations of a design are 0 or more")


def simulate_answers(design: AnswerDesign, seed: int = 0) -> pd.DataFrame:
    """One row a trial: ``participant``, ``scenario``, ``stimulus``, ``correct`` (0 or 1),
    ``log_rt``, and of the stimulus ``elements``, ``distractors``, ``occluders`` (whole numbers).

    Answers are Bernoulli with logit = base of the scenario (0.8 to 1.6) + slopes + normal effects
    of the participant and the stimulus. A function of the design and the seed.
    """
    trials = _trials(design)
    draw = child_generator(named_seed("answers", seed), "effects")
    scenario, participant, stimulus = (trials[name].to_numpy() for name in _CODES)
    people = draw.normal(0, 1, participant.max() + 1)
    stimuli = draw.normal(0, 1, stimulus.max() + 1)
    attributes = _attributes(draw, len(stimuli))
    steady = np.linspace(0.8, 1.6, design.scenarios)[scenario]
    slope = sum(
        value * (attributes[name] - attributes[name].mean())[stimulus]
        for name, value in zip(attributes, design.slopes, strict=True)
    )
    varying = design.participant_sd * people[participant] + design.stimulus_sd * stimuli[stimulus]
    logit = steady + slope + varying
    log_rt = (6.6 - 0.1 * steady - varying / 3) + draw.normal(0, 0.4, len(trials))
    correct = draw.random(len(trials)) < 1 / (1 + np.exp(-logit))
    kept = draw.random(len(trials)) >= design.skipped
    table = pd.DataFrame(
        {
            "participant": np.char.add("p", np.char.zfill(participant.astype(str), 4)),
            "scenario": np.asarray(SCENARIOS)[scenario],
            "stimulus": np.char.add("s", np.char.zfill(stimulus.astype(str), 4)),
            "correct": correct.astype(int),
            "log_rt": log_rt,
            **{name: values[stimulus] for name, values in attributes.items()},
        }
    )
    return table[kept].reset_index(drop=True)


_CODES = ("scenario", "participant", "stimulus")


def _trials(design: AnswerDesign) -> pd.DataFrame:
    """Codes of scenario, participant and stimulus, each counted over the whole study."""
    grid = np.indices((design.scenarios, design.participants, design.stimuli)).reshape(3, -1)
    scenario, participant, stimulus = grid
    if not design.crossed:
        participant = scenario * design.participants + participant
    stimulus = scenario * design.stimuli + stimulus
    return pd.DataFrame(dict(zip(_CODES, (scenario, participant, stimulus), strict=True)))


def _attributes(draw: np.random.Generator, n: int) -> dict[str, Array]:
    """Numbers of elements, distractors and occluders of ``n`` stimuli."""
    return {
        "elements": draw.integers(2, 11, n).astype(np.float64),
        "distractors": draw.integers(0, 4, n).astype(np.float64),
        "occluders": draw.integers(0, 3, n).astype(np.float64),
    }
