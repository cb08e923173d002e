"""The server is killed under load, again and again: no acknowledged answer is lost or doubled.

Simulated participants go through the study while the server, or PostgreSQL under it, is ended as by
``kill -9`` at random moments and started again. They ask again with the same key until they are
answered, as the pages do. Afterwards every answer that was acknowledged must be in the database as
it was sent, once, and every session must be complete.
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
from serving import stored_answers, stored_sessions
from tiny_study import make_tiny_study

from physion.experiment.identity import Secrets
from physion.experiment.own_server import OwnServer
from physion.experiment.simulated import Plan, Visit, simulate
from physion.experiment.study import Limits, Study

KILLS = 50
PHASES = {"familiarization": 3, "test": 12}
FAST = Limits(requests_per_second=10_000, burst=100_000, sessions_per_minute=100_000)
"""Limits that do not slow the load down; they are tested elsewhere."""
LONGEST_RUN_S = 0.4
"""A kill comes at a random moment up to so long after the server is there."""


class Load:
    """Participants who keep coming until they are told to stop; then the last ones finish."""

    def __init__(self, study: Study, url: str, people: int) -> None:
        self._study, self._secrets = study, Secrets.load(study.folder)
        self._url, self._people = url, people
        self._stopping = threading.Event()
        self.waves: list[list[Visit]] = []
        self._thread = threading.Thread(target=lambda: asyncio.run(self._run()))
        self.error: BaseException | None = None

    async def _run(self) -> None:
        try:
            await asyncio.gather(*(self._come(place) for place in range(3)))
        except BaseException as error:
            self.error = error

    async def _come(self, place: int) -> None:
        wave = 0
        while not self._stopping.is_set():
            plan = Plan(
                self._url, self._people, seed=1000 * place + wave, dropouts=0.0, pace=0.01,
                waits_s=(0.02, 0.2), patience_s=90.0, media=False,
            )  # fmt: skip
            self.waves.append(await simulate(self._study, self._secrets, plan))
            wave += 1

    def __enter__(self) -> Load:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._stopping.set()
        self._thread.join(120)
        assert not self._thread.is_alive(), "the participants did not get to the end"
        if self.error is not None:
            raise self.error

    @property
    def visits(self) -> list[Visit]:
        """Everybody who came."""
        return [visit for wave in self.waves for visit in wave]


def kill_again_and_again(server: OwnServer, kills: int, seed: int) -> None:
    """Kill at random moments, most of them in work and some while the server starts."""
    rng = np.random.default_rng(seed)
    for number in range(kills):
        time.sleep(rng.random() * LONGEST_RUN_S)
        server.kill()
        if number % 10 == 5:
            server.launch()
            time.sleep(rng.random() * 1.0)
            server.kill()
        server.start()


def check(study: Study, visits: list[Visit], url: str | None = None) -> None:
    """All that was acknowledged is there once and unaltered, and all sessions are complete."""
    assert {visit.outcome for visit in visits} == {"done"}, [
        visit for visit in visits if visit.outcome != "done"
    ][:3]
    stored, sessions = stored_answers(study, url), stored_sessions(study, url)
    told = {(visit.reference, a.phase, a.trial): a for visit in visits for a in visit.answers}
    assert len(told) == sum(len(visit.answers) for visit in visits), "acknowledged twice"
    for place, answer in told.items():
        row = stored[place]
        sent = (answer.key, answer.stimulus, answer.response, answer.rt_ms)
        assert (row.key, row.stimulus, row.response, row.rt_ms) == sent
    assert len(sessions) == len(visits)
    assert len(stored) == len(visits) * sum(PHASES.values())
    for session in sessions.values():
        assert session.finished_at is not None and session.kind == "simulated"
        assert session.answered_familiarization == PHASES["familiarization"]
        assert session.answered_test == PHASES["test"]


def make_study(folder: Path) -> Study:
    return make_tiny_study(
        folder, familiarization=PHASES["familiarization"], test=PHASES["test"], limits=FAST
    )


@pytest.mark.slow
def test_sqlite_loses_nothing_when_the_server_is_killed_fifty_times(tmp_path: Path) -> None:
    study = make_study(tmp_path / "study")
    with OwnServer(study.folder) as server, Load(study, server.url, people=10) as load:
        kill_again_and_again(server, KILLS, seed=1)
    retries = sum(visit.retries for visit in load.visits)
    assert retries > KILLS, "the kills met no load"
    check(study, load.visits)
    engine = sa.create_engine(f"sqlite:///{study.folder / 'responses.sqlite'}")
    with engine.connect() as connection:
        assert connection.scalar(sa.text("PRAGMA integrity_check")) == "ok"
    engine.dispose()
    print(f"{len(load.visits)} sessions, {retries} requests sent again")
