"""The tables of ``study.toml``, one dataclass each with the defaults of its keys."""

from __future__ import annotations

import json
import re
import tomllib
import unicodedata
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from urllib.parse import parse_qs, urlsplit

from physion.core.errors import BadInputError, UnknownNameError
from physion.experiment.study.stimuli import NAME as StimuliNAME


@dataclass(frozen=True)
class Timing:
    """Durations within a trial.

    Attributes
    ----------
    fixation_ms
        Shortest and longest duration of the fixation cross; drawn uniformly for each trial.
    fixation_in_familiarization
        Whether familiarization trials have a fixation cross too.
    cue_ms
        Duration of the cue on the first frame.
    flash_hz
        Full cycles (on and off) of the cue per second; 1 in the official study.
    break_every
        Number of test trials after which people can rest for as long as they like; 0: no breaks.
    """

    fixation_ms: tuple[int, int] = (500, 1500)
    fixation_in_familiarization: bool = True
    cue_ms: int = 2000
    flash_hz: float = 2.0
    break_every: int = 25


@dataclass(frozen=True)
class Blocks:
    """Several scenarios in one session, one block each.

    Attributes
    ----------
    all_scenarios
        Whether a session runs through all scenarios of the study, in an order of its own.
    familiarization
        ``each``: every block begins with the familiarization trials of its scenario; ``first``: the
        first block alone does.
    trials
        Number of test trials of a block, drawn anew for each session with as many of either outcome
        as possible; 0: all test trials of the scenario.
    """

    all_scenarios: bool = False
    familiarization: str = "each"
    trials: int = 0


@dataclass(frozen=True)
class Comprehension:
    """The comprehension check after the instructions.

    ``attempts``: how often its questions can be answered before the session ends.
    """

    attempts: int = 3


@dataclass(frozen=True)
class Practice:
    """The criterion of the familiarization of a session, or of each block.

    Attributes
    ----------
    min_correct
        Number of right answers that are needed; 0: no criterion.
    repeats
        How often the practice is repeated with fewer.
    failed
        What happens then: ``end`` ends the session, ``flag`` goes on and flags it.
    """

    min_correct: int = 0
    repeats: int = 1
    failed: str = "end"


@dataclass(frozen=True)
class Attention:
    """Attention checks among the test trials, besides the stimuli of the phase ``attention``.

    Attributes
    ----------
    instructed
        Number of checks (in each block) after whose movie the page says which button to press.
    max_failed
        Number of failed checks of either kind up to which a session is not flagged.
    """

    instructed: int = 0
    max_failed: int = 0


@dataclass(frozen=True)
class Screen:
    """Smallest browser window in which participants may take part, in CSS pixels.

    ``fullscreen``: whether full screen is offered before the trials, and again after it was left.
    """

    min_width: int = 1024
    min_height: int = 600
    fullscreen: bool = False


@dataclass(frozen=True)
class Plausibility:
    """What a session must keep to, to be one of a person, and what interrupts a trial.

    Attributes
    ----------
    server_checks
        Whether answers are checked against the server's clock and the media that it sent: they are
        refused before fixation cross, cue and movie can have been shown.
    fast_ms, fast_answers
        Response time under which an answer is too fast, and the number of such answers from which a
        session is implausible (a person may press by anticipation now and then).
    reading_s
        Shortest time in seconds for all pages together; less, with all movies, is implausible.
    max_showings
        How often a trial may be shown, over all loads of the page; sessions with more are flagged.
    interrupted
        What happens when, during cue or movie, the page is hidden, the window too small, or the
        question whether to stop open: ``repeat`` shows the trial again (five times at most),
        ``void`` goes on and marks the answer, which the analysis leaves out.
    simulated_speed
        How many times faster than people simulated participants may be.
    """

    server_checks: bool = True
    fast_ms: int = 100
    fast_answers: int = 3
    reading_s: float = 10.0
    max_showings: int = 2
    interrupted: str = "repeat"
    simulated_speed: float = 1.0


@dataclass(frozen=True)
class Recruitment:
    """Settings of recruitment and completion credit.

    Attributes
    ----------
    id_needed
        Whether participants without an id are refused.
    prolific_id, sona_id, mturk_id, link_id
        Regular expression that ids from this recruiter must match completely; empty: any id.
    allow_list
        Name of a text file in the study folder with all ids that may take part; empty: any.
    signed_links
        ``no``: anyone who has the address may enter; ``study``: only by a link that
        `recruitment.links` signed for a recruiter; ``person``: only by a link signed for the id.
    hold_minutes
        Time without an answer or page after which the place of an unfinished session is given to
        somebody else.
    prolific_code
        Prolific's completion code, also part of the completion URL.
    sona_address
        SONA's completion URL with ``experiment_id`` and ``credit_token``; the survey code is
        appended.
    mturk_code
        ``session``: each session gets its own code. Any other value is the code of all sessions.
    link_code, link_address
        Completion code and URL for participants who came by a plain link.
    """

    id_needed: bool = False
    prolific_id: str = "[0-9a-fA-F]{24}"
    sona_id: str = ""
    mturk_id: str = ""
    link_id: str = ""
    allow_list: str = ""
    signed_links: str = "no"
    hold_minutes: int = 15
    prolific_code: str = ""
    sona_address: str = ""
    mturk_code: str = "session"
    link_code: str = ""
    link_address: str = ""


@dataclass(frozen=True)
class EarlyEnd:
    """How participants who end without finishing report back to the recruiter.

    Attributes
    ----------
    prolific_code
        Prolific's code for this case, also part of the completion URL.
    code, address
        Code and URL for participants from elsewhere.
    """

    prolific_code: str = ""
    code: str = ""
    address: str = ""


@dataclass(frozen=True)
class Bonus:
    """Bonus of finished sessions: ``per_correct`` for each right test answer beyond a fraction.

    Attributes
    ----------
    per_correct
        Amount in the lab's currency for each counted answer; 0: no bonus.
    above
        Fraction of the test trials whose right answers do not count, such as 0.5 for guessing.
    most
        Largest bonus; 0: no limit.
    """

    per_correct: float = 0.0
    above: float = 0.5
    most: float = 0.0


@dataclass(frozen=True)
class Limits:
    """Rate limits (token buckets).

    Attributes
    ----------
    requests_per_second, burst
        Sustained rate and burst size of the requests of one session.
    sessions_per_minute, sessions_at_once
        Sustained rate and burst size of new sessions from one IP address, which a whole class may
        share.
    """

    requests_per_second: float = 20.0
    burst: int = 100
    sessions_per_minute: float = 60.0
    sessions_at_once: int = 200


ALL_SCENARIOS = "all scenarios"
"""In place of a scenario: a session of all scenarios. No scenario can have this name."""
EARLY_ENDS = ("declined", "stopped", "screened_out", "device_refused", "full")
"""The tables of ``study.toml`` that are an `EarlyEnd`."""


# The keys of ``study.toml``: meaning and allowed values of each.
#
# A check is a function from the value in the file to the value in `Study`. It raises
# ``ValueError`` with a description of the allowed values.

Check = Callable[[Any], Any]
_UNFIT = ("Cc", "Cs", "Zl", "Zp")
"""Unicode categories refused in texts: control characters, surrogates, line and paragraph ends."""
LANGUAGE = r"[a-z]{2,3}(-[A-Za-z0-9]{2,8})?"
"""Pattern of language codes as in HTML: en, de, pt-BR."""


NO_CONTACT = "(name and e-mail address: fill in contact in study.toml)"
"""Placeholder for ``contact`` in a new study."""
EXCLUSIONS = ("preregistered", "official-code")
"""Names in `physion.analysis.people.exclusions.RULE_SETS`, repeated since its import is slow."""


@dataclass(frozen=True)
class Key:
    """One key of ``study.toml``: its table (empty: top level), check and comment (``about``)."""

    table: str
    name: str
    check: Check
    about: str
    required: bool = False


def text(most: int, least: int = 0) -> Check:
    """Return a check for one line of text of ``least`` to ``most`` characters."""
    allowed = f"one line of text of {least} to {most} characters"

    def check(value: Any) -> str:
        if not isinstance(value, str) or not least <= len(value.strip()) <= most:
            raise ValueError(allowed)
        if any(unicodedata.category(character) in _UNFIT for character in value):
            raise ValueError(f"{allowed}, without control characters")
        return value.strip()

    return check


def pattern(regex: str, allowed: str) -> Check:
    """Return a check for a text that matches ``regex`` completely."""

    def check(value: Any) -> str:
        if not isinstance(value, str) or not re.fullmatch(regex, value):
            raise ValueError(allowed)
        return value

    return check


def whole(low: int, high: int) -> Check:
    """Return a check for an integer between two inclusive bounds; booleans are refused."""

    def check(value: Any) -> int:
        if type(value) is not int or not low <= value <= high:
            raise ValueError(f"a whole number from {low} to {high}")
        return value

    return check


def number(low: float, high: float) -> Check:
    """Return a check for a number between two inclusive bounds."""

    def check(value: Any) -> float:
        if type(value) not in (int, float) or not low <= value <= high:
            raise ValueError(f"a number from {low:g} to {high:g}")
        return float(value)

    return check


def flag(value: Any) -> bool:
    """Check a boolean."""
    if not isinstance(value, bool):
        raise ValueError("true or false")
    return value


def listed(each: Check, least: int, most: int = 100) -> Check:
    """Return a check for a list without duplicates, each element checked by ``each``."""

    def check(value: Any) -> tuple[Any, ...]:
        if not isinstance(value, list | tuple) or not least <= len(value) <= most:
            raise ValueError(f"a list of {least} to {most} values in [ ]")
        result: list[Any] = []
        for one in value:
            try:
                result.append(each(one))
            except ValueError as error:
                raise ValueError(f"a list in which each value is {error}") from None
        if len(set(result)) != len(result):
            raise ValueError("a list without duplicates")
        return tuple(result)

    return check


def regex(value: Any) -> str:
    """Check an empty text or a regular expression."""
    line = str(text(500)(value))
    try:
        re.compile(line)
    except re.error as error:
        raise ValueError(f"empty or a regular expression ({error})") from None
    return line


def one_of(*allowed: str) -> Check:
    """Return a check for one of several texts."""

    def check(value: Any) -> str:
        if value not in allowed:
            raise ValueError(" or ".join(allowed))
        return str(value)

    return check


def span(value: Any) -> tuple[int, int]:
    """Check a range in milliseconds: two integers, the smaller first."""
    allowed = "two whole numbers of milliseconds from 0 to 60000, the smaller first"
    if not isinstance(value, list | tuple) or len(value) != 2:
        raise ValueError(allowed)
    if any(type(end) is not int for end in value) or not 0 <= value[0] <= value[1] <= 60_000:
        raise ValueError(allowed)
    return int(value[0]), int(value[1])


def address(*needed: str) -> Check:
    """Return a check for an empty text or an https URL with the query parameters ``needed``."""
    rest = f" with {' and '.join(needed)} in it" if needed else ""

    def check(value: Any) -> str:
        allowed = f"empty or a URL that begins with https://{rest}"
        line = str(text(1000)(value))
        if not line:
            return ""
        try:
            parts = urlsplit(line)
            given = parse_qs(parts.query)
        except ValueError:
            raise ValueError(allowed) from None
        good = parts.scheme == "https" and parts.hostname and not re.search(r"[\s\"'<>\\;]", line)
        if not good or any(name not in given for name in needed):
            raise ValueError(allowed)
        return line

    return check


_name = pattern(
    StimuliNAME, "letters, digits and ._+- only, at most 200, the first a letter or digit"
)
_code = pattern(r"[A-Za-z0-9_-]{0,100}", "empty or a word of letters, digits, _ and -, at most 100")
_site = pattern(
    r"https://(\*\.)?[A-Za-z0-9]([A-Za-z0-9.-]*[A-Za-z0-9])?(:[0-9]{1,5})?",
    "a site such as https://www.mturk.com, without a path",
)


_EARLY_ENDS = {
    "declined": "For participants who do not consent.",
    "stopped": "For participants who stop; they learn the code, so it should not pay in full.",
    "screened_out": "For participants who failed the comprehension check or the practice.",
    "device_refused": "For participants whose device or browser cannot show the movies.",
    "full": "For participants who come when the study is full.",
}


def _rules(value: Any) -> str:
    if value not in EXCLUSIONS:
        raise ValueError(" or ".join(EXCLUSIONS))
    return str(value)


def _early_end(table: str) -> tuple[Key, ...]:
    """Return the keys of a way to end without finishing."""
    return (
        Key(table, "prolific_code", _code, "Prolific's code for this case."),
        Key(table, "code", _code, "Code for participants from elsewhere."),
        Key(table, "address", address(), "URL to which participants from elsewhere are sent."),
    )


KEYS: tuple[Key, ...] = (
    Key("", "name", _name, "Short name: letters, digits and ._+- only.", required=True),
    Key("", "version", text(100, 1),
        "Change it with each change of the study; stored with each session.", required=True),
    Key("", "title", text(200, 1), "Title at the top of the participants' pages.", required=True),
    Key("", "contact", text(500, 1),
        "Contact for participants: a name and an e-mail address, shown with the consent, the\n"
        "result and error messages.",
        required=True),
    Key("", "scenarios", listed(_name, 1),
        "Scenarios that people can take part in, each with its stimuli in stimuli.csv.",
        required=True),
    Key("", "languages", listed(pattern(LANGUAGE, "a language such as en or pt-BR"), 1),
        "Languages, each with a file in texts/; the first is the default."),
    Key("", "consent_version", text(100, 1),
        "Stored with each consent; change it with each change of the consent text."),
    Key("", "participants", whole(1, 1_000_000),
        "Complete sessions wanted for each scenario; later participants are told that it is full."),
    Key("", "seed", whole(0, 2**63 - 1), "Seed of all trial orders."),
    Key("", "orders", whole(0, 100_000),
        "0: an individual trial order for each participant; otherwise the number of prepared\n"
        "orders, used least often first (125 in the official study)."),
    Key("", "exclusions", _rules,
        f"Rules by which sessions are flagged: {', '.join(EXCLUSIONS)}."),
    Key("", "percentile_from", whole(1, 1_000_000),
        "Number of other finished participants needed before a percentile is shown."),
    Key("", "preload", whole(1, 1000), "Number of trials loaded ahead."),
    Key("", "familiarization_feedback", flag,
        "Whether familiarization answers get feedback: the outcome and the full movie. Without\n"
        "it, change the texts that speak of it."),
    Key("", "demographics", flag, "Ask age, gender and education at the end."),
    Key("", "embed_from", listed(_site, 0),
        "Sites that may show the pages in a frame (MTurk: https://www.mturk.com); usually none."),
    Key("timing", "fixation_ms", span,
        "Shortest and longest duration of the fixation cross, in ms."),
    Key("timing", "fixation_in_familiarization", flag,
        "Whether familiarization trials have a fixation cross (not in the official study)."),
    Key("timing", "cue_ms", whole(0, 60_000), "Duration of the cue on the first frame, in ms."),
    Key("timing", "flash_hz", number(0, 3),
        "Full cycles of the red and yellow cue per second (official: 1); 0: no flashing.\n"
        "More than 3 could harm people with photosensitive epilepsy."),
    Key("timing", "break_every", whole(0, 100_000),
        "Test trials after which people can rest for as long as they like; 0: no breaks."),
    Key("blocks", "all_scenarios", flag,
        "Whether a session runs through all scenarios, one block each, in an order of its own;\n"
        "all orders are used about equally often. false: a session has one scenario."),
    Key("blocks", "familiarization", one_of("each", "first"),
        "\"each\": every block begins with the familiarization trials of its scenario;\n"
        "\"first\": the first block alone does."),
    Key("blocks", "trials", whole(0, 100_000),
        "Test trials of a block, drawn for each session, half of them with contact; 0: all."),
    Key("comprehension", "attempts", whole(1, 100),
        "How often comprehension_questions (below) can be answered. After\n"
        "a wrong answer the instructions are shown again; after the last one the session ends."),
    Key("practice", "min_correct", whole(0, 1000),
        "Right answers needed in the familiarization (of each block); 0: no criterion."),
    Key("practice", "repeats", whole(0, 20),
        "How often the practice is repeated with fewer right answers."),
    Key("practice", "failed", one_of("end", "flag"),
        "What happens then: \"end\" ends the session, \"flag\" goes on and flags it."),
    Key("attention", "instructed", whole(0, 100),
        "Attention checks in the test (of each block) that say which button to press. Stimuli of\n"
        "the phase attention in stimuli.csv, with an obvious outcome, are checks too."),
    Key("attention", "max_failed", whole(0, 1000),
        "Sessions with more failed checks than this are flagged."),
    Key("screen", "min_width", whole(320, 10_000), "Smallest browser window, in CSS pixels."),
    Key("screen", "min_height", whole(320, 10_000), ""),
    Key("screen", "fullscreen", flag,
        "Offer full screen before the trials, and again after it was left."),
    Key("plausibility", "server_checks", flag,
        "Check answers by the server's clock and the media that it sent: an answer before cross,\n"
        "cue and movie can have been shown is refused; sessions without media or too short are\n"
        "implausible."),
    Key("plausibility", "fast_ms", whole(0, 10_000),
        "Response time in ms under which an answer is too fast for a person."),
    Key("plausibility", "fast_answers", whole(1, 100_000),
        "Number of such answers from which a session is implausible."),
    Key("plausibility", "reading_s", number(0, 3600),
        "A session that took less than all its movies and this many seconds is implausible."),
    Key("plausibility", "max_showings", whole(1, 50),
        "How often a trial may be shown, also after reloading the page; sessions with more are\n"
        "flagged as replayed."),
    Key("plausibility", "interrupted", one_of("repeat", "void"),
        "If the page was hidden, the window too small or the question whether to stop open\n"
        "during a movie: \"repeat\" shows the trial again (five times at most), \"void\" goes on\n"
        "and marks the answer, which the analysis leaves out."),
    Key("plausibility", "simulated_speed", number(1, 1_000_000),
        "How many times faster than people simulated participants may be (1000 for a quick test)."),
    Key("recruitment", "id_needed", flag,
        "Refuse participants without an id (of Prolific, SONA or MTurk, or participant=ID in a\n"
        "plain link)."),
    Key("recruitment", "prolific_id", regex,
        "Regular expression that ids from Prolific must match completely; empty: any id."),
    Key("recruitment", "sona_id", regex, "The same for SONA's survey codes, e.g. [0-9]{1,7}."),
    Key("recruitment", "mturk_id", regex, "The same for MTurk's worker ids, e.g. A[0-9A-Z]{5,20}."),
    Key("recruitment", "link_id", regex, "The same for participant=ID in a plain link."),
    Key("recruitment", "allow_list", pattern(
        rf"|{StimuliNAME}", "empty or the name of a file in the study folder"),
        "Text file in this folder with the ids that may take part, one a line; empty: all ids."),
    Key("recruitment", "signed_links", one_of("no", "study", "person"),
        "\"study\": people enter only by the links that physion experiment links prints;\n"
        "\"person\": only by a link that it signs for their id (links --ids FILE); \"no\": by any\n"
        "address."),
    Key("recruitment", "hold_minutes", whole(1, 100_000),
        "The place of an unfinished session is free again after this many minutes without an\n"
        "answer; its participant can still finish."),
    Key("recruitment", "prolific_code", _code, "Prolific's completion code."),
    Key("recruitment", "sona_address", address("experiment_id", "credit_token"),
        "SONA's completion URL, with experiment_id and credit_token."),
    Key("recruitment", "mturk_code", pattern(
        r"[A-Za-z0-9_-]{1,100}", "session, or a word of letters, digits, _ and -, at most 100"),
        "\"session\": each session gets its own code; any other value is the code of all."),
    Key("recruitment", "link_code", _code,
        "Completion code for participants who came by a plain link."),
    Key("recruitment", "link_address", address(),
        "URL to which these participants are sent at the end."),
    *(key for table in _EARLY_ENDS for key in _early_end(table)),
    Key("bonus", "per_correct", number(0, 10_000),
        "Amount in your currency for each counted right answer; 0: no bonus."),
    Key("bonus", "above", number(0, 1),
        "Fraction of the test trials whose right answers do not count; 0.5 is guessing."),
    Key("bonus", "most", number(0, 1_000_000), "Largest bonus; 0: no limit."),
    Key("limits", "requests_per_second", number(0.1, 10_000),
        "Sustained rate of requests of one session."),
    Key("limits", "burst", whole(1, 100_000), "Burst of requests of one session."),
    Key("limits", "sessions_per_minute", number(0.1, 100_000),
        "Sustained rate of new sessions from one IP address."),
    Key("limits", "sessions_at_once", whole(1, 100_000),
        "Burst of new sessions from one IP address, such as a class in one room."),
)  # fmt: skip
"""All keys in the order in which they are written."""

TABLES = {
    "timing": "Durations within a trial.",
    "blocks": "Several scenarios in one session.",
    "comprehension": "Comprehension check after the instructions.",
    "practice": "Criterion of the practice.",
    "attention": "Attention checks among the test trials.",
    "screen": "In a smaller window participants are asked to enlarge it; telephones are refused.",
    "plausibility": "Sessions that no person can have made, repeated and interrupted movies.",
    "recruitment": "Recruitment and completion credit.",
    **_EARLY_ENDS,
    "bonus": "Bonus in the table of payments, for finished sessions.",
    "limits": "Rate limits; requests beyond them are refused for a while.",
}
"""Tables of ``study.toml`` and the comment above each."""


# Reading and writing of ``study.toml``: parsing, checking, and output with comments.

MOST_ENTRIES = 50
"""Tables of one list."""
HEAD = """\
# Settings of this study. Texts are in texts/, stimuli in stimuli.csv (which is never served).
# To run it: physion experiment serve FOLDER
"""


def parse_toml(path: Path, content: bytes) -> dict[str, Any]:
    """Parse the content of a TOML file that was read from ``path``."""
    try:
        return tomllib.loads(content.decode())
    except (ValueError, RecursionError) as error:
        raise BadInputError(f"{path} is not TOML: {error}") from error


def check_tables(
    tables: Mapping[str, Any], path: Path, lists: Collection[str] = ()
) -> dict[str, dict[str, Any]]:
    """Check all values of a ``study.toml``; return them by table (empty: top level) and key.

    Optional keys that are missing in the file are missing in the result. ``lists``: names of lists
    of tables, which `check_list` reads.

    Raises
    ------
    BadInputError
        A value is not allowed, or a key is missing or unknown. The message names the file, the key
        and the allowed values, or the known keys closest to an unknown one.
    """
    top = {key.name for key in KEYS if not key.table} | {*TABLES, *lists}
    _refuse_unknown(path, "", tables, top)
    values: dict[str, dict[str, Any]] = {name: {} for name in ("", *TABLES)}
    for name in TABLES:
        part = tables.get(name, {})
        if not isinstance(part, Mapping):
            raise BadInputError(f"{path}: {name} must be a table, [{name}], not {part!r}")
        _refuse_unknown(path, f"[{name}]", part, {key.name for key in KEYS if key.table == name})
    for table, part in values.items():
        given = tables.get(table, {}) if table else tables
        part |= _check_keys(path, [key for key in KEYS if key.table == table], given)
    return values


def check_list(
    tables: Mapping[str, Any], path: Path, name: str, keys: Sequence[Key]
) -> list[dict[str, Any]]:
    """Check a list of tables ``[[NAME]]`` of a ``study.toml``; return the values of each by key.

    Raises the errors of `check_tables`.
    """
    entries = tables.get(name, [])
    if not isinstance(entries, list) or not all(isinstance(entry, Mapping) for entry in entries):
        raise BadInputError(f"{path}: {name} must be tables, [[{name}]], not {entries!r:.100}")
    if len(entries) > MOST_ENTRIES:
        raise BadInputError(f"{path}: there can be at most {MOST_ENTRIES} tables [[{name}]]")
    for entry in entries:
        _refuse_unknown(path, f"[[{name}]]", entry, {key.name for key in keys})
    return [_check_keys(path, keys, entry) for entry in entries]


def format_list(
    name: str, keys: Sequence[Key], about: str, entries: Sequence[Mapping[str, Any]], path: Path
) -> str:
    """Return the text of a list of tables ``[[NAME]]``, as `check_list` reads it.

    ``about`` and the meanings of the keys are written as comments above the list. Keys whose value
    is None are left out.
    """
    comments = [*about.splitlines(), *(f"  {key.name}: {key.about}" for key in keys)]
    lines = ["\n", *(f"# {line}\n" for line in comments)]
    for entry in entries:
        lines.append(f"\n[[{name}]]\n")
        given = [key for key in keys if entry[key.name] is not None]
        lines += [f"{k.name} = {_toml(_checked(path, k, entry[k.name]))}\n" for k in given]
    return "".join(lines)


def _check_keys(path: Path, keys: Sequence[Key], given: Mapping[str, Any]) -> dict[str, Any]:
    """Return the checked values of the given keys; refuse a required one that is missing."""
    values = {}
    for key in keys:
        if key.name in given:
            values[key.name] = _checked(path, key, given[key.name])
        elif key.required:
            where = f"{path}, [[{key.table}]]," if key.table else str(path)
            raise BadInputError(f"{where} lacks {key.name}: {' '.join(key.about.split())}")
    return values


def format_tables(values: Mapping[str, Mapping[str, Any]], path: Path) -> str:
    """Return the text of a ``study.toml`` from which `check_tables` reads the same values.

    ``values`` may have further keys, which are ignored. `BadInputError` names the key of a value
    that `check_tables` would refuse.
    """
    lines = [HEAD]
    for name in ("", *TABLES):
        if name:
            lines.append(f"\n# {TABLES[name]}\n[{name}]\n")
        for key in (key for key in KEYS if key.table == name):
            value = _checked(path, key, values[name][key.name])
            comment = "".join(f"# {line}\n" for line in key.about.splitlines())
            lines.append(f"{comment}{key.name} = {_toml(value)}\n")
    return "".join(lines)


def _checked(path: Path, key: Key, value: Any) -> Any:
    """Check one value; `BadInputError` names file, key and allowed values."""
    name = f"{key.table}.{key.name}" if key.table else key.name
    try:
        return key.check(value)
    except ValueError as error:
        shown = repr(list(value) if isinstance(value, tuple) else value)
        raise BadInputError(f"{path}: {name} must be {error}, not {shown[:200]}") from error


def _refuse_unknown(path: Path, table: str, given: Mapping[str, Any], known: set[str]) -> None:
    for name in given:
        if name not in known:
            where = f"{path}, {table}" if table else str(path)
            raise BadInputError(f"{where}: {UnknownNameError('key', name, known)}")


def _toml(value: Any) -> str:
    """Return a value in TOML syntax."""
    if isinstance(value, tuple):
        return f"[{', '.join(_toml(one) for one in value)}]"
    # Texts have no control characters, so their JSON strings are valid TOML strings.
    return json.dumps(value, ensure_ascii=False)


# Questions of the lab: their settings in ``study.toml``, the keys of their texts, valid answers.
#
# ``study.toml`` has one table ``[[questions]]`` for each question. Its texts are in the file of
# each language, in ``[question.NAME]``: ``text``; ``low`` and ``high``, the ends of a scale; and a
# table ``[question.NAME.options]`` with a label for each option.

KINDS = ("text", "choice", "choices", "scale")
MAX_LENGTH = 2000
"""Characters of an answer that is a text."""
MAX_TEXTS = 9
"""Questions for a text, so that all answers fit into one request."""
MOST_STEPS = 11
RESERVED = ("participant", "participant_id", "session", "session_id", "scenario", "simulated",
            "phase", "trial", "number", "stimulus", "kind")  # fmt: skip
"""Names of columns of the export, which no question may have."""

Answer = str | int | list[str] | None
"""An answer to a question of the lab; None: none was given."""


@dataclass(frozen=True)
class Question:
    """One question of the lab at the end of a session.

    Attributes
    ----------
    name
        Name in the data and in the keys of its texts.
    kind
        ``text``; ``choice`` of one option; ``choices``, any number of options; ``scale``.
    required
        Whether an answer must be given.
    options
        Names of the options of a choice.
    steps
        Number of steps of a scale, whose ends have labels.
    """

    name: str
    kind: str
    required: bool = False
    options: tuple[str, ...] = ()
    steps: int = 7

    @property
    def text_keys(self) -> tuple[str, ...]:
        """Keys of its texts."""
        ends = ("low", "high") if self.kind == "scale" else ()
        options = (f"options.{option}" for option in self.options)
        return tuple(f"question.{self.name}.{key}" for key in ("text", *ends, *options))


NAME = pattern("[a-z][a-z0-9_]{0,39}", "a word of small letters, digits and _, at most 40")
QUESTIONS_KEYS = (
    Key("questions", "name", NAME,
        "A word of small letters, digits and _: the name of its column in the data.",
        required=True),
    Key("questions", "kind", one_of(*KINDS),
        "\"text\", \"choice\" (of one option), \"choices\" (of any number) or \"scale\".",
        required=True),
    Key("questions", "required", flag, "Whether it must be answered."),
    Key("questions", "options", listed(NAME, 0, 50),
        "Names of the options of a choice, such as [\"never\", \"often\"]."),
    Key("questions", "steps", whole(2, MOST_STEPS), f"Steps of a scale, 2 to {MOST_STEPS}."),
)  # fmt: skip
ABOUT = """\
Your own questions at the end: one table [[questions]] for each, with the keys below. Their texts
are in texts/: [question.NAME] with text and, for a scale, low and high, the labels of its ends;
[question.NAME.options] with a label for each option."""


def parse_questions(entries: Sequence[Mapping[str, Any]], path: Path) -> tuple[Question, ...]:
    """Return the questions of ``study.toml`` from the checked values of their tables.

    Raises `BadInputError`, naming the question, if its keys do not fit together.
    """
    questions = tuple(Question(**entry) for entry in entries)
    taken: set[str] = set(RESERVED)
    for question in questions:
        for fault in _faults(question):
            raise BadInputError(f"{path}: the question {question.name} {fault}")
        for column in columns_of(question):
            if column in taken:
                raise BadInputError(
                    f"{path}: the question {question.name} would make a second column {column} "
                    "in the data; choose another name"
                )
            taken.add(column)
    if sum(question.kind == "text" for question in questions) > MAX_TEXTS:
        raise BadInputError(f"{path}: at most {MAX_TEXTS} questions can be of the kind text")
    return questions


def _faults(question: Question) -> Iterator[str]:
    chosen = question.kind in ("choice", "choices")
    if chosen and len(question.options) < 2:
        yield f"needs options, at least two, as it is of the kind {question.kind}"
    if not chosen and question.options:
        yield f"has options; only choice and choices have some, not {question.kind}"


def columns_of(question: Question) -> tuple[str, ...]:
    """Return the columns of a question in the exported data: of ``choices``, one per option."""
    if question.kind != "choices":
        return (question.name,)
    return tuple(f"{question.name}_{option}" for option in question.options)


def check_answers(questions: Sequence[Question], given: Mapping[str, Any]) -> dict[str, Answer]:
    """Return the valid answers to all questions.

    Raises ``ValueError`` with the name of the first question whose answer is missing or invalid,
    or that does not exist.
    """
    names = {question.name for question in questions}
    for name in given:
        if name not in names:
            raise ValueError(f"{name[:40]!a} is no question")
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


# Between-subject conditions: settings and texts that differ between groups of sessions.
#
# ``study.toml`` has one table ``[[conditions]]`` for each. Texts of a condition stand in the file
# of each language, in ``[condition.NAME.TABLE]``.

WITHOUT_FEEDBACK = ("instructions.answer", "ready.text")
"""Texts that speak of feedback, which a condition without it must replace."""


@dataclass(frozen=True)
class Condition:
    """A between-subject condition; None: as in the rest of ``study.toml``.

    Attributes
    ----------
    name
        Name in the data, in links and in the keys of its texts.
    cue_ms, flash_hz, break_every
        In place of these keys of ``[timing]``.
    familiarization_feedback
        In place of this key: whether familiarization answers get feedback.
    scenarios
        The scenarios of its sessions, some of those of the study; thus also its own movies.
    """

    name: str
    cue_ms: int | None = None
    flash_hz: float | None = None
    break_every: int | None = None
    familiarization_feedback: bool | None = None
    scenarios: tuple[str, ...] | None = None


_conditions_name = pattern(
    r"[A-Za-z][A-Za-z0-9_-]{0,39}", "a word of letters, digits, _ and -, at most 40 characters"
)
_scenario = pattern(StimuliNAME, "the name of a scenario")
CONDITIONS_KEYS = (
    Key("conditions", "name", _conditions_name, "A word of letters, digits, _ and -.",
        required=True),
    Key("conditions", "cue_ms", whole(0, 60_000), "In place of the key of [timing]."),
    Key("conditions", "flash_hz", number(0, 3), "In place of the key of [timing]."),
    Key("conditions", "break_every", whole(0, 100_000), "In place of the key of [timing]."),
    Key("conditions", "familiarization_feedback", flag,
        "In place of the key above: whether familiarization answers get feedback."),
    Key("conditions", "scenarios", listed(_scenario, 1),
        "The scenarios of its sessions, such as [\"collide_slow\"] for movies of its own."),
)  # fmt: skip
CONDITIONS_ABOUT = """\
Between-subject conditions: one table [[conditions]] for each, with a name and those keys below that
differ from the study. A new session gets the condition with the fewest sessions. Texts of a
condition are in texts/: [condition.NAME.trial] with prompt = "..." is its question."""


def parse_conditions(
    entries: Sequence[Mapping[str, Any]], scenarios: Sequence[str], path: Path
) -> tuple[Condition, ...]:
    """Return the conditions of ``study.toml`` from the checked values of their tables.

    Raises `BadInputError` for one condition alone, a name that occurs twice, or a scenario that is
    not in ``scenarios``, those of the study.
    """
    found = tuple(Condition(**entry) for entry in entries)
    names = [condition.name for condition in found]
    if len(found) == 1:
        raise BadInputError(f"{path}: [[conditions]] needs at least two conditions")
    for condition in found:
        if names.count(condition.name) > 1:
            raise BadInputError(f"{path}: two conditions are called {condition.name}")
        for scenario in condition.scenarios or ():
            if scenario not in scenarios:
                raise BadInputError(
                    f"{path}: the condition {condition.name} has the scenario {scenario}, which is "
                    "not in scenarios"
                )
    return found


def condition_text_keys(conditions: Sequence[Condition], *, blocks: bool) -> tuple[str, ...]:
    """Return the keys of texts that conditions need: of those without feedback, about practice."""
    wanted = (*WITHOUT_FEEDBACK, *(("block.practice",) if blocks else ()))
    return tuple(
        f"condition.{condition.name}.{key}"
        for condition in conditions
        if condition.familiarization_feedback is False
        for key in wanted
    )


# The comprehension check after the instructions: its questions, their texts, right answers.
#
# ``study.toml`` has one table ``[[comprehension_questions]]`` for each question. Its texts are in
# the file of each language, in ``[comprehension_question.NAME]``: ``text``, and a table
# ``options`` with a label for each option. Right answers are never sent to the browser.


@dataclass(frozen=True)
class ComprehensionQuestion:
    """A question with one right answer.

    Attributes
    ----------
    name
        Name in the data and in the keys of its texts.
    options
        Names of the options.
    right
        The right option.
    """

    name: str
    options: tuple[str, ...]
    right: str

    @property
    def text_keys(self) -> tuple[str, ...]:
        """Keys of its texts."""
        options = (f"options.{option}" for option in self.options)
        return tuple(f"comprehension_question.{self.name}.{key}" for key in ("text", *options))


COMPREHENSION_KEYS = (
    Key("comprehension_questions", "name", NAME,
        "A word of small letters, digits and _: its name in the data.", required=True),
    Key("comprehension_questions", "options", listed(NAME, 2, 20),
        "Names of the options, such as [\"red\", \"yellow\"].", required=True),
    Key("comprehension_questions", "right", NAME,
        "The right option, which is never sent to the browser.", required=True),
)  # fmt: skip
COMPREHENSION_ABOUT = """\
Questions about the instructions: one table [[comprehension_questions]] for each, with the keys
below. Their texts are in texts/: [comprehension_question.NAME] with text, and
[comprehension_question.NAME.options] with a label for each option."""


def parse_comprehension(
    entries: Sequence[Mapping[str, Any]], path: Path
) -> tuple[ComprehensionQuestion, ...]:
    """Return the questions of ``study.toml`` from the checked values of their tables.

    Raises `BadInputError`, naming the question, if its right answer is no option or its name is
    taken.
    """
    questions = tuple(ComprehensionQuestion(**entry) for entry in entries)
    names = [question.name for question in questions]
    for question in questions:
        where = f"{path}: the comprehension question {question.name}"
        if question.right not in question.options:
            raise BadInputError(
                f"{where} has the right answer {question.right}, which is no option of it"
            )
        if names.count(question.name) > 1:
            raise BadInputError(f"{where} exists twice; give one of them another name")
    return questions


def check_attempt(
    questions: Sequence[ComprehensionQuestion], given: Mapping[str, Any]
) -> dict[str, str]:
    """Return the answers of an attempt, one option for each question.

    Raises ``ValueError`` with the name of a question that is unknown, or whose answer is missing or
    no option of it.
    """
    for name in given:
        if name not in {question.name for question in questions}:
            raise ValueError(f"{name[:40]!a} is no question")
    for question in questions:
        if given.get(question.name) not in question.options:
            raise ValueError(f"{question.name}: one of {', '.join(question.options)}")
    return {question.name: str(given[question.name]) for question in questions}
