"""Where the tests lie, and how another Python process finds them."""

from __future__ import annotations

import os
from pathlib import Path

TESTS = Path(__file__).parents[1]
ROOT = TESTS.parent
FIND_TESTS = {**os.environ, "PYTHONPATH": os.pathsep.join(map(str, (ROOT / "src", TESTS, ROOT)))}
"""Lets a new process import ``support``, ``tests`` and the package of this checkout."""
