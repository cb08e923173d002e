"""Simulated participants in a study with all checks, and the page of such a session."""

from __future__ import annotations

import asyncio
from pathlib import Path

import httpx2
import pytest

pytest.importorskip("fastapi", reason="the extra 'experiment' is not installed")

from physion.experiment.server_process import ServerProcess
from physion.experiment.simulated import SimulationPlan, simulate
from physion.experiment.study.identity import Secrets
from physion.experiment.study.settings import Attention, Practice
from support.experiment.experimenter_client import BASE
from support.experiment.own_questions import (
    COMPREHENSION,
    COMPREHENSION_TEXTS,
    OWN_QUESTIONS,
    OWN_TEXTS,
)
from support.experiment.serving import stored_sessions
from support.experiment.tiny_study import PASSWORD, make_tiny_study


def test_simulated_participants_pass_all_checks(tmp_path: Path) -> None:
    study = make_tiny_study(
        tmp_path, test=3, familiarization=1, obvious=1, size=64, languages=("en",),
        attention=Attention(instructed=1), practice=Practice(min_correct=1, failed="flag"),
        comprehension_questions=COMPREHENSION, questions=OWN_QUESTIONS,
        more_texts=COMPREHENSION_TEXTS + OWN_TEXTS,
    )  # fmt: skip
    with ServerProcess(study.folder) as server:
        plan = SimulationPlan(server.url, participants=4, dropouts=0.0)
        visits = asyncio.run(simulate(study, Secrets.load(study.folder), plan))
        assert {visit.outcome for visit in visits} == {"done"}
        assert all(visit.result is not None and visit.result.trials == 3 for visit in visits)
        sessions = list(stored_sessions(study).values())
        page = read_page(server.url, sessions[0].session)
    assert {row.attention_failed for row in sessions} == {0}
    assert {row.comprehension_attempts for row in sessions} == {1}
    assert all(set(row.own_answers) == {each.name for each in OWN_QUESTIONS} for row in sessions)
    for text in ("instructed_1_", "attention", "Failed checks"):
        assert text in page


def read_page(url: str, session: str) -> str:
    """Return the experimenter's page of a session."""
    with httpx2.Client(base_url=url, follow_redirects=True, timeout=60) as client:
        client.post(f"{BASE}/login", data={"password": PASSWORD}, headers={"origin": url})
        return client.get(f"{BASE}/sessions/{session}").text
