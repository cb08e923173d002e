"""Tell sessions that no person can have made: answers before their movie, or without it.

A trial takes at least ``T = fixation cross + cue + movie``. With ``b`` the start of the cross, by
the server's clock (`showings`), and ``f`` the time at which movie and map were asked for, an answer
is possible from ``max(b + cross, f) + cue + movie``.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from physion.experiment.protocol.messages import Answer
from physion.experiment.store.sessions import Session
from physion.experiment.study.orders import fixation, trial_order
from physion.experiment.study.stimuli import PHASES, Stimulus
from physion.experiment.study.study import Study

REASONS = ("fast answers", "no media", "short")
"""Why a session is implausible: response times under ``fast_ms``, media that were never fetched, or
less time than its movies take."""
TOLERANCE_S = 0.1
"""Time in seconds by which a trial may seem shorter than it was, since requests take unequal times
and browsers end a movie within one frame."""


@dataclass(frozen=True)
class Presentation:
    """How often and since when a trial was shown, as the server knows it.

    Attributes
    ----------
    showings
        Number of showings.
    began_at
        Start of the last showing in seconds since 1970.
    fetched_at
        When movie and map had been asked for; infinity if they never were, None if not known.
    """

    showings: int
    began_at: float
    fetched_at: float | None

    @property
    def was_fetched(self) -> bool:
        """Whether the media were fetched, as far as it is known."""
        return self.fetched_at is None or math.isfinite(self.fetched_at)


def speed(study: Study, session: Session) -> float:
    """Return how many times faster than for people time passes in a session."""
    return study.plausibility.simulated_speed if session.kind == "simulated" else 1.0


def earliest_answer(
    study: Study, session: Session, phase: str, trial: int, shown: Presentation
) -> float:
    """Return the earliest time (seconds since 1970) at which a trial can be answered."""
    stimulus = trial_order(study, session.scenario, session.order_seed)[phase][trial]
    factor = speed(study, session)
    cross = fixation(study, session.order_seed, phase, trial) / 1000 / factor
    movie = (_movie_s(stimulus.frames, stimulus) + study.timing.cue_ms / 1000) / factor
    known = shown.fetched_at is not None and math.isfinite(shown.fetched_at)
    fetched_at = shown.fetched_at if known and shown.fetched_at is not None else shown.began_at
    return max(shown.began_at + cross, fetched_at) + movie - TOLERANCE_S / factor


def shortest_session_s(study: Study, session: Session) -> float:
    """Return the shortest time in seconds in which a person can do a whole session.

    All trials, the full movies of the feedback, ``fast_ms`` for each answer, and ``reading_s``.
    """
    rules, total = study.plausibility, study.plausibility.reading_s
    order = trial_order(study, session.scenario, session.order_seed)
    for phase in PHASES:
        for trial, stimulus in enumerate(order[phase]):
            cross = fixation(study, session.order_seed, phase, trial)
            total += (cross + study.timing.cue_ms + rules.fast_ms) / 1000 - TOLERANCE_S
            total += _movie_s(stimulus.frames, stimulus)
            total += _movie_s(stimulus.full_frames, stimulus)
    return total / speed(study, session)


def _movie_s(frames: int, stimulus: Stimulus) -> float:
    """Return the time in seconds from the first to the last of some frames of a movie."""
    return max(0, frames - 1) / stimulus.rate


def judged(study: Study, session: Session, answer: Answer, shown: Presentation) -> dict[str, int]:
    """Return the counts of a session, by column, after an answer."""
    rules = study.plausibility
    return {
        "fast_answers": session.fast_answers + (answer.rt_ms < rules.fast_ms),
        "unfetched": session.unfetched + (not shown.was_fetched),
        "replayed": session.replayed + (shown.showings > rules.max_showings),
    }


def reasons(study: Study, session: Session, finished_at: float | None = None) -> str | None:
    """Return why a session is no person's, as stored in ``implausible``; None for a preview.

    ``finished_at``: when it ended, to judge its duration; None while it goes on.
    """
    if session.kind == "preview":
        return None
    short = (
        study.plausibility.server_checks
        and finished_at is not None
        and finished_at - session.started_at < shortest_session_s(study, session)
    )
    found = (
        session.fast_answers >= study.plausibility.fast_answers,
        session.unfetched > 0,
        short,
    )
    return ", ".join(reason for reason, true in zip(REASONS, found, strict=True) if true) or None
