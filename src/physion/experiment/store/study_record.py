"""Registration of each served version of the study folder in the database."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict
from typing import Any

from sqlalchemy import ColumnElement, Connection, func, select, update

from physion.core.errors import BadInputError
from physion.experiment.store.sessions import insert_or_skip
from physion.experiment.store.tables import SESSIONS, STUDIES
from physion.experiment.study.questions import Question, columns_of
from physion.experiment.study.study import STUDY_FILE, Study


def register(connection: Connection, study: Study, now: float) -> None:
    """Store the current version of the study; refuse it if existing sessions could not continue.

    Previews that cannot continue are ended.

    Raises
    ------
    BadInputError
        There are sessions (of people or simulated participants) with other stimuli, of a scenario
        that the study no longer has, or with answers to another question of the same name.
    """
    other = SESSIONS.c.session.in_(
        select(SESSIONS.c.session)
        .join(STUDIES, STUDIES.c.digest == SESSIONS.c.study)
        .where(STUDIES.c.stimuli_digest != study.stimuli_digest)
    )
    gone = SESSIONS.c.scenario.not_in(study.offered)
    count = sum(_by_scenario(connection, other).values())
    if count:
        raise BadInputError(
            f"{count} sessions were made with another stimuli.csv, other media or other blocks; "
            "their orders of trials would change. Restore the old stimuli and settings, or create "
            "a new study folder (or give another database) for the new ones"
        )
    for scenario, of_scenario in _by_scenario(connection, gone).items():
        raise BadInputError(
            f"{of_scenario} sessions are of the scenario {scenario}, which {STUDY_FILE} no longer "
            f"has: put {scenario} back into scenarios (to stop recruiting for it, distribute only "
            "links of the other scenarios), or create a new study folder (or give another "
            "database) without it"
        )
    _check_conditions(connection, study)
    _check_questions(connection, study)
    # Previews are not data: those that cannot continue are ended.
    ended = (other | gone) & SESSIONS.c.finished_at.is_(None) & SESSIONS.c.withdrawn_at.is_(None)
    connection.execute(update(SESSIONS).where(ended).values(withdrawn_at=now, closed_at=now))
    connection.execute(
        insert_or_skip(connection, STUDIES),
        {
            "digest": study.digest,
            "name": study.name,
            "version": study.version,
            "stimuli_digest": study.stimuli_digest,
            "settings": _settings(study),
            "first_served": now,
        },
    )


def _check_conditions(connection: Connection, study: Study) -> None:
    """Refuse a study that lacks the condition of a session."""
    names = [condition.name for condition in study.conditions]
    lost = SESSIONS.c.condition.is_not(None) & SESSIONS.c.condition.not_in(names)
    found = select(SESSIONS.c.condition, func.count()).where(lost, SESSIONS.c.kind != "preview")
    for name, count in connection.execute(found.group_by(SESSIONS.c.condition)):
        raise BadInputError(
            f"{count} sessions are of the condition {name}, which {STUDY_FILE} no longer has: put "
            "it back, or create a new study folder (or give another database) without it"
        )


def _check_questions(connection: Connection, study: Study) -> None:
    """Refuse a question that was of another kind, or had another scale, when it was answered."""
    forms = {column: form for each in study.questions for column, form in _forms(vars(each))}
    answered = select(SESSIONS.c.questions_study).where(SESSIONS.c.kind != "preview").distinct()
    versions = select(STUDIES.c.settings).where(STUDIES.c.digest.in_(answered))
    for (settings,) in connection.execute(versions):
        for entry in settings.get("questions", ()):
            for column, form in _forms(entry):
                if forms.get(column, form) != form:
                    raise BadInputError(
                        f"the question {column} was answered in another form ({form[1]}); give "
                        f"the changed question another name in {STUDY_FILE}"
                    )


def _forms(entry: Mapping[str, Any]) -> list[tuple[str, tuple[str, str, int]]]:
    """Return the columns of a question, each with what its values depend on."""
    question = Question(**{**entry, "options": tuple(entry["options"])})
    steps = question.steps if question.kind == "scale" else 0
    return [(column, (question.name, question.kind, steps)) for column in columns_of(question)]


def _by_scenario(connection: Connection, which: ColumnElement[bool]) -> dict[str, int]:
    """Count the sessions that are not previews, by scenario in alphabetical order."""
    columns = SESSIONS.c
    counts = select(columns.scenario, func.count()).where(which, columns.kind != "preview")
    rows = connection.execute(counts.group_by(columns.scenario).order_by(columns.scenario))
    return dict(rows.all())


def _settings(study: Study) -> dict[str, Any]:
    """Return settings and texts as JSON values, without stimuli, whose labels stay private."""
    left_out = {"folder", "stimuli", "allowed_ids"}
    shallow = {name: value for name, value in vars(study).items() if name not in left_out}
    return json.loads(json.dumps(shallow, default=_plain))  # type: ignore[no-any-return]


def _plain(value: Any) -> Any:
    return dict(value) if hasattr(value, "items") else asdict(value)
