"""The server starts quickly: slow modules are imported only where they are used."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

pytest.importorskip("fastapi", reason="the extra 'experiment' is not installed")

from typing import get_args, get_type_hints

import httpx2

from physion.analysis.people.exclusions import RULE_SETS
from physion.experiment.server_process import ServerProcess
from physion.experiment.study.settings import StudySettings
from support.experiment.tiny_study import make_tiny_study

SLOW_TO_IMPORT = (
    "numpy",
    "pandas",
    "scipy",
    "sklearn",
    "statsmodels",
    "matplotlib",
    "numba",
    "mujoco",
)


def test_rules_match_the_analysis() -> None:
    allowed = get_type_hints(StudySettings)["exclusions"]
    assert tuple(RULE_SETS) == get_args(allowed)


def test_serving_imports_nothing_slow() -> None:
    found = f"[name for name in {SLOW_TO_IMPORT} if name in sys.modules]"
    code = f"import sys, physion.experiment.server; print({found})"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


def test_requests_are_logged_without_personal_data(tmp_path: Path) -> None:
    folder = make_tiny_study(tmp_path / "study", test=2, familiarization=1).folder
    with ServerProcess(folder, options=["--log-requests"]) as server:
        asked = httpx2.get(f"{server.url}/?PROLIFIC_PID=SECRET", trust_env=False, timeout=60)
        httpx2.get(f"{server.url}/no%0Asuch", trust_env=False, timeout=60)
        lines = server.last_output().splitlines()
    assert asked.status_code == 200
    for request in ("GET / 200", "GET /no%0Asuch 404"):
        assert sum(line.endswith(request) for line in lines) == 1
    assert not [line for line in lines if "SECRET" in line]
