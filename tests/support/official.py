"""Where the original study's data is, if it is here."""

from __future__ import annotations

import os
from pathlib import Path


def official_folder() -> Path | None:
    """The folder of the original study's data, from $PHYSION_OFFICIAL or beside the checkout."""
    named = os.environ.get("PHYSION_OFFICIAL")
    folder = Path(named) if named else Path(__file__).parents[3] / "shared" / "official"
    return folder if (folder / "scenes").is_dir() else None
