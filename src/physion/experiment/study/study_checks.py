"""What may stand in ``study.toml``: every key, what it means, and what is allowed.

A check takes the value that the file holds, gives the value that the study has, and raises
``ValueError`` with what is allowed in place of it.
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
"""Unicode's control characters, halves of characters, and other ends of lines."""
LANGUAGE = r"[a-z]{2,3}(-[A-Za-z0-9]{2,8})?"
"""Names of languages and of their files, as in HTML: en, de, pt-BR."""


NO_CONTACT = "(name and e-mail address: fill in contact in study.toml)"
"""What a new study has for a contact until somebody fills it in."""
EXCLUSIONS = ("preregistered", "official-code")
"""Names of `physion.analysis.people.exclusions.RULE_SETS`, whose import takes seconds."""


@dataclass(frozen=True)
class Key:
    """One key of ``study.toml``: the table that it stands in (empty: the top), and its comment."""

    table: str
    name: str
    check: Check
    about: str
    required: bool = False


def text(most: int, least: int = 0) -> Check:
    """One line of so many characters."""
    allowed = f"one line of text of {least} to {most} characters"

    def check(value: Any) -> str:
        if not isinstance(value, str) or not least <= len(value.strip()) <= most:
            raise ValueError(allowed)
        if any(unicodedata.category(sign) in _UNFIT for sign in value):
            raise ValueError(f"{allowed}, without control characters")
        return value.strip()

    return check


def pattern(regex: str, allowed: str) -> Check:
    """A text that matches as a whole."""

    def check(value: Any) -> str:
        if not isinstance(value, str) or not re.fullmatch(regex, value):
            raise ValueError(allowed)
        return value

    return check


def whole(low: int, high: int) -> Check:
    """A whole number between two inclusive bounds; True and False are none."""

    def check(value: Any) -> int:
        if type(value) is not int or not low <= value <= high:
            raise ValueError(f"a whole number from {low} to {high}")
        return value

    return check


def number(low: float, high: float) -> Check:
    """A number between two inclusive bounds."""

    def check(value: Any) -> float:
        if type(value) not in (int, float) or not low <= value <= high:
            raise ValueError(f"a number from {low:g} to {high:g}")
        return float(value)

    return check


def flag(value: Any) -> bool:
    """True or False."""
    if not isinstance(value, bool):
        raise ValueError("true or false")
    return value


def listed(each: Check, least: int, most: int = 100) -> Check:
    """A list without repetitions; gives a tuple."""

    def check(value: Any) -> tuple[Any, ...]:
        if not isinstance(value, list | tuple) or not least <= len(value) <= most:
            raise ValueError(f"a list of {least} to {most} values in [ ]")
        found: list[Any] = []
        for one in value:
            try:
                found.append(each(one))
            except ValueError as error:
                raise ValueError(f"a list in which each is {error}") from None
        if len(set(found)) != len(found):
            raise ValueError("a list in which nothing stands twice")
        return tuple(found)

    return check


def span(value: Any) -> tuple[int, int]:
    """Two whole numbers of milliseconds, the smaller one first."""
    allowed = "two whole numbers of milliseconds from 0 to 60000, the smaller one first"
    if not isinstance(value, list | tuple) or len(value) != 2:
        raise ValueError(allowed)
    if any(type(end) is not int for end in value) or not 0 <= value[0] <= value[1] <= 60_000:
        raise ValueError(allowed)
    return int(value[0]), int(value[1])


def address(*needed: str) -> Check:
    """Empty, or an https address with the named parameters."""
    rest = f" with {' and '.join(needed)} in it" if needed else ""

    def check(value: Any) -> str:
        allowed = f"empty or an address that begins with https://{rest}"
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


_name = pattern(NAME, "letters, digits and ._+- alone, at most 200, the first a letter or digit")
_code = pattern(r"[A-Za-z0-9_-]{0,100}", "empty or a word of letters, digits, _ and -, at most 100")
_site = pattern(
    r"https://(\*\.)?[A-Za-z0-9]([A-Za-z0-9.-]*[A-Za-z0-9])?(:[0-9]{1,5})?",
    "a site such as https://www.mturk.com, without a path",
)


def _rules(value: Any) -> str:
    if value not in EXCLUSIONS:
        raise ValueError(" or ".join(EXCLUSIONS))
    return str(value)


KEYS: tuple[Key, ...] = (
    Key("", "name", _name, "Short name: letters, digits and ._+- alone.", required=True),
    Key("", "version", text(100, 1), "Raise it with each change; sessions carry name and version.",
        required=True),
    Key("", "title", text(200, 1), "What participants see above everything.", required=True),
    Key("", "contact", text(500, 1),
        "Whom participants can ask: a name and an e-mail address, shown with the consent and the\n"
        "result, and where something goes wrong.",
        required=True),
    Key("", "scenarios", listed(_name, 1),
        "Scenarios that people can take part in, each with its stimuli in stimuli.csv.",
        required=True),
    Key("", "languages", listed(pattern(LANGUAGE, "a language such as en or pt-BR"), 1),
        "Languages, each with a file in texts/; the first one where a browser asks for no other."),
    Key("", "consent_version", text(100, 1),
        "Stored with each consent; raise it with each change of the consent text."),
    Key("", "participants", whole(1, 1_000_000),
        "Complete sessions wanted for each scenario; who comes later is told that it is full."),
    Key("", "seed", whole(0, 2**63 - 1), "Seed of all orders."),
    Key("", "orders", whole(0, 100_000),
        "0: an order of their own for each participant; else so many prepared orders, least used\n"
        "first (the official study had 125)."),
    Key("", "exclusions", _rules,
        f"Rules by which sessions are flagged: {', '.join(EXCLUSIONS)}."),
    Key("", "percentile_from", whole(1, 1_000_000),
        "Other finished people that it takes before anyone is told a percentile."),
    Key("", "preload", whole(1, 1000), "Trials that are loaded before they are shown."),
    Key("", "embed_from", listed(_site, 0),
        "Sites that may show the pages in a frame (MTurk: https://www.mturk.com); mostly none."),
    Key("timing", "fixation_ms", span,
        "The cross is shown for a time drawn between these two, in ms."),
    Key("timing", "fixation_in_familiarization", flag,
        "Whether it is shown in familiarization too (not in the official study)."),
    Key("timing", "cue_ms", whole(0, 60_000), "How long the first frame is cued, in ms."),
    Key("timing", "flash_hz", number(0, 3),
        "Whole cycles of the red and yellow cue a second (official: 1); more than 3 could harm\n"
        "people with photosensitive epilepsy; 0: it does not flash."),
    Key("screen", "min_width", whole(320, 10_000), "Smallest window, in CSS pixels."),
    Key("screen", "min_height", whole(320, 10_000), ""),
    Key("recruitment", "id_needed", flag,
        "Refuse who comes without an id: one of Prolific, SONA or MTurk, or participant=ID in a\n"
        "plain link."),
    Key("recruitment", "prolific_code", _code, "Prolific's completion code."),
    Key("recruitment", "sona_address", address("experiment_id", "credit_token"),
        "SONA's address for granting credit, with experiment_id and credit_token."),
    Key("recruitment", "mturk_code", pattern(
        r"[A-Za-z0-9_-]{1,100}", "session, or a word of letters, digits, _ and -, at most 100"),
        "\"session\": each session gets a code of its own; any other word is everybody's code."),
    Key("recruitment", "link_code", _code, "Completion code of people who came by a plain link."),
    Key("recruitment", "link_address", address(), "Address that they are sent to at the end."),
    Key("limits", "requests_per_second", number(0.1, 10_000),
        "Requests of one session, in the long run."),
    Key("limits", "burst", whole(1, 100_000), "Requests at once that are forgiven."),
    Key("limits", "sessions_per_minute", number(0.1, 100_000),
        "New sessions from one address, in the long run."),
    Key("limits", "sessions_at_once", whole(1, 100_000),
        "New sessions at once from one address that are forgiven, as of a class in one room."),
)  # fmt: skip
"""All keys in the order in which they are written."""

TABLES = {
    "timing": "What is shown for how long.",
    "screen": "Smaller windows are asked to grow; telephones are refused.",
    "recruitment": "Where participants come from, and how they get their credit.",
    "limits": "Requests beyond these are refused for a while.",
}
"""Tables of ``study.toml`` and the comment above each."""
