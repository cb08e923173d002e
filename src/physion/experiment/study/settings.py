"""The settings of a study: the tables and keys of ``study.toml``, with meaning and allowed values.

Each field below is one key. `core.settings` checks the values strictly when the file is read; the
texts below the fields are the comments in the file and the table of settings in the documentation.

The lab's own questions are tables ``[[questions]]``, the questions of the comprehension check
tables ``[[comprehension_questions]]``, between-subject conditions tables ``[[conditions]]``. Their
texts are in the file of each language (see `texts`).
"""

from __future__ import annotations

import ast
import inspect
import json
import re
import unicodedata
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, fields, is_dataclass
from functools import cache
from itertools import pairwise
from pathlib import Path
from textwrap import wrap
from typing import Annotated, Any, Literal, get_args, get_origin, get_type_hints
from urllib.parse import parse_qs, urlsplit

from pydantic import AfterValidator, Field, StringConstraints

from physion.core.errors import BadInputError
from physion.core.settings import read_settings
from physion.experiment.study.stimuli import NAME

HEAD = """\
# Settings of this study. Texts are in texts/, stimuli in stimuli.csv (which is never served).
# To run it: physion experiment serve FOLDER
"""

# --- allowed values ------------------------------------------------------------------------------

_UNFIT = ("Cc", "Cs", "Zl", "Zp")
"""Unicode categories refused in texts: control characters, surrogates, line and paragraph ends."""


def _one_line(value: str) -> str:
    if any(unicodedata.category(character) in _UNFIT for character in value):
        raise ValueError("must be one line of text without control characters")
    return value


def _matching(pattern: str, allowed: str) -> AfterValidator:
    """Return a check that a text matches a pattern completely."""

    def check(value: str) -> str:
        if not re.fullmatch(pattern, value):
            raise ValueError(f"must be {allowed}")
        return value

    return AfterValidator(check)


def _distinct(values: tuple[str, ...]) -> tuple[str, ...]:
    if len(set(values)) != len(values):
        raise ValueError("must be a list without duplicates")
    return values


def _ascending(ends: tuple[int, int]) -> tuple[int, int]:
    if ends[0] > ends[1]:
        raise ValueError("the smaller number must be first")
    return ends


def _is_pattern(value: str) -> str:
    try:
        re.compile(value)
    except re.error as error:
        raise ValueError(f"must be empty or a regular expression ({error})") from None
    return value


def _address(*needed: str) -> AfterValidator:
    """Return a check for an empty text or an https URL with the query parameters ``needed``."""

    def check(value: str) -> str:
        rest = f" with {' and '.join(needed)} in it" if needed else ""
        try:
            parts = urlsplit(value)
            given = parse_qs(parts.query)
            good = parts.scheme == "https" and bool(parts.hostname)
        except ValueError:
            good = False
        good = good and not re.search(r"[\s\"'<>\\;]", value) and all(n in given for n in needed)
        if value and not good:
            raise ValueError(f"must be empty or a URL that begins with https://{rest}")
        return value

    return AfterValidator(check)


Line = Annotated[
    str,
    StringConstraints(strip_whitespace=True, min_length=1, max_length=200),
    AfterValidator(_one_line),
]
Name = Annotated[
    str, _matching(NAME, "letters, digits and ._+- only, at most 200, the first a letter or digit")
]
Language = Annotated[
    str, _matching(r"[a-z]{2,3}(-[A-Za-z0-9]{2,8})?", "a language such as en or pt-BR")
]
Site = Annotated[
    str,
    _matching(
        r"https://(\*\.)?[A-Za-z0-9]([A-Za-z0-9.-]*[A-Za-z0-9])?(:[0-9]{1,5})?",
        "a site such as https://www.mturk.com, without a path",
    ),
]
Code = Annotated[
    str,
    _matching(r"[A-Za-z0-9_-]{0,100}", "empty or a word of letters, digits, _ and -, at most 100"),
]
Pattern = Annotated[
    str, StringConstraints(max_length=500), AfterValidator(_one_line), AfterValidator(_is_pattern)
]
Picture = Annotated[
    str,
    _matching(r"|[A-Za-z0-9][A-Za-z0-9_-]{0,99}\.png", "empty or the name of a PNG, such as a.png"),
]
Address = Annotated[str, StringConstraints(max_length=1000), _address()]
Word = Annotated[
    str, _matching("[a-z][a-z0-9_]{0,39}", "a word of small letters, digits and _, at most 40")
]
Milliseconds = Annotated[int, Field(ge=0, le=60_000)]
Count = Annotated[int, Field(ge=0, le=100_000)]


# --- tables --------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Timing:
    """Durations within a trial."""

    fixation_ms: Annotated[tuple[Milliseconds, Milliseconds], AfterValidator(_ascending)] = (
        500,
        1500,
    )
    """Shortest and longest duration of the fixation cross, in ms; drawn for each trial, all
    durations equally likely."""
    fixation_in_familiarization: bool = True
    """Whether familiarization trials have a fixation cross (not in the official study)."""
    cue_ms: Milliseconds = 2000
    """Duration of the cue on the first frame, in ms."""
    flash_hz: Annotated[float, Field(ge=0, le=3)] = 2.0
    """Full cycles of the red and yellow cue per second (official: 1); 0: no flashing. More than 3
    could harm people with photosensitive epilepsy."""
    break_every: Count = 25
    """Test trials after which people can rest for as long as they like; 0: no breaks."""


@dataclass(frozen=True)
class Comprehension:
    """Comprehension check after the instructions."""

    attempts: Annotated[int, Field(ge=1, le=100)] = 3
    """How often comprehension_questions (below) can be answered. After a wrong answer the
    instructions are shown again; after the last one the session ends."""


@dataclass(frozen=True)
class Practice:
    """Criterion of the practice."""

    min_correct: Annotated[int, Field(ge=0, le=1000)] = 0
    """Right answers needed in the familiarization; 0: no criterion."""
    repeats: Annotated[int, Field(ge=0, le=20)] = 1
    """How often the practice is repeated with fewer right answers."""
    failed: Literal["end", "flag"] = "end"
    """What happens then: "end" ends the session, "flag" lets it continue and flags it."""


@dataclass(frozen=True)
class Attention:
    """Attention checks among the test trials."""

    instructed: Annotated[int, Field(ge=0, le=100)] = 0
    """Attention checks in the test that say which button to press. Stimuli of the phase attention
    in stimuli.csv, with an obvious outcome, are checks too."""
    max_failed: Annotated[int, Field(ge=0, le=1000)] = 0
    """Sessions with more failed checks than this are flagged."""


@dataclass(frozen=True)
class Screen:
    """In a smaller window participants are asked to enlarge it; telephones are refused."""

    min_width: Annotated[int, Field(ge=320, le=10_000)] = 1024
    """Smallest width of the browser window in CSS pixels."""
    min_height: Annotated[int, Field(ge=320, le=10_000)] = 600
    """Smallest height of the browser window in CSS pixels."""
    fullscreen: bool = False
    """Offer full screen before the trials, and again after it was left."""


@dataclass(frozen=True)
class Plausibility:
    """Sessions that no person can have made, repeated and interrupted movies."""

    server_checks: bool = True
    """Check answers by the server's clock and the media that it sent: an answer before cross, cue
    and movie can have been shown is refused; sessions without media or too short are
    implausible."""
    fast_ms: Annotated[int, Field(ge=0, le=10_000)] = 100
    """Response time in ms under which an answer is too fast for a person."""
    fast_answers: Annotated[int, Field(ge=1, le=100_000)] = 3
    """Number of such answers from which a session is implausible."""
    reading_s: Annotated[float, Field(ge=0, le=3600)] = 10.0
    """A session that took less than all its movies and this many seconds is implausible."""
    max_showings: Annotated[int, Field(ge=1, le=50)] = 2
    """How often a trial may be shown, also after reloading the page; sessions with more are flagged
    as replayed."""
    interrupted: Literal["repeat", "void"] = "repeat"
    """If the page was hidden, the window too small or the question whether to stop open during a
    movie: "repeat" shows the trial again (five times at most), "void" continues and marks the
    answer, which the analysis leaves out."""
    simulated_speed: Annotated[float, Field(ge=1, le=1_000_000)] = 1.0
    """How many times faster than people simulated participants may be (1000 for a quick test)."""


@dataclass(frozen=True)
class Recruitment:
    """Recruitment and completion credit."""

    id_needed: bool = False
    """Refuse participants without an id (of Prolific, SONA or MTurk, or participant=ID in a plain
    link)."""
    prolific_id: Pattern = "[0-9a-fA-F]{24}"
    """Regular expression that ids from Prolific must match completely; empty: any id."""
    sona_id: Pattern = ""
    """The same for SONA's survey codes, e.g. [0-9]{1,7}."""
    mturk_id: Pattern = ""
    """The same for MTurk's worker ids, e.g. A[0-9A-Z]{5,20}."""
    link_id: Pattern = ""
    """The same for participant=ID in a plain link."""
    allow_list: Annotated[
        str, _matching(rf"|{NAME}", "empty or the name of a file in the study folder")
    ] = ""
    """Text file in this folder with the ids that may take part, one per line; empty: all ids."""
    signed_links: Literal["no", "study", "person"] = "no"
    """Whether people enter by any address ("no"), only by the links that physion experiment links
    prints ("study"), or only by a link that it signs for their id ("person", links --ids FILE)."""
    hold_minutes: Annotated[int, Field(ge=1, le=100_000)] = 15
    """The place of an unfinished session is free again after this many minutes without an answer;
    its participant can still finish."""
    prolific_code: Code = ""
    """Prolific's completion code."""
    sona_address: Annotated[
        str, StringConstraints(max_length=1000), _address("experiment_id", "credit_token")
    ] = ""
    """SONA's completion URL, with experiment_id and credit_token."""
    mturk_code: Annotated[
        str,
        _matching(
            r"[A-Za-z0-9_-]{1,100}", "session, or a word of letters, digits, _ and -, at most 100"
        ),
    ] = "session"
    """With "session" each session gets its own code; any other value is the code of all."""
    link_code: Code = ""
    """Completion code for participants who came by a plain link."""
    link_address: Address = ""
    """URL to which these participants are sent at the end."""


@dataclass(frozen=True)
class EarlyEnd:
    """How participants who end without finishing report back to the recruiter."""

    prolific_code: Code = ""
    """Prolific's code for this case."""
    code: Code = ""
    """Code for participants from elsewhere."""
    address: Address = ""
    """URL to which participants from elsewhere are sent."""


@dataclass(frozen=True)
class PaymentRule:
    """What everyone who finishes receives; the consent says it."""

    amount: Annotated[float, Field(ge=0, le=1_000_000)] = 0.0
    """Amount; 0: the consent does not speak of payment."""
    currency: Annotated[
        str, StringConstraints(min_length=1, max_length=40), AfterValidator(_one_line)
    ] = "USD"
    """Currency, by its code such as USD or EUR; or in words, such as credit points."""
    minutes: Annotated[int, Field(ge=0, le=10_000)] = 0
    """Expected duration in minutes, which the consent says in place of an estimate; 0: estimate.
    An amount needs it."""
    least_per_hour: Annotated[float, Field(ge=0, le=1_000_000)] = 0.0
    """Smallest wage per hour; a study whose amount for the expected minutes is less is refused. 0:
    no check."""

    @property
    def per_hour(self) -> float | None:
        """The wage per hour at the expected duration; None without amount or duration."""
        return 60 * self.amount / self.minutes if self.amount and self.minutes else None


@dataclass(frozen=True)
class Bonus:
    """Bonus in the table of payments, for finished sessions."""

    per_correct: Annotated[float, Field(ge=0, le=10_000)] = 0.0
    """Amount in your currency for each counted right answer; 0: no bonus."""
    above: Annotated[float, Field(ge=0, le=1)] = 0.5
    """Fraction of the test trials whose right answers do not count; 0.5 is guessing."""
    most: Annotated[float, Field(ge=0, le=1_000_000)] = 0.0
    """Largest bonus; 0: no limit."""


# --- questions and conditions --------------------------------------------------------------------


@dataclass(frozen=True)
class Question:
    """One question of the lab at the end of a session."""

    name: Word
    """A word of small letters, digits and _: the name of its column in the data."""
    kind: Literal["text", "choice", "choices", "scale"]
    """One of "text", "choice" (of one option), "choices" (of any number) and "scale"."""
    required: bool = False
    """Whether it must be answered."""
    options: Annotated[tuple[Word, ...], Field(max_length=50), AfterValidator(_distinct)] = ()
    """Names of the options of a choice, such as ["never", "often"]."""
    steps: Annotated[int, Field(ge=2, le=11)] = 7
    """Steps of a scale, 2 to 11."""
    picture: Picture = ""
    """Name of a PNG in texts/ that is shown with the question; its description, for people who
    cannot see it, is the text alt."""
    right: Annotated[str, _matching("|[a-z][a-z0-9_]{0,39}", "empty or an option")] = ""
    """For a "choice" with one right answer: that option, which is never sent to the browser. The
    data say who was right in a second column, with _right after the name."""

    @property
    def text_keys(self) -> tuple[str, ...]:
        """Keys of its texts."""
        ends = ["low", "high"] if self.kind == "scale" else []
        ends += ["alt"] if self.picture else []
        options = (f"options.{option}" for option in self.options)
        return tuple(f"question.{self.name}.{key}" for key in ("text", *ends, *options))


@dataclass(frozen=True)
class ComprehensionQuestion:
    """A question with one right answer, asked after the instructions."""

    name: Word
    """A word of small letters, digits and _: its name in the data."""
    options: Annotated[
        tuple[Word, ...], Field(min_length=2, max_length=20), AfterValidator(_distinct)
    ]
    """Names of the options, such as ["red", "yellow"]."""
    right: Word
    """The right option, which is never sent to the browser."""

    @property
    def text_keys(self) -> tuple[str, ...]:
        """Keys of its texts."""
        options = (f"options.{option}" for option in self.options)
        return tuple(f"comprehension_question.{self.name}.{key}" for key in ("text", *options))


@dataclass(frozen=True)
class Condition:
    """A between-subject condition; None: as in the rest of ``study.toml``."""

    name: Annotated[
        str,
        _matching(
            r"[A-Za-z][A-Za-z0-9_-]{0,39}",
            "a word of letters, digits, _ and -, at most 40 characters",
        ),
    ]
    """A word of letters, digits, _ and -: its name in the data, in links and texts."""
    cue_ms: Milliseconds | None = None
    """In place of the key of [timing]."""
    flash_hz: Annotated[float, Field(ge=0, le=3)] | None = None
    """In place of the key of [timing]."""
    break_every: Count | None = None
    """In place of the key of [timing]."""
    familiarization_feedback: bool | None = None
    """In place of the key above: whether familiarization answers get feedback."""
    scenarios: (
        Annotated[tuple[Name, ...], Field(min_length=1), AfterValidator(_distinct)] | None
    ) = None
    """The scenarios of its sessions, such as ["collide_slow"] for movies of its own."""


# --- the whole file ------------------------------------------------------------------------------


@dataclass(frozen=True, kw_only=True)
class StudySettings:
    """All settings of a ``study.toml``."""

    name: Name
    """Short name: letters, digits and ._+- only."""
    version: Line
    """Change it with each change of the study; stored with each session."""
    title: Line
    """Title at the top of the participants' pages."""
    contact: Line
    """Contact for participants: a name and an e-mail address, shown with the consent, the result
    and error messages."""
    scenarios: Annotated[
        tuple[Name, ...], Field(min_length=1, max_length=100), AfterValidator(_distinct)
    ]
    """Scenarios that people can take part in, each with its stimuli in stimuli.csv."""
    languages: Annotated[
        tuple[Language, ...], Field(min_length=1, max_length=100), AfterValidator(_distinct)
    ] = ("en", "de")
    """Languages, each with a file in texts/; the first is the default."""
    consent_version: Line = "1"
    """Stored with each consent; change it with each change of the consent text."""
    funders: Annotated[str, StringConstraints(max_length=300), AfterValidator(_one_line)] = ""
    """Who pays for the study, as in "the NSF (grant 123)"; the consent says it. Empty: it does not
    speak of this."""
    participants: Annotated[int, Field(ge=1, le=1_000_000)] = 100
    """Complete sessions wanted for each scenario; later ones read that the study is full."""
    seed: Annotated[int, Field(ge=0, le=2**63 - 1)] = 0
    """Seed of all trial orders."""
    orders: Count = 0
    """0: an individual trial order for each participant; otherwise the number of prepared orders,
    used least often first (125 in the official study)."""
    exclusions: Literal["preregistered", "preregistered-only", "official-code"] = "preregistered"
    """Rules by which sessions are flagged: "preregistered" (also sessions that the server found
    implausible, replayed, or failing checks), "preregistered-only" (without these), or
    "official-code"."""
    percentile_from: Annotated[int, Field(ge=1, le=1_000_000)] = 10
    """Number of other finished participants needed before a percentile is shown."""
    preload: Annotated[int, Field(ge=1, le=1000)] = 8
    """Number of trials loaded ahead."""
    familiarization_feedback: bool = True
    """Whether familiarization answers get feedback: the outcome and the full movie. Without it,
    change the texts that speak of it."""
    demographics: bool = True
    """Ask age, gender and education at the end."""
    embed_from: Annotated[tuple[Site, ...], Field(max_length=100), AfterValidator(_distinct)] = ()
    """Sites that may show the pages in a frame (MTurk: https://www.mturk.com); usually none."""
    timing: Timing = Timing()
    comprehension: Comprehension = Comprehension()
    practice: Practice = Practice()
    attention: Attention = Attention()
    screen: Screen = Screen()
    plausibility: Plausibility = Plausibility()
    recruitment: Recruitment = Recruitment()
    declined: EarlyEnd = EarlyEnd()
    """For participants who do not consent."""
    stopped: EarlyEnd = EarlyEnd()
    """For participants who stop; they learn the code, so it should not pay in full."""
    screened_out: EarlyEnd = EarlyEnd()
    """For participants who failed the comprehension check or the practice."""
    device_refused: EarlyEnd = EarlyEnd()
    """For participants whose device or browser cannot show the movies."""
    full: EarlyEnd = EarlyEnd()
    """For participants who come when the study is full."""
    payment: PaymentRule = PaymentRule()
    bonus: Bonus = Bonus()
    comprehension_questions: Annotated[tuple[ComprehensionQuestion, ...], Field(max_length=50)] = ()
    """Questions about the instructions: one table [[comprehension_questions]] for each, with the
    keys below. Their texts are in texts/: [comprehension_question.NAME] with text, and
    [comprehension_question.NAME.options] with a label for each option."""
    questions: Annotated[tuple[Question, ...], Field(max_length=50)] = ()
    """Your own questions at the end: one table [[questions]] for each, with the keys below. Their
    texts are in texts/: [question.NAME] with text and, for a scale, low and high, the labels of
    its ends; [question.NAME.options] with a label for each option."""
    conditions: Annotated[tuple[Condition, ...], Field(max_length=50)] = ()
    """Between-subject conditions: one table [[conditions]] for each, with a name and those keys
    below that differ from the study. A new session gets the condition with the fewest sessions.
    Texts of a condition are in texts/: [condition.NAME.trial] with prompt = "..." is its
    question."""


EARLY_ENDS = tuple(f.name for f in fields(StudySettings) if isinstance(f.default, EarlyEnd))
"""The tables of ``study.toml`` that are an `EarlyEnd`."""


# --- the study in the paper, and the mental rotation of its preregistration ----------------------

MENTAL_ROTATION = Question(
    "mental_rotation",
    "choice",
    options=("a", "b", "c", "d"),
    picture="mental_rotation.png",
    right="c",
)
"""One item: a figure of cubes, and four of which one is the same figure, turned. Picture and texts
ship with the package (drawn by docs/mental_rotation.py)."""

SHIPPED = {MENTAL_ROTATION.name: MENTAL_ROTATION}
"""Questions whose pictures and texts ship with the package, by name."""

PAPER: Mapping[str, Any] = {
    "timing": Timing(fixation_in_familiarization=False, break_every=0),
    "exclusions": "preregistered-only",
    "payment": PaymentRule(amount=4.0, currency="USD", minutes=20, least_per_hour=12.0),
    "questions": (MENTAL_ROTATION,),
}
"""What differs from the defaults, by the field of `StudySettings`: as the paper and its
preregistration say, test trials follow without rest, people are paid $4, which corresponds to $12
per hour, only preregistered rules exclude sessions, and one item of spatial reasoning is asked."""


def parse_settings(content: Mapping[str, Any], path: Path) -> StudySettings:
    """Check the parsed ``content`` of a ``study.toml``; ``path`` names the file in errors.

    Raises
    ------
    BadInputError
        A value is not allowed, a key is missing or unknown, or keys do not fit together. The
        message names the file, the key, and the allowed values or the closest known key.
    """
    try:
        settings = read_settings(StudySettings, content, "")
        for fault in _faults(settings):
            raise BadInputError(fault)
    except BadInputError as error:
        raise BadInputError(f"{path}: {str(error).lstrip('.: ')}") from None
    return settings


MAX_TEXTS = 9
"""Questions for a text, so that all answers fit into one request."""
RESERVED = ("participant", "participant_id", "session", "session_id", "scenario", "simulated",
            "phase", "trial", "number", "stimulus", "kind")  # fmt: skip
"""Names of columns of the export, which no question may have."""


def _faults(settings: StudySettings) -> Iterator[str]:
    """Yield what does not fit together in settings whose values are allowed one by one."""
    yield from _payment_faults(settings.payment)
    taken: set[str] = set(RESERVED)
    for question in settings.questions:
        name, chosen = question.name, question.kind in ("choice", "choices")
        if chosen and len(question.options) < 2:
            yield (f"the question {name} needs options, at least two, as it is of the kind "
                   f"{question.kind}")  # fmt: skip
        if question.right and (question.kind != "choice" or question.right not in question.options):
            yield (f"the question {name} has the right answer {question.right}, which is not "
                   "an option of it as a choice")  # fmt: skip
        if not chosen and question.options:
            yield (f"the question {name} has options; only choice and choices have some, not "
                   f"{question.kind}")  # fmt: skip
        for column in columns_of(question):
            if column in taken:
                yield (f"the question {name} would make a second column {column} in the data; "
                       "choose another name")  # fmt: skip
            taken.add(column)
    if sum(question.kind == "text" for question in settings.questions) > MAX_TEXTS:
        yield f"at most {MAX_TEXTS} questions can be of the kind text"
    names = [question.name for question in settings.comprehension_questions]
    for checked in settings.comprehension_questions:
        where = f"the comprehension question {checked.name}"
        if checked.right not in checked.options:
            yield f"{where} has the right answer {checked.right}, which is not an option of it"
        if names.count(checked.name) > 1:
            yield f"{where} exists twice; give one of them another name"
    names = [condition.name for condition in settings.conditions]
    if len(names) == 1:
        yield "[[conditions]] needs at least two conditions"
    for condition in settings.conditions:
        if names.count(condition.name) > 1:
            yield f"two conditions are called {condition.name}"
        for scenario in condition.scenarios or ():
            if scenario not in settings.scenarios:
                yield (f"the condition {condition.name} has the scenario {scenario}, which is not "
                       "in scenarios")  # fmt: skip


def _payment_faults(payment: PaymentRule) -> Iterator[str]:
    """Yield what does not fit together in the payment."""
    if (payment.amount or payment.least_per_hour) and not payment.minutes:
        yield "payment.amount needs payment.minutes, the time that it is for"
    elif (payment.per_hour or 0) < payment.least_per_hour:
        yield (f"payment.amount is {payment.amount:g} {payment.currency} for {payment.minutes} "
               f"minutes, {payment.per_hour or 0:.2f} per hour: less than payment.least_per_hour, "
               f"{payment.least_per_hour:g}")  # fmt: skip


# --- writing and describing ----------------------------------------------------------------------


def keys_of(kind: type) -> dict[str, str]:
    """Return the descriptions of a settings class' keys, without its tables and lists of tables."""
    about, tables = _descriptions(kind), _table_classes(kind)
    return {field.name: about[field.name] for field in fields(kind) if field.name not in tables}


def tables() -> list[tuple[str, str, type]]:
    """Return name, description and class of the tables and lists of tables of ``study.toml``."""
    about = _descriptions(StudySettings)
    return [
        (name, about.get(name) or str(kind.__doc__), kind)
        for name, kind in _table_classes(StudySettings).items()
    ]


@cache
def _descriptions(kind: type) -> Mapping[str, str]:
    """Return the text below each field of a class, on one line."""
    (made,) = ast.parse(inspect.getsource(kind)).body
    assert isinstance(made, ast.ClassDef)
    found = {}
    for field, text in pairwise(made.body):
        if isinstance(field, ast.AnnAssign) and isinstance(text, ast.Expr):
            found[ast.unparse(field.target)] = " ".join(ast.literal_eval(text.value).split())
    return found


@cache
def _table_classes(kind: type) -> Mapping[str, type]:
    """Return the classes of those fields that are tables or lists of tables, by name."""
    found = {}
    for name, hint in get_type_hints(kind).items():
        item = get_args(hint)[0] if get_origin(hint) is tuple else hint
        if is_dataclass(item) and isinstance(item, type):
            found[name] = item
    return found


def format_settings(settings: StudySettings, path: Path) -> str:
    """Return the content of a ``study.toml`` with all keys and their descriptions as comments.

    Raises `BadInputError`, naming ``path`` and the key, if `parse_settings` would refuse it.
    """
    parse_settings(plain_settings(settings), path)
    text = HEAD + _keys(settings, keys_of(StudySettings))
    for name, about, kind in tables():
        value, keys = getattr(settings, name), keys_of(kind)
        if isinstance(value, tuple):
            text += "\n" + _comment(about)
            text += "".join(_comment(about, f"  {key}: ") for key, about in keys.items())
            for entry in value:
                given = [key for key in keys if getattr(entry, key) is not None]
                lines = (f"{key} = {_toml(getattr(entry, key))}\n" for key in given)
                text += f"\n[[{name}]]\n{''.join(lines)}"
        else:
            text += f"\n{_comment(about)}[{name}]\n{_keys(value, keys)}"
    return text


def plain_settings(settings: StudySettings) -> dict[str, Any]:
    """Return the settings as nested dictionaries and lists, without keys whose value is None."""

    def plain(value: Any) -> Any:
        if is_dataclass(value):
            return {f.name: plain(getattr(value, f.name)) for f in fields(value)
                    if getattr(value, f.name) is not None}  # fmt: skip
        return [plain(one) for one in value] if isinstance(value, tuple) else value

    return {f.name: plain(getattr(settings, f.name)) for f in fields(StudySettings)}


def _keys(values: Any, keys: Mapping[str, str]) -> str:
    """Return lines with comment and value of each key."""
    return "".join(
        f"{_comment(about)}{key} = {_toml(getattr(values, key))}\n" for key, about in keys.items()
    )


def _comment(text: str, first: str = "") -> str:
    lines = wrap(first + text, 98, subsequent_indent="    " if first else "",
                 break_on_hyphens=False)  # fmt: skip
    return "".join(f"# {line}\n" for line in lines)


def _toml(value: Any) -> str:
    """Return a value in TOML syntax."""
    if isinstance(value, tuple):
        return f"[{', '.join(_toml(one) for one in value)}]"
    # Texts have no control characters, so their JSON strings are valid TOML strings.
    return json.dumps(value, ensure_ascii=False)


# --- answers to questions ------------------------------------------------------------------------

MAX_LENGTH = 2000
"""Characters of an answer that is a text."""
Answer = str | int | list[str] | None
"""An answer to a question of the lab; None: none was given."""


def columns_of(question: Question) -> tuple[str, ...]:
    """Return the columns of a question in the exported data: of ``choices``, one per option; one
    more if it has a right answer."""
    if question.kind != "choices":
        return (question.name, *((f"{question.name}_right",) if question.right else ()))
    return tuple(f"{question.name}_{option}" for option in question.options)


def check_answers(questions: Sequence[Question], given: Mapping[str, Any]) -> dict[str, Answer]:
    """Return the valid answers to all questions.

    Raises ``ValueError`` with the name of the first question whose answer is missing or invalid,
    or that does not exist.
    """
    names = {question.name for question in questions}
    for name in given:
        if name not in names:
            raise ValueError(f"{name[:40]!a} is not a question")
    answers: dict[str, Answer] = {}
    for question in questions:
        if question.name not in given:
            raise ValueError(f"{question.name} is missing")
        try:
            answer = _CHECKS[question.kind](question, given[question.name])
        except ValueError as error:
            raise ValueError(f"{question.name}: {error}") from None
        if question.required and answer in (None, []):
            raise ValueError(f"{question.name}: an answer is required")
        answers[question.name] = answer
    return answers


def _check_text(question: Question, value: Any) -> str | None:
    if value is not None and (not isinstance(value, str) or len(value) > MAX_LENGTH):
        raise ValueError(f"text of at most {MAX_LENGTH} characters, or null")
    return (value or "").strip() or None


def _check_choice(question: Question, value: Any) -> str | None:
    if value is not None and value not in question.options:
        raise ValueError(f"one of {', '.join(question.options)}, or null")
    return None if value is None else str(value)


def _check_choices(question: Question, value: Any) -> list[str]:
    known = isinstance(value, list) and all(one in question.options for one in value)
    if not known or len(set(value)) != len(value):
        raise ValueError(f"a list with any of {', '.join(question.options)}")
    return [option for option in question.options if option in value]


def _check_scale(question: Question, value: Any) -> int | None:
    if value is None:
        return None
    if type(value) is not int or not 1 <= value <= question.steps:
        raise ValueError(f"a whole number from 1 to {question.steps}, or null")
    return value


_CHECKS = {
    "text": _check_text,
    "choice": _check_choice,
    "choices": _check_choices,
    "scale": _check_scale,
}


def check_attempt(
    questions: Sequence[ComprehensionQuestion], given: Mapping[str, Any]
) -> dict[str, str]:
    """Return the answers of an attempt, one option for each question.

    Raises ``ValueError`` with the name of a question that is unknown, or whose answer is missing or
    no option of it.
    """
    for name in given:
        if name not in {question.name for question in questions}:
            raise ValueError(f"{name[:40]!a} is not a question")
    for question in questions:
        if given.get(question.name) not in question.options:
            raise ValueError(f"{question.name}: one of {', '.join(question.options)}")
    return {question.name: str(given[question.name]) for question in questions}


WITHOUT_FEEDBACK = ("instructions.answer", "ready.text")
"""Texts that speak of feedback, which a condition without it must replace."""


def condition_text_keys(conditions: Sequence[Condition]) -> tuple[str, ...]:
    """Return the keys of texts that conditions need: of those without feedback, about practice."""
    return tuple(
        f"condition.{condition.name}.{key}"
        for condition in conditions
        if condition.familiarization_feedback is False
        for key in WITHOUT_FEEDBACK
    )
