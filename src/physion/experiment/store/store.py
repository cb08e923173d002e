"""The one interface of the server to the database: one method per request of a participant."""

from __future__ import annotations

import asyncio
import contextlib
import json
import time
from collections import deque
from collections.abc import Callable, Mapping
from dataclasses import asdict, replace
from typing import Any, Literal, TypeVar

from sqlalchemy import ColumnElement, Connection, Engine, func, insert, select, text, update
from sqlalchemy.exc import OperationalError

from physion.core.errors import BadInputError
from physion.core.settings import as_json
from physion.experiment.protocol import (
    ENDED,
    Answer,
    AnswerStored,
    Completion,
    Enter,
    Entered,
    Events,
    PageDone,
    Phase,
    Refused,
    Result,
    SessionEnd,
    SessionState,
    Showing,
    Shown,
    Stored,
    TrialList,
    TrialMedia,
)
from physion.experiment.store.answering import (
    FetchedMedia,
    check_page,
    encode_details,
    store_answer,
    store_showing,
    submit_page,
)
from physion.experiment.store.database import (
    EVENTS,
    RAW_IDS,
    SESSIONS,
    STUDIES,
    Writer,
    create_database,
    server_lock,
)
from physion.experiment.store.entry import Visit, begin_session, enter_session, identify_visitor
from physion.experiment.store.judging import Scores, percentile
from physion.experiment.store.sessions import (
    Courses,
    Step,
    insert_or_skip,
    read_session,
    state_of,
)
from physion.experiment.study.identity import Secrets, hash_token
from physion.experiment.study.media import MediaKind, session_tag, sign_media
from physion.experiment.study.orders import fixations, instructed_response, trial_order
from physion.experiment.study.recruitment import completion, ending_completion
from physion.experiment.study.settings import Question, columns_of
from physion.experiment.study.stimuli import ATTENTION, Stimulus
from physion.experiment.study.study import STUDY_FILE, Study, under

__all__ = ["Refused", "Store"]
T = TypeVar("T")
MAX_VISITS = 10_000
"""Visitors kept in memory until they agree to the consent; the oldest are dropped first."""
MAX_EVENTS = 2000
"""Number of events kept per session, so that nobody can fill the disk."""
MAX_EVENT = 16 * 1024
"""Characters of the JSON data of one event."""


class Store:
    """The sessions of one study. Coroutines write and return after the commit; the rest reads.

    Every method for a participant's request raises `Refused` if the request is refused; then
    nothing has changed.
    """

    def __init__(self, study: Study, secrets: Secrets, engine: Engine, writer: Writer) -> None:
        self.study, self.secrets, self.engine = study, secrets, engine
        self._writer = writer
        self._courses = Courses(study)
        self._scores = Scores(study)
        self.fetched = FetchedMedia()
        self._visits: dict[str, Visit] = {}
        """Visitors who read the consent, by the hash of their token, in the order of entering."""
        self._entered_at: deque[float] = deque(maxlen=MAX_VISITS)
        self._held = contextlib.ExitStack()

    @classmethod
    def open(cls, study: Study, secrets: Secrets) -> Store:
        """Open the study's database for writing; make it if it is missing.

        Raises
        ------
        PhysionError
            Another server uses the database.
        BadInputError
            Another version of this package wrote it, or it has sessions with other stimuli.
        """
        with contextlib.ExitStack() as held:
            held.enter_context(server_lock(study.folder))
            engine = create_database(study.folder)
            held.callback(engine.dispose)
            writer = Writer(engine)
            held.callback(writer.close)
            writer.submit(lambda connection: register(connection, study, time.time())).result()
            store = cls(study, secrets, engine, writer)
            store._held = held.pop_all()
        return store

    def close(self) -> None:
        """Write all waiting commands, then close the database."""
        self._held.close()

    async def enter(self, enter: Enter, token: str = "") -> Entered:
        """Continue a session, or show the consent to a new visitor, of whom nothing is stored.

        ``token``: one of an earlier visit of the browser.
        """
        visitor = identify_visitor(self.study, self.secrets, enter, token)
        others = list(self._visits.values())
        entered = await self._writer.run(
            lambda connection: enter_session(
                connection, self.study, self.secrets, self._courses, visitor, others
            )
        )
        if visitor.kind == "person":
            self._entered_at.append(visitor.now)
        session = entered.session if isinstance(entered, Visit) else entered
        if isinstance(entered, Visit):
            entered = self._as_before(entered)
            session = entered.session
            self._visits[hash_token(visitor.token)] = entered
            if len(self._visits) > MAX_VISITS:
                self._visits.pop(next(iter(self._visits)))
        return Entered(token=visitor.token, state=state_of(session, self._courses.of(session)))

    def _as_before(self, visit: Visit) -> Visit:
        """Return the visit, with the session that the person was shown before if there is one."""
        for each in self._visits.values():
            same = each.visitor.participant == visit.visitor.participant
            if same and visit.visitor.enter.scenario in (None, each.session.scenario):
                return replace(each, visitor=visit.visitor)
        return visit

    def entries(self, seconds: float) -> int:
        """Return how many people entered in the last seconds, whether they agreed or not."""
        since = time.time() - seconds
        return sum(at >= since for at in list(self._entered_at))

    async def state(self, token: str, load: bool = False) -> SessionState:
        """Return the state of a session; with ``load``, also count a load of the page."""
        if not load or hash_token(token) in self._visits:
            return await asyncio.to_thread(self._read, token, lambda step: step.state)

        def count(step: Step) -> SessionState:
            if step.stage not in ENDED:
                step.change(loads=step.session.loads + 1, last_seen=step.now, **step.loaded())
            return step.state

        return await self._write(token, count)

    def trials(self, token: str, phase: Phase) -> TrialList:
        """Return the media of the trials of a phase, in the session's order.

        The lists of both phases are available once consent is given, so that media can be loaded
        ahead.
        """

        def read(step: Step) -> TrialList:
            if step.stage in ENDED:
                raise step.refused("wrong_stage", "This session has ended.")
            if step.stage == "consent":
                raise step.refused("not_yet", "Trials come after the consent.")
            return TrialList(phase=phase, trials=self._list_media(step, phase))

        return self._read(token, read)

    async def page(self, token: str, done: PageDone) -> SessionState:
        """Store a submitted page and return the new state."""
        values = check_page(self.study, done)
        visit = self._visits.get(hash_token(token))
        if visit is not None:
            return await self._decide(token, visit, done.page, values, time.time())
        return await self._write(token, lambda step: submit_page(step, done.page, values))

    async def _decide(
        self, token: str, visit: Visit, page: str, values: Mapping[str, Any], now: float
    ) -> SessionState:
        """Store the session of a visitor who agrees to the consent; forget one who does not."""
        session = visit.session
        course = self._courses.of(session)
        declines = page == "withdraw" or values.get("agreed") is False
        if session.withdrawn_at is not None:
            if not declines:
                raise Refused("wrong_stage", "This page is not next.", state_of(session, course))
        elif declines:
            session = replace(session, participant="", browser=None, withdrawn_at=now)
            source = visit.visitor.enter.source
            nobody = replace(
                visit.visitor, enter=Enter(source=source), participant="", raw_id=None, browser=""
            )
            self._visits[hash_token(token)] = Visit(nobody, session, {"source": source})
        elif page != "consent":
            raise Refused("wrong_stage", "This page is not next.", state_of(session, course))
        else:
            language = values.get("language")
            session = await self._writer.run(
                lambda connection: begin_session(
                    connection, self.study, self._courses, visit, language, now
                )
            )
            self._visits.pop(hash_token(token), None)
        return state_of(session, self._courses.of(session))

    async def answer(self, token: str, answer: Answer) -> AnswerStored:
        """Store one answer; repeating the request does not store it twice."""
        details = encode_details(answer)

        def store(step: Step) -> tuple[AnswerStored, str]:
            tag, since = session_tag(self.secrets, step.session.session), step.session.started_at
            sent_at = self.fetched.sent_at(tag, since, answer.phase, answer.trial)
            return store_answer(step, self.secrets, answer, details, sent_at), tag

        stored, tag = await self._write(token, store)
        self.fetched.forget(tag, answer.phase, answer.trial)
        return stored

    async def showing(self, token: str, showing: Showing) -> Shown:
        """Store that the next trial begins; repeating the request does not count it twice."""
        return await self._write(token, lambda step: store_showing(step, showing))

    async def events(self, token: str, events: Events) -> Stored:
        """Store events, up to MAX_EVENTS per session, unless the key of the batch is known.

        Those before the consent are not stored.
        """
        rows = [
            {"batch": events.key, "kind": event.kind, "at_ms": event.at_ms,
             "data": _check_event_data(event.data, index)}
            for index, event in enumerate(events.events)
        ]  # fmt: skip
        if hash_token(token) in self._visits:
            return Stored(stored=0)

        def store(step: Step) -> Stored:
            if step.stage in ENDED:
                raise step.refused("wrong_stage", "This session has ended.")
            of_session = EVENTS.c.session == step.session.session
            if events.key is not None:
                same = select(EVENTS.c.event).where(of_session, EVENTS.c.batch == events.key)
                if step.connection.execute(same.limit(1)).first() is not None:
                    return Stored(stored=0)
            known = step.connection.scalar(select(func.count()).where(of_session)) or 0
            own = {"session": step.session.session, "stored_at": step.now}
            kept = [row | own for row in rows[: max(0, MAX_EVENTS - known)]]
            if kept:
                step.connection.execute(insert(EVENTS), kept)
            step.change(last_seen=step.now)
            return Stored(stored=len(kept))

        return await self._write(token, store)

    def result(self, token: str) -> Result:
        """Return accuracy, percentile and completion of a finished session."""
        return self._read(token, self._compute_result)

    def ending(self, token: str) -> SessionEnd:
        """Return the end of a session that ended before it was complete."""

        def read(step: Step) -> SessionEnd:
            if step.stage not in ENDED:
                raise step.refused("wrong_stage", "This session has not ended.")
            visit = self._visits.get(hash_token(token))
            if visit is not None:
                source = str(visit.values["source"])
            else:
                of_session = SESSIONS.c.session == step.session.session
                source = step.connection.scalars(select(SESSIONS.c.source).where(of_session)).one()
            ends = {"declined": self.study.declined, "withdrawn": self.study.stopped}
            end = ends.get(step.stage, self.study.screened_out)
            return SessionEnd(completion=ending_completion(end, source))

        return self._read(token, read)

    async def write(self, command: Callable[[Connection], T]) -> T:
        """Run any command in the writer."""
        return await self._writer.run(command)

    def healthy(self) -> bool:
        """Return whether the database answers."""
        try:
            with self.engine.connect() as connection:
                return bool(connection.scalar(text("SELECT 1")))
        except OperationalError:
            return False

    def _read(self, token: str, work: Callable[[Step], T]) -> T:
        """Run a query about the session of a token."""
        try:
            with self.engine.connect() as connection:
                return work(self._step(connection, token, time.time()))
        except OperationalError as error:
            raise Refused("unavailable", "The server cannot reach its database.") from error

    async def _write(self, token: str, work: Callable[[Step], T]) -> T:
        """Run a change of the session of a token."""
        now = time.time()
        return await self._writer.run(lambda c: work(self._step(c, token, now)))

    def _step(self, connection: Connection, token: str, now: float) -> Step:
        """Return the session of a token; of a visitor, the session as it will be."""
        visit = self._visits.get(hash_token(token))
        session = (
            visit.session if visit else read_session(connection, self.study, hash_token(token))
        )
        course = self._courses.of(session)
        return Step(connection, under(self.study, session.condition), course, session, now)

    def _list_media(self, step: Step, phase: Phase) -> list[TrialMedia]:
        """Return the signed media and timing of the trials of a phase."""
        study, session = step.study, step.session
        scenario, seed = session.scenario, session.order_seed
        crosses = fixations(study, scenario, seed, phase)
        tag = session_tag(self.secrets, session.session)

        def signed(trial: int, kind: MediaKind) -> str:
            return sign_media(study, self.secrets, scenario, seed, phase, trial, kind, tag)

        return [
            TrialMedia(
                trial=trial,
                movie=signed(trial, "movie"),
                map=signed(trial, "map"),
                frames=stimulus.frames,
                rate=stimulus.rate,
                width=stimulus.width,
                height=stimulus.height,
                fixation_ms=crosses[trial],
                instructed=_instructed(stimulus),
            )
            for trial, stimulus in enumerate(trial_order(study, scenario, seed)[phase])
        ]

    def _compute_result(self, step: Step) -> Result:
        """Compute the result of a finished session."""
        connection, session = step.connection, step.session
        if step.stage != "done":
            code = "wrong_stage" if step.stage in ENDED else "not_yet"
            raise step.refused(code, "The result comes at the end.")
        scores = self._scores.of(connection, session)
        correct = scores.pop(session.session, None)
        if correct is None:  # a preview of other stimuli, whose labels are no longer known
            raise Refused("unknown_token", "The stimuli have changed since; open your link again.")
        others = list(scores.values())
        order = trial_order(self.study, session.scenario, session.order_seed)
        trials = sum(each.phase == "test" for each in order["test"])
        enough = len(others) >= self.study.percentile_from
        row = connection.execute(
            select(SESSIONS).where(SESSIONS.c.session == session.session)
        ).one()
        raw = connection.execute(
            select(RAW_IDS).where(RAW_IDS.c.participant == session.participant)
        ).first()
        return Result(
            correct=correct,
            trials=trials,
            accuracy=correct / trials,
            percentile=percentile(correct, others) if enough else None,
            completion=Completion(code=None, url=None, withheld=True)
            if session.implausible
            else completion(self.study, self.secrets, row, raw),
        )


def register(connection: Connection, study: Study, now: float) -> None:
    """Store the current version of the study; refuse it if existing sessions could not continue.

    Previews that cannot continue are ended.

    Raises
    ------
    BadInputError
        There are sessions (of people or simulated participants) with other stimuli, of a scenario
        that the study no longer has, or with answers to another question of the same name.
    """
    other = SESSIONS.c.session.in_(
        select(SESSIONS.c.session)
        .join(STUDIES, STUDIES.c.digest == SESSIONS.c.study)
        .where(STUDIES.c.stimuli_digest != study.stimuli_digest)
    )
    gone = SESSIONS.c.scenario.not_in(study.scenarios)
    count = sum(_by_scenario(connection, other).values())
    if count:
        raise BadInputError(
            f"{count} sessions were made with another stimuli.csv or other media; "
            "their orders of trials would change. Restore the old stimuli and settings, or create "
            "a new study folder for the new ones"
        )
    for scenario, of_scenario in _by_scenario(connection, gone).items():
        raise BadInputError(
            f"{of_scenario} sessions are of the scenario {scenario}, which {STUDY_FILE} no longer "
            f"has: put {scenario} back into scenarios (to stop recruiting for it, distribute only "
            "links of the other scenarios), or create a new study folder without "
            "it"
        )
    _check_conditions(connection, study)
    _check_questions(connection, study)
    # Previews are not data: those that cannot continue are ended.
    ended = (other | gone) & SESSIONS.c.finished_at.is_(None) & SESSIONS.c.withdrawn_at.is_(None)
    connection.execute(update(SESSIONS).where(ended).values(withdrawn_at=now, closed_at=now))
    connection.execute(
        insert_or_skip(STUDIES),
        {
            "digest": study.digest,
            "name": study.name,
            "version": study.version,
            "stimuli_digest": study.stimuli_digest,
            "settings": _settings(study),
            "first_served": now,
        },
    )


def _check_conditions(connection: Connection, study: Study) -> None:
    """Refuse a study that lacks the condition of a session."""
    names = [condition.name for condition in study.conditions]
    lost = SESSIONS.c.condition.is_not(None) & SESSIONS.c.condition.not_in(names)
    found = select(SESSIONS.c.condition, func.count()).where(lost, SESSIONS.c.kind != "preview")
    for name, count in connection.execute(found.group_by(SESSIONS.c.condition)):
        raise BadInputError(
            f"{count} sessions are of the condition {name}, which {STUDY_FILE} no longer has: put "
            "it back, or create a new study folder without it"
        )


def _check_questions(connection: Connection, study: Study) -> None:
    """Refuse a question that was of another kind, or had another scale, when it was answered."""
    forms = {column: form for each in study.questions for column, form in _forms(vars(each))}
    answered = select(SESSIONS.c.questions_study).where(SESSIONS.c.kind != "preview").distinct()
    versions = select(STUDIES.c.settings).where(STUDIES.c.digest.in_(answered))
    for (settings,) in connection.execute(versions):
        for entry in settings.get("questions", ()):
            for column, form in _forms(entry):
                if forms.get(column, form) != form:
                    raise BadInputError(
                        f"the question {column} was answered in another form ({form[1]}); give "
                        f"the changed question another name in {STUDY_FILE}"
                    )


def _forms(entry: Mapping[str, Any]) -> list[tuple[str, tuple[str, str, int]]]:
    """Return the columns of a question, each with what its values depend on."""
    question = Question(**{**entry, "options": tuple(entry["options"])})
    steps = question.steps if question.kind == "scale" else 0
    return [(column, (question.name, question.kind, steps)) for column in columns_of(question)]


def _by_scenario(connection: Connection, which: ColumnElement[bool]) -> dict[str, int]:
    """Count the sessions that are not previews, by scenario in alphabetical order."""
    columns = SESSIONS.c
    counts = select(columns.scenario, func.count()).where(which, columns.kind != "preview")
    rows = connection.execute(counts.group_by(columns.scenario).order_by(columns.scenario))
    return dict(rows.all())


def _settings(study: Study) -> dict[str, Any]:
    """Return settings and texts as JSON values, without stimuli, whose labels stay private."""
    left_out = {"folder", "stimuli", "allowed_ids"}
    shallow = {name: value for name, value in vars(study).items() if name not in left_out}
    settings: dict[str, Any] = as_json(shallow, _plain)
    return settings


def _plain(value: Any) -> Any:
    return dict(value) if hasattr(value, "items") else asdict(value)


def _instructed(stimulus: Stimulus) -> Literal["yes", "no"] | None:
    """Return which button an attention check says to press; None for other trials."""
    asked = instructed_response(stimulus.stimulus) if stimulus.phase == ATTENTION else None
    return None if asked is None else "yes" if asked == "yes" else "no"


def _check_event_data(data: dict[str, Any], index: int) -> dict[str, Any]:
    """Return the data of an event; raise `Refused` if they are invalid or too long."""
    try:
        size = len(json.dumps(data, allow_nan=False))
    except ValueError:
        raise Refused("bad_request", f"events.{index}.data: only plain JSON values") from None
    if size > MAX_EVENT:
        raise Refused("bad_request", f"events.{index}.data: at most {MAX_EVENT} characters")
    return data
