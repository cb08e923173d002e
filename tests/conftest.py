"""Fixtures of all tests."""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path

import pytest
from hypothesis import settings

from support.official import official_folder

# A test must not fail because the machine is slow.
settings.register_profile("physion", deadline=None)
settings.load_profile("physion")


@pytest.fixture(scope="session", autouse=True)
def no_power_cuts() -> Iterator[None]:
    """Do not wait for the disk: what a killed process wrote is there without that, too."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(os, "fsync", lambda _: None)
        yield


@pytest.fixture(scope="session")
def official() -> Path:
    """The original study's data; the test is skipped where it is absent."""
    folder = official_folder()
    if folder is None:
        pytest.skip("the official data is absent: set PHYSION_OFFICIAL to its folder")
    return folder
