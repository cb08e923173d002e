"""What a participant sends: answers, showings of trials, and the pages between the trials.

Only the answer to the next trial is stored, and only once; in familiarization it gets feedback.
What a request may change follows from the stage of the session, so every request may be sent again.
`FetchedMedia` remembers which movies and maps the server has sent.
"""

from __future__ import annotations

import json
import threading
import time
from collections import OrderedDict
from collections.abc import Mapping, Sequence
from typing import Annotated, Any

from pydantic import (
    AfterValidator,
    BaseModel,
    Field,
    StringConstraints,
    ValidationError,
)
from sqlalchemy import bindparam, func, select, update

from physion.core.settings import STRICT
from physion.experiment.protocol import (
    ENDED,
    PAGES,
    STAGES,
    Answer,
    AnswerStored,
    Feedback,
    PageDone,
    Refused,
    SessionState,
    Showing,
    Shown,
)
from physion.experiment.store.database import ANSWERS, SESSIONS, SHOWINGS
from physion.experiment.store.judging import (
    TOLERANCE_S,
    Presentation,
    earliest_answer,
    judge_practice,
    judged,
    reasons,
    repeated_response,
    speed,
)
from physion.experiment.store.sessions import (
    Session,
    Step,
    answered,
    insert_or_skip,
    with_check,
)
from physion.experiment.study.identity import Secrets
from physion.experiment.study.media import MediaKind, session_tag, sign_media
from physion.experiment.study.orders import trial_order
from physion.experiment.study.settings import check_answers, check_attempt
from physion.experiment.study.stimuli import ATTENTION, PHASES, Stimulus, is_right
from physion.experiment.study.study import Study

MAX_DETAILS = 16 * 1024
_STORED = select(ANSWERS.c.key, ANSWERS.c.response).where(
    ANSWERS.c.session == bindparam("of_session"),
    ANSWERS.c.phase == bindparam("of_phase"),
    ANSWERS.c.trial == bindparam("of_trial"),
)
_JUDGED = ("fast_answers", "unfetched", "replayed", "implausible", "next_from")
"""Columns of a session that change with each answer, besides its number of answers."""
_COUNT = {
    phase: update(SESSIONS)
    .where(SESSIONS.c.session == bindparam("of_session"))
    .values(
        {f"answered_{phase}": bindparam("count")}
        | dict.fromkeys(("last_seen", "progressed_at"), bindparam("now"))
        | {name: bindparam(f"new_{name}") for name in _JUDGED}
    )
    for phase in PHASES
}


def encode_details(answer: Answer) -> str:
    """Return the further measurements of an answer as JSON text.

    Raises
    ------
    Refused
        They are not plain JSON values, or longer than `MAX_DETAILS` characters.
    """
    try:
        text = json.dumps(answer.details, allow_nan=False, separators=(",", ":"))
    except (ValueError, TypeError, RecursionError):
        raise Refused("bad_request", "details: only plain JSON values") from None
    if len(text) > MAX_DETAILS:
        raise Refused("bad_request", f"details: at most {MAX_DETAILS} characters as JSON")
    return text


def store_answer(
    step: Step, secrets: Secrets, answer: Answer, details: str, fetched_at: float | None = None
) -> AnswerStored:
    """Store the answer to the next trial, unless the same answer is stored already.

    Parameters
    ----------
    step
        The session; its count of answers is increased.
    secrets
        The keys of the study.
    answer
        The answer as sent by the client.
    details
        `encode_details` of the answer.
    fetched_at
        `FetchedMedia.sent_at` of the trial.

    Raises
    ------
    Refused
        Another trial is next, the trial or the key has another answer, or the trial was not shown
        or cannot have been shown until now.
    """
    study, session = step.study, step.session
    known = answered(session, answer.phase)
    # Stimuli cannot change while there are sessions, so an answered trial has its stimulus still.
    order = trial_order(study, session.scenario, session.order_seed)[answer.phase]
    response = repeated_response(step.connection, session, answer)
    if response is None and answer.trial < known:
        response = _read_stored(step, answer, order[answer.trial])
    duplicate = response is not None
    if response is None:
        response = answer.response
        _store_new(step, answer, details, known, order, fetched_at)
    feedback = None
    if answer.phase == PHASES[0] and study.familiarization_feedback:
        stimulus = order[answer.trial]
        feedback = _build_feedback(study, secrets, session, stimulus, answer.trial, response)
    return AnswerStored(duplicate=duplicate, feedback=feedback, state=step.state)


def _read_stored(step: Step, answer: Answer, stimulus: Stimulus) -> str:
    """Return the stored response of a trial if it has the same key; else raise `Refused`."""
    of = {"of_session": step.session.session, "of_phase": stimulus.phase, "of_trial": answer.trial}
    row = step.connection.execute(_STORED, of).one()
    if row.key != answer.key:
        raise step.refused("already_answered", "This trial is already answered.")
    return str(row.response)


def _store_new(
    step: Step,
    answer: Answer,
    details: str,
    known: int,
    order: Sequence[Stimulus],
    fetched_at: float | None,
) -> None:
    """Store an answer that is not stored yet, and judge it."""
    session = step.session
    if step.stage not in PHASES:
        raise step.refused("wrong_stage", "No trial is next.")
    if step.stage != answer.phase or answer.trial != known:
        raise step.refused("out_of_order", "Another trial is next.")
    stimulus = order[answer.trial]
    if answer.phase == PHASES[0] and session.practice_repeats > 0:
        fetched_at = None  # the browser may still have the media of the first practice
    shown = _read_presentation(step, answer, fetched_at)
    changes = _judge(step, answer, shown)
    row = {
        **answer.model_dump(exclude={"details"}),
        "session": session.session,
        "phase": stimulus.phase,
        "stimulus": stimulus.stimulus,
        "frames_expected": stimulus.frames,
        "showings": shown.showings or None,
        "details": details,
        "resumed": (session.loaded_at_phase, session.loaded_at_trial)
        == (answer.phase, answer.trial),
        "answered_at": step.now,
    }
    # Only a key that another trial has can conflict; then nothing is written.
    if step.connection.execute(insert_or_skip(ANSWERS), row).rowcount != 1:
        raise step.refused("already_answered", "This key belongs to another trial.")
    new = {f"new_{name}": value for name, value in changes.items()}
    of = {"of_session": session.session, "count": answer.trial + 1, "now": step.now}
    step.connection.execute(_COUNT[answer.phase], of | new)
    setattr(session, f"answered_{answer.phase}", answer.trial + 1)
    if answer.phase == PHASES[0]:
        judge_practice(step)
    if stimulus.phase == ATTENTION:
        _judge_attention(step, answer, stimulus)


def _judge_attention(step: Step, answer: Answer, check: Stimulus) -> None:
    """Count a failed attention check, unless its movie was interrupted."""
    if is_right(answer.response, check.label) or answer.void is not None:
        return
    failed = step.session.attention_failed + 1
    too_many = failed > step.study.attention.max_failed
    flag = with_check(step.session, ATTENTION) if too_many else {}
    step.change(attention_failed=failed, **flag)


def _judge(step: Step, answer: Answer, shown: Presentation) -> dict[str, Any]:
    """Return the columns of `_JUDGED` after an answer; raise `Refused` if it comes too early."""
    study, session, now = step.study, step.session, step.now
    earliest = earliest_answer(study, session, answer.phase, answer.trial, shown)
    if study.plausibility.server_checks and now < earliest:
        raise Refused(
            "too_early",
            "The movie of this trial cannot have been shown yet.",
            wait_s=earliest - now,
        )
    changes: dict[str, Any] = judged(study, session, answer, shown)
    for name, value in changes.items():
        setattr(session, name, value)
    ended_at = earliest + (TOLERANCE_S + answer.rt_ms / 1000) / speed(study, session)
    return changes | {"implausible": reasons(study, session), "next_from": min(now, ended_at)}


def _build_feedback(
    study: Study,
    secrets: Secrets,
    session: Session,
    stimulus: Stimulus,
    trial: int,
    response: str,
) -> Feedback:
    """Return the feedback on a familiarization answer."""
    return Feedback(
        contact=stimulus.label,
        correct=is_right(response, stimulus.label),
        movie=sign_media(
            study,
            secrets,
            session.scenario,
            session.order_seed,
            PHASES[0],
            trial,
            "full",
            session_tag(secrets, session.session),
        ),
        frames=stimulus.full_frames,
    )


MAX_STORED = 50
"""Showings stored for one trial, so that nobody can fill the disk."""
_OF_TRIAL = select(func.count(), func.max(SHOWINGS.c.began_at)).where(
    SHOWINGS.c.session == bindparam("of_session"),
    SHOWINGS.c.phase == bindparam("of_phase"),
    SHOWINGS.c.trial == bindparam("of_trial"),
)


def store_showing(step: Step, showing: Showing) -> Shown:
    """Store that the next trial begins; the same key is stored once.

    It cannot have begun before the previous trial had ended (``Session.next_from``). A showing of a
    trial that is answered already, which was delayed on its way, is not stored.

    Raises
    ------
    Refused
        Another trial or another page is next.
    """
    session, phase, trial = step.session, showing.phase, showing.trial
    count, _ = _read(step, phase, trial)
    if trial < answered(session, phase):
        return Shown(showings=count)
    if step.stage != phase:
        raise step.refused("wrong_stage", "No trial of this phase is next.")
    if trial != answered(session, phase):
        raise step.refused("out_of_order", "Another trial is next.")
    if count < MAX_STORED:
        row = {
            "session": session.session,
            "key": showing.key,
            "phase": phase,
            "trial": trial,
            "began_at": max(step.now - showing.ago_ms / 1000, session.next_from or 0.0),
            "stored_at": step.now,
        }
        count += step.connection.execute(insert_or_skip(SHOWINGS), row).rowcount
    return Shown(showings=count)


def _read_presentation(step: Step, answer: Answer, fetched_at: float | None) -> Presentation:
    """Return what is known of the showings of the trial of an answer.

    Without the server's checks a trial need not have been announced; else `Refused` is raised.
    """
    count, began_at = _read(step, answer.phase, answer.trial)
    if not step.study.plausibility.server_checks:
        return Presentation(count, began_at or 0.0, None)
    if began_at is None:
        raise step.refused("not_shown", "This trial was not shown yet.")
    return Presentation(count, began_at, fetched_at)


def _read(step: Step, phase: str, trial: int) -> tuple[int, float | None]:
    """Return the number of showings of a trial, and the start of the last one."""
    values = {"of_session": step.session.session, "of_phase": phase, "of_trial": trial}
    count, began_at = step.connection.execute(_OF_TRIAL, values).one()
    return count, began_at


MIN_AGE, MAX_AGE = 18, 130
MAX_LABEL = 200
"""Characters of a short text such as gender."""
_Label = Annotated[
    str,
    StringConstraints(max_length=MAX_LABEL, strip_whitespace=True),
    AfterValidator(lambda text: text or None),
]


class _Page(BaseModel):
    """Data of a page without fields; None means "prefer not to say"."""

    model_config = STRICT


class _Consent(_Page):
    agreed: bool
    language: _Label | None = None


class _Demographics(_Page):
    age: Annotated[int, Field(ge=MIN_AGE, le=MAX_AGE)] | None
    gender: _Label | None
    education: _Label | None


class _Feedback(_Page):
    difficulty: Annotated[int, Field(ge=1, le=5)]
    technical_problems: bool
    text: Annotated[str, StringConstraints(strip_whitespace=True)]


FIELDS: Mapping[str, type[_Page]] = {
    "consent": _Consent,
    "instructions": _Page,
    "ready": _Page,
    "demographics": _Demographics,
    "feedback": _Feedback,
    "withdraw": _Page,
}
"""What the pages send; the questions of the study are checked by `study.settings`."""


def check_page(study: Study, done: PageDone) -> dict[str, Any]:
    """Return the validated values of a page.

    Raises
    ------
    Refused
        A field is missing, invalid or unknown; the message names the first one.
    """
    try:
        if done.page == "questions":
            return {"own_answers": check_answers(study.questions, done.data)}
        if done.page == "comprehension":
            return dict(check_attempt(study.comprehension_questions, done.data))
    except ValueError as error:
        raise Refused("bad_request", f"data.{error}") from None
    if done.page not in FIELDS:
        raise Refused("bad_request", f"page: {done.page} is not a page that is submitted")
    try:
        values = FIELDS[done.page].model_validate(done.data)
    except ValidationError as error:
        fault = error.errors(include_url=False, include_context=False, include_input=False)[0]
        name = ascii(str(fault["loc"][0])[:40])[1:-1]
        raise Refused("bad_request", f"data.{name}: {fault['msg']}") from None
    return values.model_dump(exclude_none=done.page != "demographics")


def submit_page(step: Step, page: str, values: Mapping[str, Any]) -> SessionState:
    """Apply a submitted page to the session; a page that was submitted before changes nothing.

    Raises
    ------
    Refused
        The page is not the next one.
    """
    stage = step.stage
    if page == "withdraw" or values.get("agreed") is False:
        if stage == "done":
            raise step.refused("wrong_stage", "This session is finished.")
        if stage not in ENDED:
            step.change(withdrawn_at=step.now, last_seen=step.now)
        return step.state
    if stage in ENDED or STAGES.index(stage) < STAGES.index(page):  # type: ignore[arg-type]
        raise step.refused("wrong_stage", "This page is not next.")
    if stage == page:
        if stage == "comprehension":
            columns = _judge_attempt(step, values)
        else:
            columns = {PAGES[stage].column: step.now, **_columns(step, page, values)}
        times = dict.fromkeys(("last_seen", "progressed_at", "next_from"), step.now)
        step.change(**times, **columns)
    return step.state


def _columns(step: Step, page: str, values: Mapping[str, Any]) -> dict[str, Any]:
    """Return the columns of SESSIONS that a page sets, besides the time at which it was sent."""
    match page:
        case "demographics":
            return dict(values)
        case "questions":
            return {**values, "questions_study": step.study.digest}
        case "feedback":
            return {
                "implausible": reasons(step.study, step.session, step.now),
                "difficulty": values["difficulty"],
                "technical_problems": values["technical_problems"],
                "feedback": values["text"],
            }
        case _:
            return {}


ATTEMPT = "comprehension_attempt"
"""Kind of the event of an attempt; its data are its number, whether all was right, the answers."""


def _judge_attempt(step: Step, answers: Mapping[str, str]) -> dict[str, Any]:
    """Store an attempt as an event and return the columns of SESSIONS that it changes.

    After a wrong answer the instructions are next; after the last attempt the session has ended.
    ``answers`` come from `study.settings.check_attempt`.
    """
    attempts, study = step.session.comprehension_attempts + 1, step.study
    right = all(answers[each.name] == each.right for each in study.comprehension_questions)
    step.add_event(ATTEMPT, {"attempt": attempts, "right": right, **answers})
    columns: dict[str, Any] = {"comprehension_attempts": attempts}
    if right:
        return columns | {"comprehended_at": step.now}
    if attempts >= study.comprehension.attempts:
        return columns | {"screened_out_at": step.now, "screened_out_by": "comprehension"}
    return columns | {"instructed_at": None}


MAX_SESSIONS = 20_000
"""Sessions remembered; the least recently used are dropped first."""
_Trial = tuple[str, int]


class FetchedMedia:
    """When the media of each trial were first sent, by the tag of the session in their URLs."""

    def __init__(self, most: int = MAX_SESSIONS) -> None:
        self._most = most
        self._since = time.time()
        self._complete = True
        self._sent: OrderedDict[str, dict[_Trial, dict[MediaKind, float]]] = OrderedDict()
        self._lock = threading.Lock()

    def note(self, tag: str, phase: str, trial: int, kind: MediaKind, now: float) -> None:
        """Record that a file was sent at the time ``now`` in seconds since 1970."""
        with self._lock:
            trials = self._sent.setdefault(tag, {})
            trials.setdefault((phase, trial), {}).setdefault(kind, now)
            self._sent.move_to_end(tag)
            if len(self._sent) > self._most:
                self._sent.popitem(last=False)
                self._complete = False

    def sent_at(self, tag: str, started_at: float, phase: str, trial: int) -> float | None:
        """Return the time at which movie and map of a trial had both been asked for.

        Parameters
        ----------
        tag
            `media.session_tag` of the session.
        started_at
            When the session began.
        phase, trial
            The trial.

        Returns
        -------
        The time in seconds since 1970; infinity if one of them was never asked for; None if it is
        not known, because the session began before this server or was dropped from memory.
        """
        with self._lock:
            trials = self._sent.get(tag)
            if started_at < self._since or (trials is None and not self._complete):
                return None
            sent = (trials or {}).get((phase, trial), {})
            return max(sent.get("movie", float("inf")), sent.get("map", float("inf")))

    def forget(self, tag: str, phase: str, trial: int) -> None:
        """Forget the media of a trial, which was answered."""
        with self._lock:
            trials = self._sent.get(tag)
            if trials is not None:
                trials.pop((phase, trial), None)
