"""Shared by the tests of trials."""

from __future__ import annotations

import pytest

from support.hand_made import Parts, make_parts


@pytest.fixture(scope="session")
def parts() -> Parts:
    """A trial with cloth and contacts."""
    return make_parts()
