"""Back up a study: a checked copy of its database, settings, texts and stimuli.

The server may be running. secret.json is left out unless --secret: keep it apart from the answers.
"""

from __future__ import annotations

import json as json_module
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro


@dataclass(frozen=True)
class Options:
    """Options of ``physion experiment backup``."""

    study: Annotated[Path, tyro.conf.Positional]
    """Folder of the study."""
    out: Path | None = None
    """Folder of backups, in which a new folder is made. Default: STUDY/backups."""
    media: bool = False
    """Copy movies and maps too."""
    secret: bool = False
    """Copy secret.json too, with which ids can be guessed from their hashes."""
    json: bool = False
    """Print the path as JSON."""


def main(options: Options) -> int:
    """Back up; print the path of the new folder."""
    from physion.experiment.store.lab import back_up

    made = back_up(
        options.study,
        options.out or options.study / "backups",
        media=options.media,
        secret=options.secret,
    )
    print(json_module.dumps({"backup": str(made)}) if options.json else f"backup: {made}")
    return 0
