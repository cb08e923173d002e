"""Delete the ids that recruiters gave, of some participants or of all; answers stay.

With --session all of a session goes, answers too; the row stays, as of somebody who withdrew.
Stop the server first. What is gone cannot be brought back: pay the participants before.
"""

from __future__ import annotations

import json as json_module
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro


@dataclass(frozen=True)
class Options:
    """Whose ids, or which sessions."""

    study: Annotated[Path, tyro.conf.Positional]
    """Folder of the study."""
    participant: tuple[str, ...] = ()
    """Participants, as an export names them (32 digits)."""
    all: bool = False
    """The ids of all participants."""
    session: tuple[str, ...] = ()
    """References (as K7QF-29XM) of sessions of which all is deleted."""
    database: str | None = None
    """URL of a PostgreSQL database; responses.sqlite in the folder if not given."""
    json: bool = False
    """Print one JSON object."""


def main(options: Options) -> int:
    """Delete, and say how many ids or sessions there were."""
    from physion.cli.experiment.experiment import require_extra
    from physion.errors import BadInputError

    if [bool(options.participant), options.all, bool(options.session)].count(True) != 1:
        raise BadInputError(
            "say whose ids: --participant HASH, or --all; or which session: --session REFERENCE"
        )
    require_extra()
    from physion.experiment.store.database import sqlite_url
    from physion.experiment.store.forget import forget, forget_sessions

    url = options.database or sqlite_url(options.study)
    if options.session:
        count, what = forget_sessions(url, options.session), "session"
    else:
        count, what = forget(url, None if options.all else options.participant), "id"
    if options.json:
        print(json_module.dumps({"forgotten": count}))
    else:
        print(f"forgotten: {count} {what}{'' if count == 1 else 's'}")
    return 0
