"""API endpoints: parse the request, call the store once, return its message."""

from __future__ import annotations

import json
import re
from typing import TYPE_CHECKING, Literal, TypeVar

from fastapi import APIRouter
from pydantic import ValidationError
from starlette.concurrency import run_in_threadpool
from starlette.requests import Request
from starlette.responses import Response

from physion.core.errors import BadInputError
from physion.experiment.protocol import (
    MAX_BODY,
    Answer,
    AskedQuestion,
    CheckedQuestion,
    Enter,
    Events,
    Health,
    Message,
    PageDone,
    PaidAmount,
    PublicStudy,
    Refused,
    Showing,
    TrialMedia,
)
from physion.experiment.study.media import sign_media
from physion.experiment.study.recruitment import RECRUITERS, ending_completion, is_mturk_preview
from physion.experiment.study.stimuli import PHASES
from physion.experiment.web.guards import MESSAGES, Reply, describe_faults, refuse

if TYPE_CHECKING:
    from physion.experiment.store.store import Store
    from physion.experiment.study.identity import Secrets
    from physion.experiment.study.settings import PaymentRule, Question
    from physion.experiment.study.study import Study


M = TypeVar("M", bound=Message)
_NUL = re.compile(rb"(?<!\\)(?:\\\\)*\\u0000")
"""NUL in a text, which no table of others can hold."""


class BadBodyError(BadInputError):
    """Error for an invalid body; the message gives the reason without repeating the value."""


async def read_message(request: Request, message: type[M]) -> M:
    """Read and validate the body of a request.

    Raises
    ------
    BadBodyError
        The body is not JSON, or not this message.
    Refused
        The body is too large; the rest of it is not read.
    """
    kind = request.headers.get("content-type", "").partition(";")[0].strip().lower()
    if kind != "application/json":
        raise BadBodyError("the body must be application/json")
    declared, body = request.headers.get("content-length", ""), b""
    if declared.isdigit() and int(declared) > MAX_BODY:
        raise Refused("too_large", MESSAGES["too_large"])
    async for part in request.stream():
        body += part
        if len(body) > MAX_BODY:
            raise Refused("too_large", MESSAGES["too_large"])
    return parse_message(body, message)


def parse_message(body: bytes, message: type[M]) -> M:
    """Validate the bytes of a body, as `read_message` does."""
    if _NUL.search(body):
        raise BadBodyError("the body has a NUL character")
    try:
        return message.model_validate_json(body, strict=True)
    except ValidationError as error:
        raise BadBodyError(describe_faults(error)) from error


_BEARER = re.compile(rb"bearer ([A-Za-z0-9_-]{1,200})", re.IGNORECASE)
"""A token of `identity.new_token`, without anything around it."""
SHOWN: tuple[Literal["movie"], Literal["map"]] = ("movie", "map")


def public_study(study: Study, secrets: Secrets) -> PublicStudy:
    """Return the settings of the study that anyone may see."""
    return PublicStudy(
        title=study.title,
        contact=study.contact,
        languages=list(study.languages),
        consent_version=study.consent_version,
        consent_files=sorted(study.consent_files),
        funders=study.funders,
        payment=_paid(study.payment),
        expected_minutes=study.payment.minutes,
        scenarios=list(study.scenarios),
        id_needed=study.recruitment.id_needed,
        min_width=study.screen.min_width,
        min_height=study.screen.min_height,
        fullscreen=study.screen.fullscreen,
        cue_ms=study.timing.cue_ms,
        flash_hz=study.timing.flash_hz,
        break_every=study.timing.break_every,
        familiarization_feedback=study.familiarization_feedback,
        hold_minutes=study.recruitment.hold_minutes,
        preload=study.preload,
        interrupted=study.plausibility.interrupted,
        comprehension_questions=[
            CheckedQuestion(name=each.name, options=list(each.options))
            for each in study.comprehension_questions
        ],
        comprehension_limit=study.comprehension.attempts,
        practice_min_correct=study.practice.min_correct,
        questions=[_asked(question) for question in study.questions],
        example={name: _example(study, secrets, name) for name in study.scenarios},
        recruiters=list(RECRUITERS),
        device_refused={
            one.source: ending_completion(study.device_refused, one.source) for one in RECRUITERS
        },
    )


def _paid(payment: PaymentRule) -> PaidAmount | None:
    """Return what the consent says of the payment; None if it says nothing."""
    if not payment.amount:
        return None
    return PaidAmount(amount=payment.amount, currency=payment.currency)


def _asked(question: Question) -> AskedQuestion:
    """Return what the page needs to ask a question of the lab."""
    values = {**vars(question), "options": list(question.options)}
    del values["right"]
    return AskedQuestion.model_validate(values)


def _example(study: Study, secrets: Secrets, scenario: str) -> TrialMedia:
    """Return the example trial of the instructions: the last familiarization trial, observed part.

    It is not a test trial, and of the familiarization trials it is shown again latest.
    """
    trial = len(study.phase(scenario, "familiarization")) - 1
    shown = study.phase(scenario, "familiarization")[trial]
    movie, picture = (
        sign_media(study, secrets, scenario, 0, "familiarization", trial, kind) for kind in SHOWN
    )
    return TrialMedia(
        trial=0,
        movie=movie,
        map=picture,
        frames=shown.frames,
        rate=shown.rate,
        width=shown.width,
        height=shown.height,
        fixation_ms=1000,
    )


def token_of(request: Request) -> str:
    """Return the token of ``Authorization: Bearer TOKEN``, or an empty string.

    Empty if there is no or more than one such header, or another value.
    """
    values = [value for name, value in request.scope["headers"] if name == b"authorization"]
    match = _BEARER.fullmatch(values[0]) if len(values) == 1 else None
    return match[1].decode("ascii") if match else ""


def build_api(study: Study, secrets: Secrets, store: Store) -> APIRouter:
    """Return the router of all endpoints below ``/api``."""
    router = APIRouter(prefix="/api")
    about = public_study(study, secrets).model_dump_json().encode()
    texts = {
        language: json.dumps(dict(words), ensure_ascii=False).encode()
        for language, words in study.texts.items()
    }

    # First, because routes are matched in order and this one gets most requests.
    @router.post("/answers")
    async def post_answer(request: Request) -> Response:
        """Store an answer."""
        answer = await read_message(request, Answer)
        return Reply(await store.answer(token_of(request), answer))

    @router.get("/study")
    async def get_study(request: Request) -> Response:
        """Return the public settings of the study."""
        return Response(about, media_type="application/json")

    @router.get("/texts/{language}")
    async def get_texts(request: Request) -> Response:
        """Return the texts of one language."""
        body = texts.get(request.path_params["language"])
        return (
            refuse("not_found") if body is None else Response(body, media_type="application/json")
        )

    @router.post("/enter")
    async def post_enter(request: Request) -> Response:
        """Continue a session, or show the consent to a new visitor."""
        enter = await read_message(request, Enter)
        if is_mturk_preview(enter):
            return refuse("not_yet", "Accept the task first.")
        return Reply(await store.enter(enter, token_of(request)))

    @router.get("/session")
    async def get_session(request: Request) -> Response:
        """Return the state of the session."""
        load = request.query_params.get("load") == "true"
        return Reply(await store.state(token_of(request), load))

    @router.get("/trials/{phase}")
    async def get_trials(request: Request) -> Response:
        """Return the trials of a phase."""
        phase = request.path_params["phase"]
        if phase not in PHASES:
            return refuse("not_found")
        return Reply(await run_in_threadpool(store.trials, token_of(request), phase))

    @router.post("/page")
    async def post_page(request: Request) -> Response:
        """Store a submitted page."""
        page = await read_message(request, PageDone)
        return Reply(await store.page(token_of(request), page))

    @router.post("/showings")
    async def post_showing(request: Request) -> Response:
        """Store that the next trial begins."""
        showing = await read_message(request, Showing)
        return Reply(await store.showing(token_of(request), showing))

    @router.post("/events")
    async def post_events(request: Request) -> Response:
        """Store events of the browser."""
        events = await read_message(request, Events)
        return Reply(await store.events(token_of(request), events))

    @router.get("/result")
    async def get_result(request: Request) -> Response:
        """Return the result of a finished session."""
        return Reply(await run_in_threadpool(store.result, token_of(request)))

    @router.get("/ending")
    async def get_ending(request: Request) -> Response:
        """Return the end of a session that ended before it was complete."""
        return Reply(await run_in_threadpool(store.ending, token_of(request)))

    @router.api_route("/health", methods=["GET", "HEAD"])
    async def get_health(request: Request) -> Response:
        """Return whether the database answers."""
        answers = await run_in_threadpool(store.healthy)
        return Reply(Health(ok=True)) if answers else refuse("unavailable")

    return router
