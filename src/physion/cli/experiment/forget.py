"""Delete the recruiters' ids of some or all participants, or all data of a session.

With --participant or --all only ids are deleted; answers are kept. With --session all data of a
session are deleted; its row is kept, as of a participant who withdrew. Stop the server first.
Deletion cannot be undone, so pay the participants before.
"""

from __future__ import annotations

import json as json_module
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro


@dataclass(frozen=True)
class Options:
    """Options of ``physion experiment forget``."""

    study: Annotated[Path, tyro.conf.Positional]
    """Folder of the study."""
    participant: tuple[str, ...] = ()
    """Delete the ids of these participants, given as in the export (32 digits)."""
    all: bool = False
    """Delete the ids of all participants."""
    session: tuple[str, ...] = ()
    """Delete all data of the sessions with these references (such as K7QF-29XM)."""
    json: bool = False
    """Print one JSON object."""


def main(options: Options) -> int:
    """Delete; print the number of ids or sessions."""
    from physion.core.errors import BadInputError

    if [bool(options.participant), options.all, bool(options.session)].count(True) != 1:
        raise BadInputError(
            "give the ids to delete, --participant HASH or --all, or a session, --session REFERENCE"
        )
    from physion.experiment.store.lab import forget, forget_sessions

    if options.session:
        count, what = forget_sessions(options.study, options.session), "session"
    else:
        count, what = forget(options.study, None if options.all else options.participant), "id"
    if options.json:
        print(json_module.dumps({"forgotten": count}))
    else:
        print(f"forgotten: {count} {what}{'' if count == 1 else 's'}")
    return 0
