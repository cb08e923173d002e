"""Programs that some tests need: where they are absent, these tests are skipped.

Not so with $PHYSION_SKIP_NOTHING, which `.ci/run` sets: what is absent there is a failure, so that
no test is left out without anybody noticing.
"""

from __future__ import annotations

import os
import shutil
from typing import NoReturn

import pytest


def absent(what: str) -> NoReturn:
    """Skip the test, since ``what`` is absent; fail it where nothing may be skipped."""
    if os.environ.get("PHYSION_SKIP_NOTHING"):
        pytest.fail(f"{what}; PHYSION_SKIP_NOTHING is set", pytrace=False)
    pytest.skip(what)


def find_program(*names: str, variable: str = "", what: str = "") -> str:
    """The path of a program: the one that the environment's ``variable`` names, else the first of
    ``names`` that is installed."""
    named = os.environ.get(variable) if variable else None
    for name in (named,) if named else names:
        found = shutil.which(name)
        if found is not None:
            return found
    named_by = f", or set {variable} to its path" if variable else ""
    absent(f"{what or names[0]} is absent: install it{named_by}")


def find_chromium() -> str:
    """The browser of the browser tests."""
    names = ("chromium", "chromium-browser", "google-chrome")
    return find_program(*names, variable="PHYSION_BROWSER", what="Chromium")


def find_firefox() -> str:
    """The second browser of the browser tests."""
    return find_program("firefox-esr", "firefox", variable="PHYSION_FIREFOX", what="Firefox")


def find_webkit() -> str:
    """The driver of the third browser of the browser tests."""
    return find_program("WebKitWebDriver", variable="PHYSION_WEBKIT", what="WebKitWebDriver")
