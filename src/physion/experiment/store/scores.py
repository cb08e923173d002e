"""Numbers of correct test answers, and their percentiles among the finished sessions."""

from __future__ import annotations

import threading
from collections import defaultdict
from collections.abc import Sequence
from itertools import islice

from sqlalchemy import Connection, bindparam, func, or_, select

from physion.experiment.store.sessions import Session
from physion.experiment.store.tables import ANSWERS, SESSIONS, STUDIES
from physion.experiment.study.courses.blocks import stimuli_by_session
from physion.experiment.study.study import Study

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
        self._labels = {key: each.label for key, each in stimuli_by_session(study).items()}
        self._stimuli = study.stimuli_digest
        self._correct: dict[str, int] = {}
        self._lock = threading.Lock()

    def of(self, connection: Connection, session: Session) -> dict[str, int]:
        """Return the number of correct answers of each finished session like ``session``.

        Those of its scenario, condition and kind. Sessions with other than the current stimuli are
        left out, and implausible ones except ``session`` itself.
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
            correct[session] += (response == "yes") == self._labels[scenario, stimulus]
        self._correct.update({session: correct[session] for session in sessions})


def percentile(correct: int, others: Sequence[int]) -> float:
    """Return the percentage of ``others`` below ``correct``, plus half of those equal to it."""
    fewer = sum(other < correct for other in others)
    equal = sum(other == correct for other in others)
    return 100 * (fewer + equal / 2) / len(others)
