"""All that a participant's session reads and writes; what is acknowledged is on the disk."""

from __future__ import annotations

import asyncio
import contextlib
import json
import time
from collections.abc import Callable
from typing import Any, TypeVar

from sqlalchemy import Connection, Engine, func, insert, select, text
from sqlalchemy.exc import OperationalError

from physion.experiment.protocol.messages import (
    Answer,
    AnswerStored,
    Enter,
    Entered,
    Events,
    PageDone,
    Phase,
    Result,
    State,
    Stored,
    TrialList,
    TrialMedia,
)
from physion.experiment.protocol.refused import Refused
from physion.experiment.store.answering import store_answer, write_details
from physion.experiment.store.database import (
    connect_writer,
    one_server,
    open_database,
    sqlite_url,
    upgrade,
)
from physion.experiment.store.entering import let_in, receive
from physion.experiment.store.scores import Scores, percentile
from physion.experiment.store.sent_pages import check_page, turn_page
from physion.experiment.store.sessions import (
    Session,
    Trials,
    change_session,
    mark_loaded,
    plain_values,
    read_session,
    stage_of,
    state_of,
)
from physion.experiment.store.tables import EVENTS, RAW_IDS, SESSIONS
from physion.experiment.store.writer import Writer
from physion.experiment.study.identity import Secrets, hash_token
from physion.experiment.study.orders import fixations, order_of
from physion.experiment.study.recruitment import completion
from physion.experiment.study.study import Study
from physion.experiment.study.study_record import register
from physion.experiment.web.media_links import sign_media

__all__ = ["Refused", "Store"]
T = TypeVar("T")
MAX_EVENTS = 2000
"""Events of a session that are kept; more would only fill the disk."""
MAX_EVENT = 16 * 1024


class Store:
    """The sessions of one study. Coroutines write and return after the commit; the rest reads.

    Every method raises `Refused` where a request is not granted, and then nothing has changed.
    """

    def __init__(self, study: Study, secrets: Secrets, engine: Engine, writer: Writer) -> None:
        self.study, self.secrets, self.engine = study, secrets, engine
        self._writer = writer
        self._trials = Trials(study)
        self._scores = Scores(study)
        self._held = contextlib.ExitStack()

    @classmethod
    def open(cls, study: Study, secrets: Secrets, url: str | None = None) -> Store:
        """Open the study's database for writing; without ``url`` SQLite in the study folder.

        Raises `PhysionError` where another server has it, and `BadInputError` where it was made by
        a newer version of this package, or with other stimuli.
        """
        with contextlib.ExitStack() as held:
            engine = open_database(url or sqlite_url(study.folder))
            held.callback(engine.dispose)
            held.enter_context(one_server(engine))
            upgrade(engine)
            writer = Writer(lambda: connect_writer(engine))
            held.callback(writer.close)
            writer.submit(lambda connection: register(connection, study, time.time())).result()
            store = cls(study, secrets, engine, writer)
            store._held = held.pop_all()
        return store

    def close(self) -> None:
        """Write what waits, then let go of the database."""
        self._held.close()

    async def enter(self, enter: Enter) -> Entered:
        """Begin a session or go on with one."""
        visitor = receive(self.study, self.secrets, enter)
        return await self._writer.run(
            lambda connection: let_in(connection, self.study, self.secrets, self._trials, visitor)
        )

    async def state(self, token: str, load: bool = False) -> State:
        """Where the session stands; ``load``: the page was loaded just now."""
        if not load:
            return await asyncio.to_thread(self._read, lambda c: self._state(c, token))
        now = time.time()

        def count(connection: Connection) -> State:
            session = read_session(connection, self.study, hash_token(token))
            trials = self._trials.of(session.scenario)
            if stage_of(session, trials) != "withdrawn":
                marks = mark_loaded(session, trials)
                loads = session.loads + 1
                change_session(connection, session, loads=loads, last_seen=now, **marks)
            return state_of(session, trials)

        return await self._writer.run(count)

    def trials(self, token: str, phase: Phase) -> TrialList:
        """What is shown in a phase, in the session's own order; once the phase is near.

        Both lists may be had as soon as the consent is given, so that media are loaded ahead.
        """
        session, trials = self._read(lambda c: self._session(c, token))
        stage = stage_of(session, trials)
        if stage == "withdrawn":
            raise Refused("wrong_stage", "This session has ended.", state_of(session, trials))
        if stage == "consent":
            raise Refused("not_yet", "Trials come after the consent.", state_of(session, trials))
        return TrialList(phase=phase, trials=self._media(session, phase))

    async def page(self, token: str, done: PageDone) -> State:
        """A page between the trials was sent."""
        values, now = check_page(done), time.time()

        def turn(connection: Connection) -> State:
            session, trials = self._session(connection, token)
            return turn_page(connection, self.study, trials, session, done.page, values, now)

        return await self._writer.run(turn)

    async def answer(self, token: str, answer: Answer) -> AnswerStored:
        """Store one answer; the same one again is found and not stored twice."""
        details, token_hash, now = write_details(answer), hash_token(token), time.time()

        def store(connection: Connection) -> AnswerStored:
            session = read_session(connection, self.study, token_hash)
            trials = self._trials.of(session.scenario)
            return store_answer(
                connection, self.study, self.secrets, trials, session, answer, details, now
            )

        return await self._writer.run(store)

    async def events(self, token: str, events: Events) -> Stored:
        """Store what happened in the browser, up to MAX_EVENTS a session; a batch under the same
        key is not stored again.
        """
        now = time.time()
        rows = [
            {"batch": events.key, "kind": event.kind, "at_ms": event.at_ms, "stored_at": now,
             "data": _event_data(event.data, index)}
            for index, event in enumerate(events.events)
        ]  # fmt: skip

        def store(connection: Connection) -> Stored:
            session, trials = self._session(connection, token)
            if stage_of(session, trials) == "withdrawn":
                raise Refused("wrong_stage", "This session has ended.", state_of(session, trials))
            of_session = EVENTS.c.session == session.session
            if events.key is not None:
                same = select(EVENTS.c.event).where(of_session, EVENTS.c.batch == events.key)
                if connection.execute(same.limit(1)).first() is not None:
                    return Stored(stored=0)
            known = connection.scalar(select(func.count()).where(of_session)) or 0
            kept = rows[: max(0, MAX_EVENTS - known)]
            if kept:
                connection.execute(
                    insert(EVENTS), [{**row, "session": session.session} for row in kept]
                )
            change_session(connection, session, last_seen=now)
            return Stored(stored=len(kept))

        return await self._writer.run(store)

    def result(self, token: str) -> Result:
        """Accuracy, percentile and completion of a session that is done."""
        return self._read(lambda connection: self._result(connection, token))

    async def write(self, command: Callable[[Connection], T]) -> T:
        """Have the writer run a command of someone else's; see `Writer` for what it must keep."""
        return await self._writer.run(command)

    def healthy(self) -> bool:
        """Does the database answer?"""
        try:
            return bool(self._read(lambda connection: connection.scalar(text("SELECT 1"))))
        except Refused:
            return False

    def _read(self, query: Callable[[Connection], T]) -> T:
        try:
            with self.engine.connect() as connection:
                return query(connection)
        except OperationalError as error:
            raise Refused("unavailable", "The server cannot reach its database.") from error

    def _session(self, connection: Connection, token: str) -> tuple[Session, Any]:
        session = read_session(connection, self.study, hash_token(token))
        return session, self._trials.of(session.scenario)

    def _state(self, connection: Connection, token: str) -> State:
        return state_of(*self._session(connection, token))

    def _media(self, session: Session, phase: Phase) -> list[TrialMedia]:
        study, scenario, seed = self.study, session.scenario, session.order_seed
        crosses = fixations(study, scenario, seed, phase)
        return [
            TrialMedia(
                trial=trial,
                movie=sign_media(study, self.secrets, scenario, seed, phase, trial, "movie"),
                map=sign_media(study, self.secrets, scenario, seed, phase, trial, "map"),
                frames=stimulus.frames,
                rate=stimulus.rate,
                width=stimulus.width,
                height=stimulus.height,
                fixation_ms=crosses[trial],
            )
            for trial, stimulus in enumerate(order_of(study, scenario, seed)[phase])
        ]

    def _result(self, connection: Connection, token: str) -> Result:
        session, trials = self._session(connection, token)
        stage = stage_of(session, trials)
        if stage != "done":
            code = "wrong_stage" if stage == "withdrawn" else "not_yet"
            raise Refused(code, "The result comes at the end.", state_of(session, trials))
        scores = dict(self._scores.of(connection, session.scenario, session.kind))
        correct = scores.pop(session.session, None)
        if correct is None:  # a preview of other stimuli: nobody knows any more what was right
            raise Refused("unknown_token", "The stimuli have changed since; open your link again.")
        others = list(scores.values())
        enough = len(others) >= self.study.percentile_from
        row = connection.execute(
            select(SESSIONS).where(SESSIONS.c.session == session.session)
        ).one()
        raw = connection.execute(
            select(RAW_IDS).where(RAW_IDS.c.participant == session.participant)
        ).first()
        return Result(
            correct=correct,
            trials=trials["test"],
            accuracy=correct / trials["test"],
            percentile=percentile(correct, others) if enough else None,
            completion=completion(self.study, self.secrets, row, raw),
        )


def _event_data(data: dict[str, Any], index: int) -> dict[str, Any]:
    try:
        size = len(json.dumps(data, allow_nan=False))
    except ValueError:
        raise Refused("bad_request", f"events.{index}.data: plain JSON values alone") from None
    if size > MAX_EVENT:
        raise Refused("bad_request", f"events.{index}.data: at most {MAX_EVENT} characters")
    return plain_values(data)
