"""The server is there soon: what takes seconds to import is imported where it is used."""

from __future__ import annotations

import subprocess
import sys

import pytest

from physion.analysis.exclusions import RULE_SETS
from physion.experiment.study_checks import EXCLUSIONS

SLOW_TO_IMPORT = (
    "pandas",
    "scipy",
    "sklearn",
    "statsmodels",
    "matplotlib",
    "av",
    "numba",
    "mujoco",
)


def test_rules_are_those_of_the_analysis() -> None:
    assert tuple(RULE_SETS) == EXCLUSIONS


def test_serving_imports_nothing_slow() -> None:
    pytest.importorskip("fastapi", reason="the extra 'experiment' is not installed")
    found = f"[name for name in {SLOW_TO_IMPORT} if name in sys.modules]"
    code = f"import sys, physion.experiment.server; print({found})"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"
