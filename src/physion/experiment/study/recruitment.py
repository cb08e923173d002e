"""Where participants come from and how they get their credit: Prolific, SONA, MTurk, plain links.

Names of parameters and addresses: the recruiters' own documentation (Prolific: placeholders of the
study's address, ``submissions/complete?cc=``; SONA: ``%SURVEY_CODE%``, ``survey_code`` of the
client-side completion address; MTurk: ExternalQuestion and its ``externalSubmit``).
"""

from __future__ import annotations

import hashlib
import re
from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any
from urllib.parse import parse_qsl, quote, unquote, urlencode, urlsplit, urlunsplit

from physion.errors import BadInputError
from physion.experiment.protocol.messages import Completion, Enter, Kind, Recruiter
from physion.experiment.study.identity import REFERENCE_LETTERS, check_signature, sign
from physion.experiment.study.study_checks import NO_CONTACT

if TYPE_CHECKING:
    from physion.experiment.study.identity import Secrets
    from physion.experiment.study.study import Study

NO_ASSIGNMENT = "ASSIGNMENT_ID_NOT_AVAILABLE"
"""What MTurk gives for ``assignmentId`` to who only looks at a task."""
RECRUITERS = (
    Recruiter(source="prolific", id="PROLIFIC_PID", others=["STUDY_ID", "SESSION_ID"]),
    Recruiter(
        source="mturk",
        id="workerId",
        others=["assignmentId", "hitId", "turkSubmitTo"],
        preview={"assignmentId": NO_ASSIGNMENT},
    ),
    Recruiter(source="sona", id="id", others=[]),
    Recruiter(source="link", id="participant", others=[]),
)
MTURK_HOSTS = ("https://www.mturk.com", "https://workersandbox.mturk.com")
"""The only places that a form of ours is ever sent to besides our own."""
PROLIFIC_COMPLETION = "https://app.prolific.com/submissions/complete"


def begins_nothing(enter: Enter) -> bool:
    """Is this the look of someone at MTurk who has not accepted the task?"""
    return enter.source == "mturk" and enter.recruiter.get("assignmentId") == NO_ASSIGNMENT


_UNFILLED = re.compile(r"\{\{|\}\}|^%.*%$|\$\{", re.DOTALL)
"""Prolific's ``{{%PROLIFIC_PID%}}``, SONA's ``%SURVEY_CODE%``, and what looks like them."""


def is_unfilled(enter: Enter) -> bool:
    """Is the id, or another value of a recruiter, still the placeholder that stands for it?

    Everybody who comes by such an address would be one and the same person.
    """
    for value in (enter.id or "", *enter.recruiter.values()):
        decoded = value
        # Pages and recruiters may each have encoded it once more.
        for _ in range(3):
            if _UNFILLED.search(decoded.strip()):
                return True
            decoded = unquote(decoded)
    return False


def pass_word(secrets: Secrets, kind: Kind) -> str:
    """The word of a link whose sessions are of this kind: ``preview`` or ``simulated``."""
    return f"{kind}-{sign(secrets, 'pass', kind)}"


def kind_of_pass(secrets: Secrets, word: str) -> Kind | None:
    """The kind that a link's word stands for; None where we never gave this word."""
    for kind in ("preview", "simulated"):
        name, _, signature = word.partition("-")
        if name == kind and check_signature(secrets, signature, "pass", kind):
            return kind  # type: ignore[return-value]
    return None


def session_code(secrets: Secrets, session: str) -> str:
    """Ten signs of a session that only this study can make, for a recruiter's form."""
    digest = hashlib.sha256(sign(secrets, "completion", session).encode()).digest()
    return "".join(REFERENCE_LETTERS[byte % 32] for byte in digest[:10])


def completion(study: Study, secrets: Secrets, session: Any, raw: Any = None) -> Completion:
    """How the participant of a finished session gets the credit.

    ``session`` is a row of SESSIONS. ``raw`` is the participant's row of RAW_IDS; without it (the
    ids were deleted) addresses that need an id are left out, codes stay.
    """
    decided = study.recruitment
    if session.source == "prolific":
        code = decided.prolific_code or None
        return Completion(code=code, url=_with(PROLIFIC_COMPLETION, cc=code) if code else None)
    if session.source == "sona":
        known = decided.sona_address and raw is not None
        address = _with(decided.sona_address, survey_code=raw.raw_id) if known else None
        return Completion(code=None, url=address)
    if session.source == "mturk":
        own = session_code(secrets, session.session)
        code = own if decided.mturk_code == "session" else decided.mturk_code or own
        return _mturk_form(code, {} if raw is None else raw.recruiter)
    return Completion(code=decided.link_code or None, url=decided.link_address or None)


def _mturk_form(code: str, recruiter: Mapping[str, str]) -> Completion:
    """In MTurk's frame the answer is a form to MTurk itself; else the code is copied by hand."""
    host = recruiter.get("turkSubmitTo", "").rstrip("/")
    assignment = recruiter.get("assignmentId", "")
    if host not in MTURK_HOSTS or not assignment:
        return Completion(code=code, url=None)
    fields = {"assignmentId": assignment, "code": code}
    return Completion(code=code, url=f"{host}/mturk/externalSubmit", post=fields)


def _with(address: str, **parameters: str) -> str:
    """An address with these parameters in place of what it had by the same names."""
    parts = urlsplit(address)
    kept = [pair for pair in parse_qsl(parts.query, keep_blank_values=True)
            if pair[0] not in parameters]  # fmt: skip
    return urlunsplit(parts._replace(query=urlencode([*kept, *parameters.items()])))


@dataclass(frozen=True)
class Link:
    """One address to hand out. ``goes_to``: who gets it, and where it is pasted. ``lacks``: what
    study.toml has to say before people who come by it get their credit; empty where nothing.
    """

    name: str
    scenario: str
    address: str
    goes_to: str
    lacks: str = ""


PLACEHOLDERS = {
    "prolific": "&".join(
        f"{name}={{{{%{name}%}}}}" for name in ("PROLIFIC_PID", "STUDY_ID", "SESSION_ID")
    ),
    "sona": "id=%SURVEY_CODE%",
}
"""What the recruiters replace by their ids; not to be escaped."""
GOES_TO = {
    "link": "anyone; add &participant=ID where you give people ids of your own",
    "prolific": "Prolific: study address, with url parameters",
    "sona": "SONA: Study URL",
    "mturk": "MTurk: ExternalURL of an ExternalQuestion (write & as &amp; in XML); MTurk adds ids",
    "preview": "yourself and colleagues: never counted, never exported",
    "simulated": "piloting by programs: marked as simulated for good",
}


def links(study: Study, secrets: Secrets, base_url: str) -> tuple[Link, ...]:
    """Every address of the study by recruiter and scenario.

    Raises:
        BadInputError: ``base_url`` is not the root of a web site.
    """
    root = _root(base_url)
    found = []
    for scenario in study.scenarios:
        for name, goes_to in GOES_TO.items():
            words = [f"scenario={quote(scenario, safe='')}"]
            if name in ("preview", "simulated"):
                words.append(f"pass={pass_word(secrets, name)}")  # type: ignore[arg-type]
            if name in PLACEHOLDERS:
                words.append(PLACEHOLDERS[name])
            address = f"{root}/?{'&'.join(words)}"
            found.append(Link(name, scenario, address, goes_to, _lacks(study, name)))
    return tuple(found)


def undecided(study: Study) -> tuple[str, ...]:
    """What must be filled in before people come, a line each.

    What single recruiters lack is said with their links, of which a study needs but some.
    """
    if study.contact != NO_CONTACT:
        return ()
    return (
        "warning: contact in study.toml is not filled in: nobody who takes part can ask you or "
        "have their data deleted; fill it in before people come",
    )


def _lacks(study: Study, name: str) -> str:
    """What the study has not decided yet for a recruiter."""
    decided = study.recruitment
    if name == "prolific" and not decided.prolific_code:
        return "prolific_code: the completion code that Prolific gives"
    if name == "sona" and not decided.sona_address:
        return "sona_address: the client-side completion address that SONA gives"
    if name == "mturk" and not set(MTURK_HOSTS) & set(study.embed_from):
        hosts = ", ".join(f'"{host}"' for host in MTURK_HOSTS)
        return f"embed_from = [{hosts}]: MTurk shows the pages in a frame"
    return ""


def _root(base_url: str) -> str:
    try:
        parts = urlsplit(base_url)
        valid = parts.scheme in ("http", "https") and bool(parts.hostname) and parts.port != 0
    except ValueError:
        valid = False
    if not valid or parts.path not in ("", "/") or parts.query or parts.fragment or parts.username:
        raise BadInputError(
            f"--base-url {base_url!r}: give the root of the site, such as https://lab.example.org"
        )
    return f"{parts.scheme}://{parts.netloc}"
