"""Shared fixtures: where the official data is, if it is here."""

from __future__ import annotations

import os
from pathlib import Path

import pytest


def official_folder() -> Path | None:
    """The folder of the original study's data, from $PHYSION_OFFICIAL or beside the checkout."""
    named = os.environ.get("PHYSION_OFFICIAL")
    folder = Path(named) if named else Path(__file__).parents[2] / "shared" / "official"
    return folder if (folder / "scenes").is_dir() else None


@pytest.fixture(scope="session")
def official() -> Path:
    """The original study's data; the test is skipped where it is absent."""
    folder = official_folder()
    if folder is None:
        pytest.skip("the official data is absent: set PHYSION_OFFICIAL to its folder")
    return folder
