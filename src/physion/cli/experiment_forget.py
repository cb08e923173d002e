"""Delete the ids that recruiters gave, of some participants or of all; answers stay.

Stop the server first. Ids that are gone cannot be brought back: pay the participants before.
"""

from __future__ import annotations

import json as json_module
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro


@dataclass(frozen=True)
class Options:
    """Whose ids."""

    study: Annotated[Path, tyro.conf.Positional]
    """Folder of the study."""
    participant: tuple[str, ...] = ()
    """Participants, as an export names them (32 digits)."""
    all: bool = False
    """The ids of all participants."""
    database: str | None = None
    """URL of a PostgreSQL database; responses.sqlite in the folder if not given."""
    json: bool = False
    """Print one JSON object."""


def main(options: Options) -> int:
    """Delete, and say how many ids there were."""
    from physion.cli.experiment import require_extra
    from physion.errors import BadInputError

    if bool(options.participant) == options.all:
        raise BadInputError("say whose ids: --participant HASH, or --all")
    require_extra()
    from physion.experiment.database import sqlite_url
    from physion.experiment.forget import forget

    url = options.database or sqlite_url(options.study)
    count = forget(url, None if options.all else options.participant)
    if options.json:
        print(json_module.dumps({"forgotten": count}))
    else:
        print(f"forgotten: {count} {'id' if count == 1 else 'ids'}")
    return 0
