"""The study folder as it is served, noted in the database beside the sessions made under it."""

from __future__ import annotations

import json
from dataclasses import asdict
from typing import Any

from sqlalchemy import Connection, func, select, update

from physion.errors import BadInputError
from physion.experiment.sessions import insert_new
from physion.experiment.study import Study
from physion.experiment.tables import SESSIONS, STUDIES


def register(connection: Connection, study: Study, now: float) -> None:
    """Note the state of the study folder; refuse stimuli that sessions were not made with.

    Raises:
        BadInputError: there are sessions of people or programs with other stimuli.
    """
    other = (
        select(SESSIONS.c.session)
        .join(STUDIES, STUDIES.c.digest == SESSIONS.c.study)
        .where(STUDIES.c.stimuli_digest != study.stimuli_digest)
    )
    counted = other.where(SESSIONS.c.kind != "preview")
    count = connection.scalar(select(func.count()).select_from(counted.subquery()))
    if count:
        raise BadInputError(
            f"{count} sessions were made with another stimuli.csv or other media; their orders of "
            "trials would change. Bring the old stimuli back, or make a new study folder (or give "
            "another database) for the new ones"
        )
    # Previews are nobody's data: those of other stimuli simply end.
    ended = SESSIONS.c.session.in_(other) & SESSIONS.c.finished_at.is_(None)
    connection.execute(
        update(SESSIONS).where(ended & SESSIONS.c.withdrawn_at.is_(None)).values(withdrawn_at=now)
    )
    connection.execute(
        insert_new(connection, STUDIES),
        {
            "digest": study.digest,
            "name": study.name,
            "version": study.version,
            "stimuli_digest": study.stimuli_digest,
            "settings": _settings(study),
            "first_served": now,
        },
    )


def _settings(study: Study) -> dict[str, Any]:
    """All that the study decides and says, without stimuli: labels stay in the folder."""
    left_out = {"folder", "stimuli"}
    shallow = {name: value for name, value in vars(study).items() if name not in left_out}
    return json.loads(json.dumps(shallow, default=_plain))  # type: ignore[no-any-return]


def _plain(value: Any) -> Any:
    return dict(value) if hasattr(value, "items") else asdict(value)
