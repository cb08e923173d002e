"""Crash tests: no acknowledged answer is lost or duplicated when the server is killed under load.

Simulated participants complete the study while the server is killed (SIGKILL) at random moments and
started again. They retry with the same key until the server answers, as the pages do. Afterwards
every acknowledged answer must be in the database exactly once and unaltered, and every session must
be complete.
"""

from __future__ import annotations

import asyncio
import threading
import time
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("fastapi", reason="the extra 'experiment' is not installed")

import sqlalchemy as sa

from physion.experiment.simulated import SimulatedVisit, SimulationPlan, simulate
from physion.experiment.store.database import open_database
from physion.experiment.study.identity import Secrets
from physion.experiment.study.study import Study
from support.experiment.serving import QuickServer, stored_answers, stored_sessions
from support.experiment.tiny_study import make_tiny_study

PHASES = {"familiarization": 3, "test": 12}
LONGEST_RUN_S = 0.4
"""Longest time in seconds between the start of the server and a kill."""


class Load:
    """Waves of participants until the context ends, which waits for the last ones to finish."""

    def __init__(self, study: Study, url: str, people: int) -> None:
        self._study, self._secrets = study, Secrets.load(study.folder)
        self._url, self._people = url, people
        self._stopping = threading.Event()
        self.waves: list[list[SimulatedVisit]] = []
        self._thread = threading.Thread(target=lambda: asyncio.run(self._run()), daemon=True)
        self.error: BaseException | None = None

    async def _run(self) -> None:
        try:
            await asyncio.gather(*(self._run_waves(number) for number in range(3)))
        except BaseException as error:
            self.error = error

    async def _run_waves(self, number: int) -> None:
        wave = 0
        while not self._stopping.is_set():
            # Retry often, but leave processor time for the server.
            plan = SimulationPlan(
                self._url, self._people, seed=1000 * number + wave, dropouts=0.0, pace=0.01,
                waits_s=(0.05, 0.4), patience_s=300.0, media=False,
            )  # fmt: skip
            self.waves.append(await simulate(self._study, self._secrets, plan))
            wave += 1

    def __enter__(self) -> Load:
        self._thread.start()
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        self._stopping.set()
        if kind is not None:  # the server may have ended
            return
        self._thread.join(300)
        assert not self._thread.is_alive(), "the participants did not get to the end"
        if self.error is not None:
            raise self.error

    @property
    def visits(self) -> list[SimulatedVisit]:
        """The visits of all waves."""
        return [visit for wave in self.waves for visit in wave]


def kill_again_and_again(server: QuickServer, kills: int, seed: int) -> None:
    """Kill the server at random moments, mostly while it serves and sometimes while it starts."""
    rng = np.random.default_rng(seed)
    for number in range(kills):
        time.sleep(rng.random() * LONGEST_RUN_S)
        server.kill()
        if number % 10 == 5:
            server.launch()
            time.sleep(rng.random() * LONGEST_RUN_S)
            server.kill()
        server.start()


def check(study: Study, visits: list[SimulatedVisit]) -> None:
    """Check that all acknowledged answers are stored unaltered and all sessions are complete."""
    assert {visit.outcome for visit in visits} == {"done"}, [
        visit for visit in visits if visit.outcome != "done"
    ][:3]
    stored, sessions = stored_answers(study), stored_sessions(study)
    known = {(visit.reference, a.phase, a.trial): a for visit in visits for a in visit.answers}
    assert len(known) == sum(len(visit.answers) for visit in visits), "acknowledged twice"
    for trial, answer in known.items():
        row = stored[trial]
        sent = (answer.key, answer.stimulus, answer.response, answer.rt_ms)
        assert (row.key, row.stimulus, row.response, row.rt_ms) == sent
    assert len(sessions) == len(visits)
    assert len(stored) == len(visits) * sum(PHASES.values())
    for session in sessions.values():
        assert session.finished_at is not None and session.kind == "simulated"
        assert session.answered_familiarization == PHASES["familiarization"]
        assert session.answered_test == PHASES["test"]


def make_study(folder: Path) -> Study:
    return make_tiny_study(folder, familiarization=PHASES["familiarization"], test=PHASES["test"])


@pytest.mark.slow
@pytest.mark.parametrize("kills", [10, pytest.param(50, marks=pytest.mark.nightly)])
def test_nothing_is_lost_when_the_server_is_killed_again_and_again(
    kills: int, tmp_path: Path
) -> None:
    study = make_study(tmp_path / "study")
    with QuickServer(study.folder) as server, Load(study, server.url, people=5) as load:
        kill_again_and_again(server, kills, seed=1)
    assert sum(visit.retries for visit in load.visits) > kills, "the kills met no load"
    check(study, load.visits)
    engine = open_database(study.folder)
    with engine.connect() as connection:
        assert connection.scalar(sa.text("PRAGMA integrity_check")) == "ok"
    engine.dispose()
