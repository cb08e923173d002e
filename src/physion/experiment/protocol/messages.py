"""What browser and server say to each other, as types: one model a message, each bounded.

All bodies are JSON, at most 64 KiB. A participant's requests carry ``Authorization: Bearer TOKEN``
with the token of `Entered`; who may see what follows from the token alone, so that no request names
a session. Times of the client are milliseconds of its own monotonic clock.

============================  =========================  ==========================================
request                       body, answer               meaning
============================  =========================  ==========================================
``GET /api/study``            `PublicStudy`              what the page needs before anyone enters
``GET /api/texts/{language}`` flat object of texts       words of the pages
``POST /api/enter``           `Enter`, `Entered`         begin, or go on with, a session
``GET /api/session``          `State`                    where the session stands; ``?load=true``
                                                         once for each time that the page is loaded
``GET /api/trials/{phase}``   `TrialList`                what to show; no name, no outcome
``GET /media/...``            bytes                      paths of `TrialMedia`, signed, no token
``POST /api/page``            `PageDone`, `State`        a page between the trials was sent
``POST /api/answers``         `Answer`, `AnswerStored`   stored before it is acknowledged
``POST /api/events``          `Events`, `Stored`         what else happened in the browser
``GET /api/result``           `Result`                   accuracy, percentile, completion; at the
                                                         end alone
``GET /api/health``           `Health`                   for load balancers: the database answers
============================  =========================  ==========================================

Refusals are `Refusal` bodies with a status of 4xx; see `REFUSALS`.
"""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field, StringConstraints

Phase = Literal["familiarization", "test"]
Stage = Literal[
    "consent",
    "instructions",
    "familiarization",
    "ready",
    "test",
    "demographics",
    "feedback",
    "done",
    "withdrawn",
]
"""Stages of a session, in this order; ``withdrawn`` ends it at any time."""
Kind = Literal["person", "simulated", "preview"]
Source = Literal["link", "prolific", "sona", "mturk"]

REFUSALS = {
    "bad_request": 422,
    "too_large": 413,
    "unknown_token": 401,
    "bad_link": 403,
    "id_needed": 403,
    "already_took_part": 409,
    "study_full": 409,
    "wrong_stage": 409,
    "out_of_order": 409,
    "already_answered": 409,
    "not_yet": 403,
    "too_many": 429,
    "not_found": 404,
    "not_allowed": 405,
    "unavailable": 503,
    "server_error": 500,
}
"""Codes of refusals and their HTTP status. ``out_of_order``, ``already_answered`` and
``wrong_stage`` carry the state, from which the client goes on."""

MAX_BODY = 64 * 1024
DAY_MS = 86_400_000.0
Name = Annotated[str, StringConstraints(min_length=1, max_length=200)]
RawId = Annotated[str, StringConstraints(min_length=1, max_length=200, strip_whitespace=True)]
Key = Annotated[str, StringConstraints(pattern=r"^[A-Za-z0-9-]{8,64}$")]
VisitWord = Annotated[str, StringConstraints(pattern=r"^[A-Za-z0-9-]{16,64}$")]
Text = Annotated[str, StringConstraints(max_length=5000)]
Milliseconds = Annotated[float, Field(ge=0, le=DAY_MS, allow_inf_nan=False)]
Count = Annotated[int, Field(ge=0, le=1_000_000)]
Pixels = Annotated[int, Field(ge=0, le=100_000)]


class Message(BaseModel):
    """A body that is refused where it holds what it should not."""

    model_config = ConfigDict(extra="forbid", frozen=True)


class Device(Message):
    """Browser and screen, measured once when the page is loaded."""

    user_agent: Annotated[str, StringConstraints(max_length=1000)] = ""
    refresh_hz: Annotated[float, Field(ge=0, le=1000, allow_inf_nan=False)] | None = None
    screen_width: Pixels | None = None
    screen_height: Pixels | None = None
    pixel_ratio: Annotated[float, Field(ge=0, le=100, allow_inf_nan=False)] | None = None
    touch: bool | None = None


class Enter(Message):
    """Who comes, from where. ``id`` is the recruiter's; without one, ``link`` gives a new person.

    ``visit`` is a random word that the page makes once, before it asks for the first time, and
    keeps in its storage. Where there is no ``id`` it tells who comes, so that asking again gives
    the same session; where ``id`` is needed it is no id. Without both everybody is a new person.
    ``recruiter`` holds the further parameters of the address (study id, visit id, ...), kept beside
    the raw id alone. ``pass_`` (sent as ``pass``) is the signed word of a preview or pilot link.
    """

    model_config = ConfigDict(extra="forbid", frozen=True, populate_by_name=True)

    source: Source = "link"
    id: RawId | None = None
    visit: VisitWord | None = None
    recruiter: Annotated[dict[Name, Annotated[str, StringConstraints(max_length=500)]],
                         Field(max_length=10)] = {}  # fmt: skip
    scenario: Name | None = None
    language: Annotated[str, StringConstraints(max_length=20)] = ""
    pass_: Annotated[str, StringConstraints(max_length=200)] | None = Field(
        default=None, alias="pass"
    )
    device: Device = Device()


class State(Message):
    """Where a session stands. ``trial`` is the next one of the phase; None outside phases."""

    stage: Stage
    trial: int | None
    trials: dict[Phase, int]
    scenario: str
    language: str
    kind: Kind
    buttons: Literal["yes-no", "no-yes"]
    reference: str
    """Short code that a participant can name to the experimenter; tells nothing else."""


class Entered(Message):
    """The token is shown once here and never stored but as a hash."""

    token: str
    state: State


class TrialMedia(Message):
    """One trial as it is shown. Paths begin with ``/media/``."""

    trial: int
    movie: str
    map: str
    frames: int
    rate: float
    width: int
    height: int
    fixation_ms: int


class TrialList(Message):
    """The trials of a phase in the participant's own order."""

    phase: Phase
    trials: list[TrialMedia]


class PageDone(Message):
    """A page was sent: ``consent`` {agreed: bool, language: what it was read in, optional},
    ``instructions`` {}, ``ready`` {},
    ``demographics`` {age, gender, education}, ``feedback`` {difficulty, technical_problems, text},
    ``withdraw`` {}. Sending a page twice changes nothing and gives the state.
    """

    page: Literal["consent", "instructions", "ready", "demographics", "feedback", "withdraw"]
    data: Annotated[dict[Name, bool | int | float | Text | None], Field(max_length=20)] = {}


class Answer(Message):
    """One prediction. ``key`` is made once by the client for each answer and kept over retries."""

    key: Key
    phase: Phase
    trial: Annotated[int, Field(ge=0, le=100_000)]
    response: Literal["yes", "no"]
    rt_ms: Milliseconds
    input: Literal["mouse", "touch", "keyboard"]
    fixation_ms: Milliseconds | None = None
    cue_ms: Milliseconds | None = None
    frames_shown: Count | None = None
    frames_dropped: Count | None = None
    movie_ms: Milliseconds | None = None
    visibility_changes: Count | None = None
    window_width: Pixels | None = None
    window_height: Pixels | None = None
    details: Annotated[dict[Name, Any], Field(max_length=30)] = {}
    """Moments of cue changes and frames, and what else there is; at most 16 KiB as JSON."""


class Feedback(Message):
    """After a familiarization answer alone: what happens, and the whole movie."""

    contact: bool
    correct: bool
    movie: str
    frames: int


class AnswerStored(Message):
    """The answer is on the disk. ``duplicate``: it was there already, under the same key."""

    duplicate: bool
    feedback: Feedback | None
    state: State


class Event(Message):
    """Something that happened in the browser: ``hidden``, ``offline``, ``error``, ``resized``..."""

    kind: Annotated[str, StringConstraints(pattern=r"^[a-z_]{1,40}$")]
    at_ms: Milliseconds
    data: Annotated[dict[Name, bool | int | float | Text | None], Field(max_length=20)] = {}


class Events(Message):
    """Events of one load of the page. ``key`` is made once for each batch and kept over retries:
    a batch that is there already is not stored twice (``stored`` is 0).
    """

    key: Key | None = None
    events: Annotated[list[Event], Field(max_length=50)]


class Stored(Message):
    """So many were stored."""

    stored: int


class Completion(Message):
    """How the participant gets the credit: a code to copy, an address to go to, or both.

    ``post``: the address takes a form by POST with these fields (MTurk), not a visit.
    """

    code: str | None
    url: str | None
    post: dict[str, str] | None = None


class Result(Message):
    """What a participant is told at the end. ``percentile``: the share of the other finished people
    of the scenario with fewer correct, plus half of those with as many, in %: alone at the top 100,
    alone at the bottom 0. None while fewer than the study's ``percentile_from`` others have
    finished.
    """

    correct: int
    trials: int
    accuracy: float
    percentile: float | None
    completion: Completion


class Recruiter(Message):
    """How the address of the page tells who comes: names of one recruiter's parameters.

    An address belongs to the first recruiter whose ``id`` or one of whose ``preview`` parameters it
    has, else it is a plain link. ``others`` go into ``Enter.recruiter`` where present. ``preview``:
    an address with one of these values shows only information and no session may begin (MTurk).
    Any address may have ``scenario``, ``language`` and ``pass``, which go into `Enter` as they are.
    """

    source: Source
    id: str
    others: list[str]
    preview: dict[str, str] = {}


class PublicStudy(Message):
    """What anyone may know who opens the page."""

    title: str
    contact: str
    languages: list[str]
    consent_version: str
    scenarios: list[str]
    id_needed: bool
    min_width: int
    min_height: int
    cue_ms: int
    flash_hz: float
    preload: int
    """So many trials ahead are loaded before they are shown."""
    example: dict[str, TrialMedia]
    """Media of the instructions' animated example, by scenario."""
    recruiters: list[Recruiter]
    """In the order in which they are tried."""


class Health(Message):
    """The server answers, and so does its database."""

    ok: bool


class Refusal(Message):
    """Why not, in a word for programs and a sentence for people."""

    error: str
    message: str
    state: State | None = None
