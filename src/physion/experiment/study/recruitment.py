"""Recruitment through Prolific, SONA, MTurk and plain links: entry links and completion credit.

Parameter names and URLs follow the recruiters' documentation (Prolific: placeholders in the study
URL, ``submissions/complete?cc=``; SONA: ``%SURVEY_CODE%`` and ``survey_code`` of the client-side
completion URL; MTurk: ExternalQuestion and its ``externalSubmit``).
"""

from __future__ import annotations

import hashlib
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any
from urllib.parse import parse_qsl, quote, unquote, urlencode, urlsplit, urlunsplit

from physion.core.errors import BadInputError
from physion.experiment.protocol import Completion, Enter, Recruiter, Source
from physion.experiment.study.identity import REFERENCE_LETTERS, check_signature, sign
from physion.experiment.study.study import under

if TYPE_CHECKING:
    from physion.experiment.study.identity import Secrets
    from physion.experiment.study.settings import EarlyEnd
    from physion.experiment.study.study import Study

NO_ASSIGNMENT = "ASSIGNMENT_ID_NOT_AVAILABLE"
"""Value of ``assignmentId`` that MTurk sends while a worker previews a task."""
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
"""The only foreign hosts to which a form of the participants' pages is ever submitted."""
PROLIFIC_COMPLETION = "https://app.prolific.com/submissions/complete"


def is_mturk_preview(enter: Enter) -> bool:
    """Return whether this is a preview by an MTurk worker who has not accepted the task."""
    return enter.source == "mturk" and enter.recruiter.get("assignmentId") == NO_ASSIGNMENT


_UNFILLED = re.compile(r"\{\{|\}\}|^%.*%$|\$\{", re.DOTALL)
"""Placeholders such as Prolific's ``{{%PROLIFIC_PID%}}`` and SONA's ``%SURVEY_CODE%``."""


def is_unfilled(enter: Enter) -> bool:
    """Return whether the id or another recruiter value is still an unreplaced placeholder.

    All participants who came by such a URL would otherwise have the same id.
    """
    for value in (enter.id or "", *enter.recruiter.values()):
        decoded = value
        # The page and the recruiter may each have percent-encoded the value.
        for _ in range(3):
            if _UNFILLED.search(decoded.strip()):
                return True
            decoded = unquote(decoded)
    return False


LINK_KEYS = ("preview", "simulated", "study", "person")
"""What a link's ``pass`` is signed for: sessions of a kind, the people of a recruiter, or one
person."""


def make_pass(secrets: Secrets, key: str, *signed: str) -> str:
    """Return the ``pass`` of a link.

    Parameters
    ----------
    secrets
        Keys of the study.
    key
        One of `LINK_KEYS`.
    signed
        Nothing for ``preview`` and ``simulated``, the recruiter for ``study``, recruiter and id for
        ``person``; then, if the link fixes the condition, the word ``condition`` and its name.
    """
    return f"{key}-{sign(secrets, 'pass', key, *signed)}"


def read_pass(secrets: Secrets, enter: Enter) -> str | None:
    """Return which of `LINK_KEYS` signed the link of a visitor; None if there is no valid one."""
    key, _, signature = (enter.pass_ or "").partition("-")
    signed = {"study": (enter.source,), "person": (enter.source, enter.id or "")}.get(key, ())
    signed = (*signed, *(("condition", enter.condition) if enter.condition else ()))
    if key not in LINK_KEYS or (key == "person" and not enter.id):
        return None
    return key if check_signature(secrets, signature, "pass", key, *signed) else None


def is_id_allowed(study: Study, source: str, raw_id: str) -> bool:
    """Return whether an id fits the recruiter's pattern and the allow list."""
    fits = re.fullmatch(getattr(study.recruitment, f"{source}_id") or ".*", raw_id, re.DOTALL)
    return fits is not None and (study.allowed_ids is None or raw_id in study.allowed_ids)


def session_code(secrets: Secrets, session: str) -> str:
    """Return the signed completion code (10 characters) of a session, entered at MTurk."""
    digest = hashlib.sha256(sign(secrets, "completion", session).encode()).digest()
    return "".join(REFERENCE_LETTERS[byte % 32] for byte in digest[:10])


def completion(study: Study, secrets: Secrets, session: Any, raw: Any = None) -> Completion:
    """Return the code, URL or form by which the participant of a finished session gets credit.

    Parameters
    ----------
    study, secrets
        The study and its keys.
    session
        Row of the table SESSIONS.
    raw
        Row of the table RAW_IDS of this participant. None if the ids were deleted: then URLs that
        contain an id are left out, codes are still given.
    """
    settings = study.recruitment
    if session.source == "prolific":
        code = settings.prolific_code or None
        return Completion(code=code, url=_with(PROLIFIC_COMPLETION, cc=code) if code else None)
    if session.source == "sona":
        known = settings.sona_address and raw is not None
        address = _with(settings.sona_address, survey_code=raw.raw_id) if known else None
        return Completion(code=None, url=address)
    if session.source == "mturk":
        signed = session_code(secrets, session.session)
        code = signed if settings.mturk_code == "session" else settings.mturk_code or signed
        return _mturk_form(code, {} if raw is None else raw.recruiter)
    return Completion(code=settings.link_code or None, url=settings.link_address or None)


def ending_completion(end: EarlyEnd, source: str) -> Completion:
    """Return the code and URL for a participant who did not finish.

    Parameters
    ----------
    end
        Settings of this way to end: ``declined``, ``stopped``, ``device_refused`` or ``full``.
    source
        The participant's recruiter.
    """
    if source == "prolific":
        code = end.prolific_code or None
        return Completion(code=code, url=_with(PROLIFIC_COMPLETION, cc=code) if code else None)
    return Completion(code=end.code or None, url=end.address or None)


def _mturk_form(code: str, recruiter: Mapping[str, str]) -> Completion:
    """Return the form that MTurk's frame submits; outside it, a code to be copied by hand."""
    host = recruiter.get("turkSubmitTo", "").rstrip("/")
    assignment = recruiter.get("assignmentId", "")
    if host not in MTURK_HOSTS or not assignment:
        return Completion(code=code, url=None)
    fields = {"assignmentId": assignment, "code": code}
    return Completion(code=code, url=f"{host}/mturk/externalSubmit", post=fields)


def _with(address: str, **parameters: str) -> str:
    """Return a URL in which these query parameters are set or replaced."""
    parts = urlsplit(address)
    kept = [pair for pair in parse_qsl(parts.query, keep_blank_values=True)
            if pair[0] not in parameters]  # fmt: skip
    return urlunsplit(parts._replace(query=urlencode([*kept, *parameters.items()])))


@dataclass(frozen=True)
class Link:
    """Entry link of a study.

    Attributes
    ----------
    name
        Recruiter, ``link``, ``preview`` or ``simulated``.
    scenario
        Scenario that the link leads to.
    condition
        The condition that the link fixes; empty: the one with the fewest sessions.
    address
        The URL.
    goes_to
        Who gets the link, and where it is entered.
    lacks
        Setting still missing in study.toml without which participants get no credit, or empty.
    """

    name: str
    scenario: str
    address: str
    goes_to: str
    lacks: str = ""
    condition: str = ""


PLACEHOLDERS = {
    "prolific": "&".join(
        f"{name}={{{{%{name}%}}}}" for name in ("PROLIFIC_PID", "STUDY_ID", "SESSION_ID")
    ),
    "sona": "id=%SURVEY_CODE%",
}
"""Placeholders that the recruiters replace by ids; they must not be percent-encoded."""
GOES_TO = {
    "link": "anyone; add &participant=ID if you assign ids yourself",
    "prolific": "Prolific: study URL, with URL parameters",
    "sona": "SONA: Study URL",
    "mturk": "MTurk: ExternalURL of an ExternalQuestion (write & as &amp; in XML); MTurk adds ids",
    "preview": "you and colleagues: never counted, never exported",
    "simulated": "simulated participants: permanently marked as simulated",
}


def links(study: Study, secrets: Secrets, base_url: str) -> tuple[Link, ...]:
    """Return all entry links of the study, by scenario, condition and recruiter.

    Links that fix a condition are signed, so that nobody can choose another one.

    Raises
    ------
    BadInputError
        ``base_url`` is not the root URL of a web site.
    """
    root = _root(base_url)
    result = []
    for condition in ("", *(each.name for each in study.conditions)):
        for scenario in under(study, condition).scenarios:
            for name in GOES_TO:
                query = _query(study, secrets, scenario, name, condition)
                address = f"{root}/?{'&'.join(query)}" if query else f"{root}/"
                lacks = _lacks(study, name)
                result.append(Link(name, scenario, address, GOES_TO[name], lacks, condition))
    return tuple(result)


def _query(study: Study, secrets: Secrets, scenario: str, name: str, condition: str) -> list[str]:
    """Return the parts of the query of an entry link."""
    query = [f"scenario={quote(scenario, safe='')}"]
    fixed = ("condition", condition) if condition else ()
    if condition:
        query.append(f"condition={quote(condition, safe='')}")
    if name in ("preview", "simulated"):
        query.append(f"pass={make_pass(secrets, name, *fixed)}")
    elif study.recruitment.signed_links == "study" or condition:
        query.append(f"pass={make_pass(secrets, 'study', name, *fixed)}")
    if name in PLACEHOLDERS:
        query.append(PLACEHOLDERS[name])
    return query


def signed_links(
    study: Study, secrets: Secrets, base_url: str, source: Source, ids: Sequence[str]
) -> tuple[tuple[str, str, str], ...]:
    """Return a link for each scenario and id, signed for the person: (scenario, id, URL).

    It can be opened in any browser, also to continue a session that began in another one.

    Raises
    ------
    BadInputError
        ``base_url`` is not the root URL of a web site, or the study does not allow an id.
    """
    root, name = _root(base_url), next(one.id for one in RECRUITERS if one.source == source)
    for raw_id in ids:
        if not is_id_allowed(study, source, raw_id):
            raise BadInputError(
                f"{raw_id[:40]!r} does not fit {source}_id or is not in the allow list of the study"
            )
    return tuple(
        (scenario, raw_id, f"{root}/?{urlencode(query)}")
        for scenario in study.scenarios
        for raw_id in ids
        for query in (
            {
                "scenario": scenario,
                "pass": make_pass(secrets, "person", source, raw_id),
                name: raw_id,
            },
        )
    )


def start_warnings(study: Study) -> tuple[str, ...]:
    """Return the warnings with which serving begins: recruiters whose ids anybody could invent."""
    settings = study.recruitment
    used = {
        "Prolific": settings.prolific_code,
        "SONA": settings.sona_address,
        "MTurk": set(MTURK_HOSTS) & set(study.embed_from),
    }
    names = " and ".join(name for name, value in used.items() if value)
    if not names or settings.signed_links != "no" or study.allowed_ids is not None:
        return ()
    return (
        f"warning: ids of {names} are not signed: anybody who has the address can invent ids and "
        'take all places; set signed_links = "study" in study.toml and enter the links that '
        "physion experiment links prints, or give an allow_list",
    )


def _lacks(study: Study, name: str) -> str:
    """Return the setting that is still missing for a recruiter, or an empty text."""
    settings = study.recruitment
    if settings.signed_links == "person" and name not in ("preview", "simulated"):
        return "links without a person's signature: print them with --ids FILE"
    if name == "prolific" and not settings.prolific_code:
        return "prolific_code: the completion code that Prolific gives"
    if name == "sona" and not settings.sona_address:
        return "sona_address: the client-side completion URL that SONA gives"
    if name == "mturk" and not set(MTURK_HOSTS) & set(study.embed_from):
        hosts = ", ".join(f'"{host}"' for host in MTURK_HOSTS)
        return f"embed_from = [{hosts}]: MTurk shows the pages in a frame"
    return ""


def _root(base_url: str) -> str:
    """Check that ``base_url`` is the root of a web site; return it without trailing slash."""
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
