"""Insert generated sessions directly into the tables, for tests of code that reads them."""

from __future__ import annotations

import time
from typing import Any

import numpy as np
import sqlalchemy as sa

from physion.experiment.store.database import (
    ANSWERS,
    EVENTS,
    PARTICIPANTS,
    RAW_IDS,
    SESSIONS,
    STUDIES,
)
from physion.experiment.study.identity import Secrets, new_reference, new_session, participant_hash
from physion.experiment.study.study import Study

BROWSERS = (
    "Mozilla/5.0 (X11; Linux x86_64) AppleWebKit/537.36 (KHTML, like Gecko) Chrome/150.0.0.0 "
    "Safari/537.36",
    "Mozilla/5.0 (Windows NT 10.0; Win64; x64; rv:140.0) Gecko/20100101 Firefox/140.0",
    "Mozilla/5.0 (Macintosh; Intel Mac OS X 10_15_7) AppleWebKit/605.1.15 (KHTML, like Gecko) "
    "Version/18.5 Safari/605.1.15",
)
ENDS = ("finished", "going", "left", "withdrawn", "withdrawn")


def insert_sessions(
    engine: sa.Engine,
    study: Study,
    secrets: Secrets,
    count: int,
    *,
    kind: str = "person",
    ends: tuple[str, ...] = ("finished",) * 7 + ENDS[1:],
    seed: int = 0,
    now: float | None = None,
    **facts: Any,
) -> list[str]:
    """Insert ``count`` sessions of new participants and return their names.

    Answers are correct in 70 % of the trials; every 17th person always presses the same button. One
    session begins every three minutes until an hour before ``now``.

    Parameters
    ----------
    engine, study, secrets
        Database, study and its keys.
    count
        Number of sessions.
    kind
        Kind of all sessions.
    ends
        Outcomes to draw from.
    seed
        Seed of the random draws.
    now
        Time of the latest activity in seconds since 1970; the current time if None.
    facts
        Columns of SESSIONS that override the generated values.
    """
    generator = np.random.default_rng([seed, count])
    now = time.time() if now is None else now
    rows: dict[str, list[dict[str, Any]]] = {
        name: [] for name in ("people", "raw", "sessions", "answers", "events")
    }
    for number in range(count):
        scenario = study.scenarios[number % len(study.scenarios)]
        end = ends[int(generator.integers(len(ends)))]
        started = now - 180.0 * (count - number) - 3600.0
        raw_id = f"{kind}-{seed}-{number:05d}"
        participant = participant_hash(secrets, "prolific", raw_id)
        session = _session(study, scenario, kind, participant, started, end, generator, now)
        session |= facts
        rows["people"].append({"participant": participant, "first_seen": started})
        rows["raw"].append({"participant": participant, "source": "prolific", "raw_id": raw_id,
                            "recruiter": {"STUDY_ID": "s1"}, "seen": started})  # fmt: skip
        rows["sessions"].append(session)
        rows["answers"] += _answers(study, session, generator, number % 17 == 16)
        rows["events"].append({"session": session["session"], "kind": "hidden", "at_ms": 1234.5,
                               "stored_at": started, "data": {"trial": 3}})  # fmt: skip
    _insert(engine, study, rows, now)
    return [session["session"] for session in rows["sessions"]]


def _insert(
    engine: sa.Engine, study: Study, rows: dict[str, list[dict[str, Any]]], now: float
) -> None:
    with engine.connect() as connection, connection.begin():
        known = connection.scalar(sa.select(STUDIES.c.digest))
        if known is None:
            connection.execute(
                sa.insert(STUDIES),
                {"digest": study.digest, "name": study.name, "version": study.version,
                 "stimuli_digest": study.stimuli_digest, "settings": {}, "first_served": now},
            )  # fmt: skip
        for table, name in ((PARTICIPANTS, "people"), (RAW_IDS, "raw"), (SESSIONS, "sessions"),
                            (ANSWERS, "answers"), (EVENTS, "events")):  # fmt: skip
            if rows[name]:
                connection.execute(sa.insert(table), rows[name])


def _session(
    study: Study, scenario: str, kind: str, participant: str, started: float, end: str,
    generator: np.random.Generator, now: float,
) -> dict[str, Any]:  # fmt: skip
    practice, test = (len(study.phase(scenario, phase)) for phase in ("familiarization", "test"))
    part = int(generator.integers(0, practice + test))
    answered = practice + test if end == "finished" else part
    ready = answered >= practice
    finished = started + float(generator.uniform(900, 2400)) if end == "finished" else None
    return {
        "session": new_session(), "participant": participant, "scenario": scenario, "kind": kind,
        "source": "prolific", "study": study.digest, "reference": new_reference(),
        "order_seed": int(generator.integers(2**62)), "order_number": 0, "buttons": "yes-no",
        "language": "en", "started_at": started,
        "consent_version": "1",
        "consented_at": started + 20,
        "instructed_at": started + 60,
        "ready_at": started + 200 if ready else None,
        "demographics_at": finished and finished - 30,
        "finished_at": finished,
        "withdrawn_at": started + 400 if end == "withdrawn" else None,
        "answered_familiarization": min(answered, practice),
        "answered_test": max(0, answered - practice),
        "loads": 1, "loaded_at_phase": None, "loaded_at_trial": None,
        "last_seen": now - 30 if end == "going" else (finished or started + 500),
        "age": 31 if finished else None, "gender": "female" if finished else None,
        "education": "secondary" if finished else None, "difficulty": 3 if finished else None,
        "technical_problems": False if finished else None,
        "feedback": "It was fun." if finished else None,
        "device": {"user_agent": BROWSERS[int(generator.integers(3))],
                   "refresh_hz": float(generator.choice([59.94, 60.0, 144.1])),
                   "screen_width": 1920, "screen_height": 1080},
    }  # fmt: skip


def _answers(
    study: Study, session: dict[str, Any], generator: np.random.Generator, same: bool
) -> list[dict[str, Any]]:
    found = []
    for phase in ("familiarization", "test"):
        for trial, stimulus in enumerate(study.phase(session["scenario"], phase)):
            if trial >= session[f"answered_{phase}"]:
                break
            yes = same or bool(generator.random() < 0.7) == stimulus.label
            lost = int(generator.random() < 0.02) * int(generator.integers(1, 5))
            found.append({
                "session": session["session"], "phase": phase, "trial": trial,
                "key": f"{phase}-{trial}-key", "stimulus": stimulus.stimulus,
                "response": "yes" if yes else "no",
                "rt_ms": float(np.exp(generator.normal(6.6, 0.5))), "input": "mouse",
                "fixation_ms": 800.0, "cue_ms": 2000.0, "frames_expected": 45,
                "frames_shown": 45 - lost, "frames_dropped": lost, "movie_ms": 1466.0,
                "visibility_changes": 0, "window_width": 1280, "window_height": 720,
                "resumed": False, "answered_at": session["started_at"] + 90 + 7 * trial,
                "details": "{}",
            })  # fmt: skip
    return found
