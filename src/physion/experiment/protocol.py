"""Types of the messages between browser and server: one bounded pydantic model per message.

All bodies are JSON, at most 64 KiB. A participant's requests carry ``Authorization: Bearer TOKEN``
with the token of `Entered`; the token identifies the session, so no request names one. Client
times are milliseconds of the browser's monotonic clock.

============================  =========================  ==========================================
request                       body, answer               meaning
============================  =========================  ==========================================
``GET /api/study``            `PublicStudy`              settings that the page needs before a
                                                         session begins
``GET /api/texts/{language}`` flat object of texts       texts of the pages
``POST /api/enter``           `Enter`, `Entered`         continue a session, or show the consent
                                                         to a visitor, who is not stored yet
``GET /api/session``          `SessionState`             current stage and trial; ``?load=true``
                                                         once for each time that the page is loaded
``GET /api/trials/{phase}``   `TrialList`                media of the trials, without stimulus names
                                                         and outcomes
``GET /media/...``            bytes                      signed paths of `TrialMedia`, no token
``POST /api/page``            `PageDone`, `SessionState` submit a page between the trials
``POST /api/showings``        `Showing`, `Shown`         announce that the next trial begins
``POST /api/answers``         `Answer`, `AnswerStored`   store an answer; acknowledged after commit
``POST /api/events``          `Events`, `Stored`         store other events in the browser
``GET /api/result``           `Result`                   accuracy, percentile and completion of a
                                                         finished session
``GET /api/ending``           `SessionEnd`               completion of a session that was declined
                                                         or stopped
``GET /api/health``           `Health`                   health check for load balancers, including
                                                         the database
============================  =========================  ==========================================

A refused request is answered with a `Refusal`; codes and HTTP statuses are in `REFUSALS`.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Annotated, Any, Literal, get_args

from pydantic import BaseModel, ConfigDict, Field, StringConstraints

from physion.core.errors import PhysionError

# Stages of a session: the one list of pages and phases, from which all others are derived.
#
# To add a page: add its stage to `Stage` and its row to `PAGES`, in the order of a session; its
# column to `store.database.SESSIONS` (raise SCHEMA) and to `store.sessions.Session`; its fields to
# `store.answering.FIELDS`; and its rendering to ``PAGES`` in ``static/session.js``.
# `store.sessions.stages_of` says which studies have it.

Phase = Literal["familiarization", "test"]
Stage = Literal[
    "consent",
    "instructions",
    "comprehension",
    "familiarization",
    "ready",
    "test",
    "demographics",
    "questions",
    "feedback",
    "done",
    "declined",
    "withdrawn",
    "screened_out",
]
"""Stages of a session, in this order; the `ENDED` ones can follow any other but ``done``."""
STAGES: tuple[Stage, ...] = get_args(Stage)
ENDED: tuple[Stage, ...] = ("declined", "withdrawn", "screened_out")
"""Stages of sessions that ended before they were complete: no consent, stopped, or ended by the
study since the participant failed the comprehension check."""


@dataclass(frozen=True)
class Page:
    """A page that is submitted: the column of SESSIONS with the time of it, and a label."""

    column: str
    label: str


PAGES: Mapping[Stage, Page] = {
    "consent": Page("consented_at", "Consent"),
    "instructions": Page("instructed_at", "Instructions"),
    "comprehension": Page("comprehended_at", "Comprehension check"),
    "ready": Page("ready_at", "Start page"),
    "demographics": Page("demographics_at", "Demographics"),
    "questions": Page("questions_at", "Own questions"),
    "feedback": Page("finished_at", "Feedback"),
}
"""The pages by stage; the last one finishes the session."""


@dataclass(frozen=True)
class Course:
    """What a session consists of.

    Attributes
    ----------
    stages
        Its pages and phases in order, ``done`` last.
    trials
        Number of trials in each phase.
    settings
        Settings of the study that may differ between sessions: the fields of
        `SessionSettings`.
    """

    stages: tuple[Stage, ...]
    trials: Mapping[str, int]
    settings: Mapping[str, float] = field(default_factory=dict)


def label(stage: str) -> str:
    """Return the name of a stage on the experimenter's pages."""
    known: dict[str, str] = {page: about.label for page, about in PAGES.items()}
    known["done"] = "Finished"
    return known.get(stage, stage.capitalize())


Kind = Literal["person", "simulated", "preview"]
Source = Literal["link", "prolific", "sona", "mturk"]

REFUSALS = {
    "bad_request": 422,
    "too_large": 413,
    "unknown_token": 401,
    "bad_link": 403,
    "id_needed": 403,
    "id_refused": 403,
    "other_browser": 403,
    "already_took_part": 409,
    "study_full": 409,
    "held": 409,
    "paused": 409,
    "wrong_stage": 409,
    "out_of_order": 409,
    "already_answered": 409,
    "not_shown": 409,
    "too_early": 425,
    "not_yet": 403,
    "too_many": 429,
    "not_found": 404,
    "not_allowed": 405,
    "unavailable": 503,
    "server_error": 500,
}
"""Refusal codes and their HTTP status. ``out_of_order``, ``already_answered``, ``not_shown`` and
``wrong_stage`` carry the state from which to continue, ``too_early`` a header Retry-After."""

MAX_BODY = 64 * 1024
"""Bytes of a request body."""
DAY_MS = 86_400_000.0
Name = Annotated[str, StringConstraints(min_length=1, max_length=200)]
RawId = Annotated[str, StringConstraints(min_length=1, max_length=200, strip_whitespace=True)]
Key = Annotated[str, StringConstraints(pattern=r"^[A-Za-z0-9-]{8,64}$")]
VisitKey = Annotated[str, StringConstraints(pattern=r"^[A-Za-z0-9-]{16,64}$")]
Text = Annotated[str, StringConstraints(max_length=5000)]
Names = Annotated[list[Name], Field(max_length=50)]
Milliseconds = Annotated[float, Field(ge=0, le=DAY_MS, allow_inf_nan=False)]
Count = Annotated[int, Field(ge=0, le=1_000_000)]
Pixels = Annotated[int, Field(ge=0, le=100_000)]


class Message(BaseModel):
    """Base class of all messages: immutable, and unknown fields are refused."""

    model_config = ConfigDict(extra="forbid", frozen=True)


class Device(Message):
    """Properties of browser and screen, measured once when the page is loaded."""

    user_agent: Annotated[str, StringConstraints(max_length=1000)] = ""
    refresh_hz: Annotated[float, Field(ge=0, le=1000, allow_inf_nan=False)] | None = None
    screen_width: Pixels | None = None
    screen_height: Pixels | None = None
    pixel_ratio: Annotated[float, Field(ge=0, le=100, allow_inf_nan=False)] | None = None
    touch: bool | None = None


class Enter(Message):
    """Request to begin or continue a session.

    Parameters
    ----------
    source
        Recruiter, or ``link`` for a plain link.
    id
        The participant's id at the recruiter.
    visit
        Random key that the page makes once, before its first request, and keeps in the browser's
        storage. An unfinished session is continued only with its key, with one of its tokens, or by
        a link signed for the ``id``. Without an ``id`` (which it does not replace where one is
        required) it identifies the participant; without both, every request is a new participant.
    recruiter
        Further URL parameters of the recruiter (study id, visit id, ...), stored only together with
        the raw id.
    scenario, language
        Wanted scenario and language; the server chooses if they are absent.
    condition
        The condition that the link fixes; the link must be signed for it.
    pass_
        Sent as ``pass``: signed key of the link (`recruitment.LINK_KEYS`).
    device
        Browser and screen.
    """

    model_config = ConfigDict(extra="forbid", frozen=True, populate_by_name=True)

    source: Source = "link"
    id: RawId | None = None
    visit: VisitKey | None = None
    recruiter: Annotated[dict[Name, Annotated[str, StringConstraints(max_length=500)]],
                         Field(max_length=10)] = {}  # fmt: skip
    scenario: Name | None = None
    condition: Name | None = None
    language: Annotated[str, StringConstraints(max_length=20)] = ""
    pass_: Annotated[str, StringConstraints(max_length=200)] | None = Field(
        default=None, alias="pass"
    )
    device: Device = Device()


class SessionSettings(Message):
    """Settings of the study in the session's condition, instead of `PublicStudy`."""

    cue_ms: int
    flash_hz: float
    break_every: int
    familiarization_feedback: bool


class SessionState(Message):
    """State of a session.

    ``trial`` is the next trial of the phase, None outside a phase. ``condition``: empty if the
    study has no conditions.
    """

    stage: Stage
    ended: bool
    """Whether the session ended before it was complete."""
    trial: int | None
    trials: dict[Phase, int]
    comprehension_attempts: int
    """How often the comprehension check was answered."""
    practice_repeats: int
    """How often the practice was repeated."""
    answered: bool
    """Whether a trial was answered, after which stopping is final."""
    condition: str
    settings: SessionSettings
    scenario: str
    language: str
    kind: Kind
    buttons: Literal["yes-no", "no-yes"]
    reference: str
    """Short random code by which a participant can refer to the session when contacting us."""


class Entered(Message):
    """A new token for the session, which the server stores only as a hash, and the state."""

    token: str
    state: SessionState


class TrialMedia(Message):
    """Media and timing of one trial. ``movie`` and ``map`` are paths below ``/media/``."""

    trial: int
    movie: str
    map: str
    frames: int
    rate: float
    width: int
    height: int
    fixation_ms: int
    instructed: Literal["yes", "no"] | None = None
    """Which button an attention check says to press after the movie; None for other trials."""


class TrialList(Message):
    """The trials of a phase in the order of this session."""

    phase: Phase
    trials: list[TrialMedia]


class PageDone(Message):
    """Submission of a page between the trials; sending it twice changes nothing.

    Fields of ``data`` by page: ``consent`` {agreed: bool, language: optional, in which it was
    read}; ``comprehension`` {NAME: option, for each of `PublicStudy.comprehension_questions`};
    ``demographics`` {age, gender, education}; ``questions`` {NAME: answer, for each of
    `PublicStudy.questions`}; ``feedback`` {difficulty, technical_problems, text}; ``ready``,
    ``instructions`` and ``withdraw`` {}.
    """

    page: Literal[Stage, "withdraw"]
    data: Annotated[dict[Name, bool | int | float | Text | Names | None],
                    Field(max_length=50)] = {}  # fmt: skip


class Showing(Message):
    """The next trial begins, ``ago_ms`` before the request is sent; one ``key`` per showing."""

    key: Key
    phase: Phase
    trial: Annotated[int, Field(ge=0, le=100_000)]
    ago_ms: Milliseconds = 0.0


class Shown(Message):
    """How often the trial has been shown over all loads of the page, this time included."""

    showings: int


class Answer(Message):
    """One prediction. ``key`` is drawn by the client per answer and stays the same over retries."""

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
    break_ms: Milliseconds | None = None
    """Duration of the break before this trial; None: there was none."""
    void: Literal["hidden", "dialog", "window"] | None = None  # what interrupted the movie
    details: Annotated[dict[Name, Any], Field(max_length=30)] = {}
    """Times of cue changes and frames and further measurements; at most 16 KiB as JSON."""


class Feedback(Message):
    """Feedback on a familiarization answer: the outcome and the full movie."""

    contact: bool
    correct: bool
    movie: str
    frames: int


class AnswerStored(Message):
    """Acknowledgement of a committed answer. ``duplicate``: it was stored before, same key."""

    duplicate: bool
    feedback: Feedback | None
    state: SessionState


class Event(Message):
    """An event in the browser, such as ``hidden``, ``offline``, ``error`` or ``resized``."""

    kind: Annotated[str, StringConstraints(pattern=r"^[a-z_]{1,40}$")]
    at_ms: Milliseconds
    data: Annotated[dict[Name, bool | int | float | Text | None], Field(max_length=20)] = {}


class Events(Message):
    """Events of one page load.

    ``key`` is drawn by the client per batch and stays the same over retries: a batch with a known
    key is not stored again, and ``stored`` is then 0.
    """

    key: Key | None = None
    events: Annotated[list[Event], Field(max_length=50)]


class Stored(Message):
    """Number of events that were stored."""

    stored: int


class Completion(Message):
    """How the participant gets the credit: a completion code, a URL to go to, or both.

    ``post``: form fields to send to the URL by POST (MTurk); None for a plain link. ``withheld``:
    neither is shown until the experimenter has looked at the session."""

    code: str | None
    url: str | None
    post: dict[str, str] | None = None
    withheld: bool = False


class SessionEnd(Message):
    """End of a session before it was complete."""

    completion: Completion


class Result(Message):
    """Result that a participant sees at the end.

    ``percentile``: percentage of the other participants who finished this scenario with fewer
    correct answers, plus half of the percentage with equally many; 100 for the single best, 0 for
    the single worst. None while fewer than the study's ``percentile_from`` others have finished.
    """

    correct: int
    trials: int
    accuracy: float
    percentile: float | None
    completion: Completion


class Health(Message):
    """Health of the server and its database."""

    ok: bool


class Refusal(Message):
    """Refusal: ``error`` is a code of `REFUSALS`, ``message`` a sentence for people.

    ``completion``: how a participant who is refused because the study is full reports back.
    """

    error: str
    message: str
    state: SessionState | None = None
    completion: Completion | None = None


# What anyone who opens the page may know of a study, sent before a session begins.


class Recruiter(Message):
    """Names of the URL parameters by which one recruiter identifies participants.

    A URL belongs to the first recruiter whose ``id`` parameter or one of whose ``preview``
    parameters it has, else it is a plain link. Parameters named in ``others`` go into
    ``Enter.recruiter`` if present. ``preview``: a URL with one of these values only shows
    information, and no session may begin (MTurk). Any URL may have ``scenario``, ``language`` and
    ``pass``, which are copied into `Enter`.
    """

    source: Source
    id: str
    others: list[str]
    preview: dict[str, str] = Field(default_factory=dict)


class AskedQuestion(Message):
    """A question of the lab; its text has the key ``question.NAME.text``."""

    name: str
    kind: Literal["text", "choice", "choices", "scale"]
    required: bool
    options: list[str]
    steps: int
    picture: str
    """Name of its picture below ``/picture/``; empty: it has none."""


class CheckedQuestion(Message):
    """A question of the comprehension check, without its right answer; its text has the key
    ``comprehension_question.NAME.text``."""

    name: str
    options: list[str]


class PaidAmount(Message):
    """What everyone who finishes receives. ``currency``: a code such as USD, or text."""

    amount: float
    currency: str


class PublicStudy(Message):
    """Settings of the study that anyone who opens the page may see."""

    title: str
    contact: str
    languages: list[str]
    consent_version: str
    consent_files: list[str]
    """Languages in which the consent form can be read as a file, ``/consent/LANGUAGE.pdf``."""
    funders: str
    """Who pays for the study; empty: the consent does not say it."""
    payment: PaidAmount | None
    """None: the consent does not speak of payment."""
    expected_minutes: int
    """Expected duration of a session; 0: the page estimates it."""
    scenarios: list[str]
    id_needed: bool
    min_width: int
    min_height: int
    fullscreen: bool
    cue_ms: int
    flash_hz: float
    break_every: int
    """Number of test trials between two breaks; 0: no breaks."""
    familiarization_feedback: bool
    hold_minutes: int
    """Minutes after which people who find all places taken may come back."""
    preload: int
    """Number of trials whose media are loaded ahead."""
    interrupted: Literal["repeat", "void"]  # see `Plausibility`
    comprehension_questions: list[CheckedQuestion]
    comprehension_limit: int
    """How often the comprehension check can be answered."""
    practice_min_correct: int
    """Right answers needed in the practice; 0: no criterion."""
    questions: list[AskedQuestion]
    """The lab's own questions at the end."""
    example: dict[str, TrialMedia]
    """Media of the animated example in the instructions, by scenario."""
    recruiters: list[Recruiter]
    """In the order in which they are matched against the URL."""
    device_refused: dict[Source, Completion]
    """Completion of participants whose device or browser cannot show the movies."""


# Exception by which the store refuses a participant's request.


class Refused(PhysionError):
    """Refusal of a request, which then has changed nothing.

    Parameters
    ----------
    code
        A key of `REFUSALS`.
    message
        A sentence for people.
    state
        Current state of the session, for the codes after which a client can continue.
    completion
        How the refused participant reports back to the recruiter, if the study says it.
    wait_s
        Seconds after which the same request will be accepted, for ``too_early``.
    """

    def __init__(
        self,
        code: str,
        message: str,
        state: SessionState | None = None,
        completion: Completion | None = None,
        *,
        wait_s: float = 0.0,
    ) -> None:
        assert code in REFUSALS
        super().__init__(message)
        self.wait_s = wait_s
        self.code, self.message, self.state = code, message, state
        self.completion = completion
