"""The keys of ``study.toml``: meaning and allowed values of each.

A check is a function from the value in the file to the value in `Study`. It raises ``ValueError``
with a description of the allowed values.
"""

from __future__ import annotations

import re
import unicodedata
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any
from urllib.parse import parse_qs, urlsplit

from physion.experiment.study.stimuli import NAME

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


_name = pattern(NAME, "letters, digits and ._+- only, at most 200, the first a letter or digit")
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
        rf"|{NAME}", "empty or the name of a file in the study folder"),
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
