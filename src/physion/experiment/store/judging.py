"""Judge sessions: plausibility, the practice criterion, and the scores of finished sessions.

Implausible is a session that no person can have made: answers before their movie, or without it.
A trial takes at least ``T = fixation cross + cue + movie``. With ``b`` the start of the cross, by
the server's clock (`showings`), and ``f`` the time at which movie and map were asked for, an answer
is possible from ``max(b + cross, f) + cue + movie``.

A practice below the criterion is repeated, ends the session, or is flagged. The answers of a
practice that is repeated are kept in PRACTICE_REPEATS, so that ANSWERS has one for each trial.
"""

from __future__ import annotations

import math
import threading
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import islice
from typing import Any

from sqlalchemy import Connection, bindparam, delete, func, insert, literal, or_, select

from physion.experiment.protocol import Answer
from physion.experiment.store.database import ANSWERS, PRACTICE_REPEATS, SESSIONS, SHOWINGS, STUDIES
from physion.experiment.store.sessions import Session, Step, with_check
from physion.experiment.study.orders import fixation, trial_order
from physion.experiment.study.stimuli import PHASES, Stimulus, is_right
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
    """Return why a session is not a person's, as stored in ``implausible``; None for a preview.

    ``finished_at``: when it ended, to judge its duration; None while it continues.
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


PRACTICE = "practice"
"""Name of this check in ``screened_out_by`` and ``failed_checks`` of a session."""


def repeated_response(connection: Connection, session: Session, answer: Answer) -> str | None:
    """Return the stored response of this answer, by its key, in an earlier repeat; else None."""
    if answer.phase != PHASES[0] or session.practice_repeats == 0:
        return None
    own = PRACTICE_REPEATS.c.session == session.session
    same = select(PRACTICE_REPEATS.c.response).where(own, PRACTICE_REPEATS.c.key == answer.key)
    return connection.execute(same).scalar()


def judge_practice(step: Step) -> None:
    """Judge the practice when its last trial has been answered.

    With fewer right answers than ``practice.min_correct`` it is repeated ``practice.repeats``
    times; afterwards the session ends or is flagged.
    """
    session, rules = step.session, step.study.practice
    trials = step.course.trials[PHASES[0]]
    if session.answered_familiarization < trials:
        return
    if _count_right(step) >= min(rules.min_correct, trials):
        return
    if session.practice_repeats < rules.repeats:
        step.change(**_repeat(step.connection, session))
    elif rules.failed == "end":
        step.change(screened_out_at=step.now, screened_out_by=PRACTICE)
    else:
        step.change(**with_check(session, PRACTICE))


def _count_right(step: Step) -> int:
    """Count the right answers to the practice trials."""
    session = step.session
    order = trial_order(step.study, session.scenario, session.order_seed)[PHASES[0]]
    rows = step.connection.execute(
        select(ANSWERS.c.trial, ANSWERS.c.response).where(*_of(ANSWERS, session))
    )
    return sum(is_right(response, order[trial].label) for trial, response in rows)


def _repeat(connection: Connection, session: Session) -> dict[str, Any]:
    """Move the answers to the practice away; return the changed columns of the session."""
    columns = list(ANSWERS.c)
    moved = select(literal(session.practice_repeats), *columns).where(*_of(ANSWERS, session))
    names = ["repeat", *(column.name for column in columns)]
    connection.execute(insert(PRACTICE_REPEATS).from_select(names, moved))
    for table in (ANSWERS, SHOWINGS):
        connection.execute(delete(table).where(*_of(table, session)))
    return {
        "answered_familiarization": 0,
        "practice_repeats": session.practice_repeats + 1,
        "loaded_at_phase": None,
        "loaded_at_trial": None,
    }


def _of(table: Any, session: Session) -> tuple[Any, ...]:
    """Return the conditions for the rows of the practice trials of a session."""
    return table.c.session == session.session, table.c.phase == PHASES[0]


_CHUNK = 500
_FINISHED = (
    select(SESSIONS.c.session)
    .join(STUDIES, STUDIES.c.digest == SESSIONS.c.study)
    .where(
        SESSIONS.c.scenario == bindparam("of_scenario"),
        SESSIONS.c.kind == bindparam("of_kind"),
        func.coalesce(SESSIONS.c.condition, "") == bindparam("of_condition"),
        SESSIONS.c.finished_at.is_not(None),
        SESSIONS.c.withdrawn_at.is_(None),
        SESSIONS.c.voided_at.is_(None),
        or_(SESSIONS.c.implausible.is_(None), SESSIONS.c.session == bindparam("of_session")),
        # Previews may have used other stimuli, whose labels are no longer known.
        STUDIES.c.stimuli_digest == bindparam("of_stimuli"),
    )
)
_TEST = select(ANSWERS.c.session, ANSWERS.c.stimulus, ANSWERS.c.response).where(
    ANSWERS.c.session.in_(bindparam("sessions", expanding=True)), ANSWERS.c.phase == "test"
)


class Scores:
    """Cache of the numbers of correct test answers of finished sessions, which are final."""

    def __init__(self, study: Study) -> None:
        self._labels = study.labels
        self._stimuli = study.stimuli_digest
        self._correct: dict[str, int] = {}
        self._lock = threading.Lock()

    def of(self, connection: Connection, session: Session) -> dict[str, int]:
        """Return the number of correct answers of each finished session like ``session``.

        Alike are sessions of the same scenario, condition and kind. Sessions with other than the
        current stimuli are left out, and implausible ones except ``session`` itself.
        """
        values = {"of_scenario": session.scenario, "of_kind": session.kind,
                  "of_condition": session.condition or "", "of_stimuli": self._stimuli,
                  "of_session": session.session}  # fmt: skip
        rows = connection.execute(_FINISHED, values)
        finished = [name for (name,) in rows]
        with self._lock:
            new = iter([name for name in finished if name not in self._correct])
            while chunk := list(islice(new, _CHUNK)):
                self._count(connection, session.scenario, chunk)
            return {name: self._correct[name] for name in finished}

    def _count(self, connection: Connection, scenario: str, sessions: list[str]) -> None:
        """Count the correct answers of these sessions and cache the counts."""
        correct: dict[str, int] = defaultdict(int)
        for session, stimulus, response in connection.execute(_TEST, {"sessions": sessions}):
            correct[session] += is_right(response, self._labels[scenario, stimulus])
        self._correct.update({session: correct[session] for session in sessions})


def percentile(correct: int, others: Sequence[int]) -> float:
    """Return the percentage of ``others`` below ``correct``, plus half of those equal to it."""
    fewer = sum(other < correct for other in others)
    equal = sum(other == correct for other in others)
    return 100 * (fewer + equal / 2) / len(others)
