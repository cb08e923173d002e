"""People made up for tests: answers with known shares, abilities, habits and response times."""

from __future__ import annotations

import numpy as np
import pandas as pd

from physion.analysis.people.responses import SESSION_COLUMNS, TRIAL_COLUMNS, Responses, clean
from physion.core.tables import check_table

PRACTICE = 10


def simulate_study(
    people: int = 20,
    stimuli: int = 30,
    scenarios: tuple[str, ...] = ("collide", "roll"),
    *,
    seed: int = 0,
    ability_sd: float = 0.4,
    learning: float = 0.0,
    slow_by_error: float = 0.5,
) -> tuple[pd.DataFrame, pd.DataFrame]:
    """Tables of trials and sessions as text, as the experiment would export them.

    The log odds of being right are a stimulus' easiness (mean 1, sd 1) plus a person's ability plus
    ``learning`` per 100 trials. Log response time is 6.5 + ``slow_by_error`` x (1 - P(right)) plus
    noise. Every second stimulus ends in contact.
    """
    generator = np.random.default_rng(seed)
    trials, sessions = [], []
    for scenario in scenarios:
        easy = generator.normal(1.0, 1.0, stimuli)
        for person in range(people):
            key = {"participant": f"{scenario}-p{person:03d}", "scenario": scenario,
                   "session": f"{scenario}-s{person:03d}"}  # fmt: skip
            ability = generator.normal(0, ability_sd)
            buttons = ("yes-no", "no-yes")[person % 2]
            sessions.append(
                key | {"simulated": False, "age": 20 + person % 40, "gender": "ab"[person % 2],
                       "difficulty": 1 + person % 5, "buttons": buttons,
                       "started_at": f"2024-05-01T10:{person % 60:02d}:00+00:00"}
            )  # fmt: skip
            for place in range(PRACTICE):
                yes = label = place % 2 == 0
                trials.append(_row(key, f"{scenario}_practice_{place}", "familiarization", place,
                                   yes, label, 900.0, buttons))  # fmt: skip
            for place, stimulus in enumerate(generator.permutation(stimuli)):
                logit = easy[stimulus] + ability + learning * place / 100
                p = 1 / (1 + np.exp(-logit))
                label = bool(stimulus % 2 == 0)
                yes = label == bool(generator.random() < p)
                log_rt = 6.5 + slow_by_error * (1 - p) + generator.normal(0, 0.3)
                trials.append(_row(key, f"{scenario}_{stimulus:03d}", "test", place, yes, label,
                                   float(np.exp(log_rt)), buttons))  # fmt: skip
    return pd.DataFrame(trials), pd.DataFrame(sessions)


def _row(key, stimulus, phase, trial, yes, label, rt, buttons):  # type: ignore[no-untyped-def]
    return key | {"stimulus": stimulus, "phase": phase, "trial": trial,
                  "response": "yes" if yes else "no", "label": label, "rt_ms": rt,
                  "simulated": False, "buttons": buttons, "correct": yes == label}  # fmt: skip


def as_responses(trials: pd.DataFrame, sessions: pd.DataFrame | None = None) -> Responses:
    """Through the same door as a file."""
    table = check_table(trials, TRIAL_COLUMNS, "trials")
    people = None if sessions is None else check_table(sessions, SESSION_COLUMNS, "sessions")
    return clean(table, people)


def study(**settings: object) -> Responses:
    """`simulate_study` as `Responses`."""
    return as_responses(*simulate_study(**settings))  # type: ignore[arg-type]
